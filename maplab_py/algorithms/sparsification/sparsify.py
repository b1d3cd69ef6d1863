"""Keep the landmarks that are most useful for localisation and remove all others."""

import dataclasses

import numpy as np

from maplab_py.algorithms.landmarks.evidence import has_evidence, read_evidence
from maplab_py.algorithms.landmarks.persistence import (
    PersistenceOptions,
    existence,
    learn_detection,
    match_rates,
)
from maplab_py.algorithms.landmarks.quality import evaluate_unknown_quality
from maplab_py.algorithms.sparsification import selection
from maplab_py.algorithms.sparsification.options import (
    CoverageOfMission,
    KeyframeCoverage,
    SparsificationOptions,
    SparsificationReport,
)
from maplab_py.array_types import F64, I64, Mask, mask_of
from maplab_py.distinct import distinct
from maplab_py.errors import UserError
from maplab_py.memory import require_memory
from maplab_py.progress import SILENT, Progress
from maplab_py.vimap import LandmarkQuality, VIMap, edits, observer_counts, table, to_hex

_PERSISTENCE = PersistenceOptions()
_BYTES_PER_OBSERVATION = 400
_WORST = 10
"""Keyframes that the report names."""


@dataclasses.dataclass(frozen=True, eq=False)
class Coverage:
    """Number of landmarks that each keyframe observes before and after."""

    vertex: I64  # (K,) vertex rows
    before: I64  # (K,)
    after: I64  # (K,)
    wanted: I64  # (K,)


def sparsify(
    vi_map: VIMap,
    keep: int,
    options: SparsificationOptions,
    persistence: PersistenceOptions = _PERSISTENCE,
    *,
    progress: Progress = SILENT,
) -> tuple[VIMap, SparsificationReport, Coverage]:
    """Keep exactly `keep` good landmarks and remove all others, bad ones included.

    The quality of landmarks is evaluated first where it is unknown. A map with at most `keep` good
    landmarks keeps them all.

    Args:
        keep: Landmarks to keep.
        persistence: Priors of existence, where the map has evidence.

    Raises:
        UserError: `keep` is not positive, or there is no good landmark.
    """
    if keep <= 0:
        raise UserError("say how many landmarks shall stay: --num_landmarks_to_keep=N, N > 0")
    needed = _BYTES_PER_OBSERVATION * float(len(vi_map.observations))
    require_memory(needed, "choosing among the landmarks")
    judged, notes = evaluate_unknown_quality(vi_map, progress)
    good = np.flatnonzero(judged.landmarks.quality == LandmarkQuality.GOOD)
    if len(good) == 0:
        raise UserError(
            "no landmark is of good quality: run retriangulate_landmarks first",
            remedy="retriangulate_landmarks",
        )
    problem, vertex = coverage_problem(judged, good, min(keep, len(good)), options)
    if has_evidence(judged):
        problem = with_weights_of_evidence(problem, judged, good, persistence)
    if keep >= len(good):
        everything = np.ones(len(good), dtype=np.bool_)
        value = problem.objective(everything)
        solution, parts = selection.Solution(everything, value, value), 0
        notes = (*notes, f"all {len(good)} good landmarks stay: no more than {keep}")
    else:
        solution, parts = choose(problem, options, progress)
    kept = mask_of(len(judged.landmarks), good[solution.chosen])
    result = edits.remove_landmarks(judged, ~kept)
    coverage = _coverage(problem, vertex, solution.chosen, options)
    report = SparsificationReport(
        landmarks_before=len(vi_map.landmarks),
        good_landmarks=len(good),
        landmarks_after=len(result.landmarks),
        observations_before=len(vi_map.observations),
        observations_after=len(result.observations),
        keyframes=problem.keyframes,
        wanted_per_keyframe=options.min_keypoints_per_keyframe,
        below_wanted=int(np.count_nonzero(coverage.after < coverage.wanted)),
        method=options.method,
        parts=parts,
        objective=solution.objective,
        bound=solution.bound,
        missions=_by_mission(judged, coverage),
        worst_keyframes=_worst(judged, coverage),
        note="; ".join(notes),
    )
    return result, report, coverage


def coverage_problem(
    vi_map: VIMap, landmarks: I64, keep: int, options: SparsificationOptions
) -> tuple[selection.CoverageProblem, I64]:
    """Return the coverage problem of some landmarks and the vertex rows (K,) of the keyframes."""
    row = np.full(len(vi_map.landmarks) + 1, -1, dtype=np.int64)
    row[landmarks] = np.arange(len(landmarks))
    observed = row[vi_map.keypoints.landmark[vi_map.observations]]
    vertex = vi_map.keypoint_vertex[vi_map.observations[observed >= 0]].astype(np.int64)
    pairs = distinct(vertex * len(landmarks) + observed[observed >= 0])
    vertices, keyframe = np.unique(pairs // len(landmarks), return_inverse=True)
    keyframe = keyframe.reshape(-1)
    landmark = pairs % len(landmarks)
    threshold = options.descriptor_dev_scoring_threshold
    weight = np.ones(len(landmarks))
    if options.weighted:
        # the probability 1 - (1 - p)^n that one of n descriptors matches when it is observed again
        deviation = descriptor_deviations(vi_map, landmarks) * _BITS_OF_THRESHOLD
        stability = np.minimum(1.0, threshold / np.maximum(deviation, 1e-9))
        seen = np.maximum(observer_counts(vi_map)[landmarks], 1)
        weight = np.asarray(1.0 - (1.0 - _MATCH_CHANCE * stability) ** seen)
    available = np.bincount(keyframe, weight[landmark], minlength=len(vertices))
    wanted = float(options.min_keypoints_per_keyframe)
    problem = selection.CoverageProblem(
        keyframe=keyframe,
        landmark=landmark,
        score=landmark_scores(vi_map, landmarks, threshold_bits=threshold),
        weight=weight,
        wanted=np.minimum(available, wanted),
        base=np.zeros(len(vertices)),
        level_value=selection.level_values(options.slack_levels),
        full=wanted,
        keep=keep,
    )
    return problem, vertices


def with_weights_of_evidence(
    problem: selection.CoverageProblem, vi_map: VIMap, landmarks: I64, options: PersistenceOptions
) -> selection.CoverageProblem:
    """Return a problem that weights landmarks (L,) by the probability that a session matches them.

    It is the probability that the landmark exists, times that of a match if it does.
    """
    evidence = read_evidence(vi_map)[landmarks]
    detection = learn_detection(evidence, options)
    exists = existence(evidence, options, detection=detection)
    chance = np.clip(exists * match_rates(evidence, options, detection), 1e-3, 1.0)
    weight = chance if problem.weight.min(initial=1.0) < 1.0 else problem.weight
    available = np.bincount(problem.keyframe, weight[problem.landmark], minlength=problem.keyframes)
    wanted = np.minimum(available, problem.full)
    return dataclasses.replace(problem, score=chance, weight=weight, wanted=wanted)


def _coverage(
    problem: selection.CoverageProblem, vertex: I64, chosen: Mask, options: SparsificationOptions
) -> Coverage:
    """Count the landmarks that each keyframe observes, without weights."""
    size = problem.keyframes
    before = np.bincount(problem.keyframe, minlength=size)
    after = np.bincount(problem.keyframe[chosen[problem.landmark]], minlength=size)
    wanted = np.minimum(before, options.min_keypoints_per_keyframe)
    return Coverage(vertex, before, after, wanted)


def choose(
    problem: selection.CoverageProblem, options: SparsificationOptions, progress: Progress = SILENT
) -> tuple[selection.Solution, int]:
    """Select landmarks with the given method; also return the number of parts."""
    if options.method == "ilp":
        if problem.landmarks <= options.exact_up_to:
            return selection.solve_exactly(problem), 1
        if problem.landmarks <= options.landmarks_per_part:
            return selection.solve_relaxed(problem), 1
        return solve_by_parts(problem, options.landmarks_per_part, progress=progress)
    if options.method == "greedy":
        chosen = selection.choose_greedily(problem)
    elif options.method == "most_observed":
        chosen = selection.choose_most_observed(problem)
    else:
        chosen = selection.choose_random(problem, options.seed)
    value = problem.objective(chosen)
    return selection.Solution(chosen, value, float("nan")), 1


def _by_mission(vi_map: VIMap, coverage: Coverage) -> tuple[CoverageOfMission, ...]:
    lines = []
    mission = vi_map.vertices.mission[coverage.vertex]
    for row in np.unique(mission):
        in_mission = mission == row
        before, after = coverage.before[in_mission], coverage.after[in_mission]
        lines.append(
            CoverageOfMission(
                mission=to_hex(vi_map.missions.id[row])[:8],
                keyframes=int(in_mission.sum()),
                min_before=int(before.min()),
                median_before=float(np.median(before)),
                min_after=int(after.min()),
                median_after=float(np.median(after)),
                below_wanted=int(np.count_nonzero(after < coverage.wanted[in_mission])),
            )
        )
    return tuple(lines)


def _worst(vi_map: VIMap, coverage: Coverage) -> tuple[KeyframeCoverage, ...]:
    """Return the keyframes with the largest lack of cover."""
    lack = coverage.wanted - coverage.after
    rows = np.argsort(-lack, kind="stable")[:_WORST]
    return tuple(
        KeyframeCoverage(
            to_hex(vi_map.vertices.id[coverage.vertex[row]]),
            int(coverage.before[row]),
            int(coverage.after[row]),
        )
        for row in rows[lack[rows] > 0]
    )


def solve_by_parts(
    problem: selection.CoverageProblem, landmarks_per_part: int, *, progress: Progress = SILENT
) -> tuple[selection.Solution, int]:
    """Select greedily over the whole map, then optimise each part while the others are fixed.

    The greedy selection determines the number of landmarks of each part and the cover of border
    keyframes by neighbouring parts. The objective never decreases.

    Returns:
        The solution, whose bound is not known (NaN), and the number of parts.
    """
    chosen = selection.choose_greedily(problem)
    parts = split(problem, landmarks_per_part)
    for number, rows in enumerate(parts):
        progress.step(number, len(parts), "parts of the map")
        inner = problem.restricted(rows, chosen)
        if inner.keep in (0, inner.landmarks):
            continue
        better = selection.solve_relaxed(inner)
        if better.objective > inner.objective(chosen[rows]):
            chosen[rows] = better.chosen
    return selection.Solution(chosen, problem.objective(chosen), float("nan")), len(parts)


def split(problem: selection.CoverageProblem, landmarks_per_part: int) -> list[I64]:
    """Return landmark rows of parts of nearly equal size, along the co-visibility graph.

    Keyframes are ordered such that co-visible ones are close (reverse Cuthill and McKee 1969, which
    reduces the bandwidth of the matrix). Landmarks are ordered by their median keyframe.
    """
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    shared = (problem.seen @ problem.seen.T).tocsr()
    place = np.empty(problem.keyframes, dtype=np.int64)
    place[reverse_cuthill_mckee(shared, symmetric_mode=True)] = np.arange(problem.keyframes)
    order = np.lexsort((place[problem.keyframe], problem.landmark))
    offset, _ = problem.seers
    middle = np.zeros(problem.landmarks, dtype=np.int64)
    seen = np.diff(offset) > 0
    median = order[(offset[:-1] + np.diff(offset) // 2)[seen]]
    middle[seen] = place[problem.keyframe[median]]
    ordered = np.argsort(middle, kind="stable")
    parts = -(-problem.landmarks // landmarks_per_part)
    return [np.sort(rows) for rows in np.array_split(ordered, parts)]


_OBSERVATIONS_AT_ONCE = 40_000
_BITS_OF_THRESHOLD = 384
_TOP_PERCENTILE = 95.0
_MATCH_CHANCE = 0.3
"""Probability that a stable descriptor is matched with another descriptor of its landmark."""


def landmark_scores(vi_map: VIMap, landmarks: I64, *, threshold_bits: float) -> F64:
    """Return a score (N,) in [0, 1] for each landmark.

    It is the product of the number of observing vertices, the stability of the descriptors and
    the number of observing missions, each relative to its 95th percentile and at most 1.

    Args:
        landmarks: Landmark rows (N,).
        threshold_bits: Mean distance of descriptors from their majority, in bits of 384, up to
            which they count as stable.
    """
    deviation = descriptor_deviations(vi_map, landmarks) * _BITS_OF_THRESHOLD
    stability = np.minimum(1.0, threshold_bits / np.maximum(deviation, 1e-9))
    raw = observer_counts(vi_map)[landmarks] * stability * mission_counts(vi_map)[landmarks]
    top = float(np.percentile(raw, _TOP_PERCENTILE)) if len(raw) else 0.0
    return np.asarray(np.clip(raw / max(top, 1e-9), 0.0, 1.0))


def mission_counts(vi_map: VIMap) -> I64:
    """Return the number of missions (L,) that observe each landmark."""
    missions = max(len(vi_map.missions), 1)
    rows = vi_map.observations
    landmark = vi_map.keypoints.landmark[rows].astype(np.int64)
    mission = vi_map.vertices.mission[vi_map.keypoint_vertex[rows]]
    seen = distinct(landmark * missions + mission)
    return np.bincount(seen // missions, minlength=len(vi_map.landmarks))


def descriptor_deviations(vi_map: VIMap, landmarks: I64) -> F64:
    """Return the mean fraction of bits (N,) in which descriptors differ from their majority.

    Zero for landmarks with fewer than two binary descriptors.
    """
    deviation = np.zeros(len(landmarks))
    sizes = vi_map.binary_descriptor_size
    size = int(sizes.max(initial=0))
    if size == 0 or len(landmarks) == 0:
        return deviation
    observations = vi_map.observations[sizes[vi_map.observations] > 0]
    observed = vi_map.keypoints.landmark[observations]
    start = table.starts_of_counts(np.bincount(observed, minlength=len(vi_map.landmarks)))
    count = np.diff(start)[landmarks]
    chunk = np.cumsum(count) // _OBSERVATIONS_AT_ONCE
    starts = np.flatnonzero(np.diff(chunk, prepend=-1))
    for begin, end in zip(starts, np.append(starts[1:], len(landmarks)), strict=True):
        mine = np.arange(begin, end)
        mine = mine[count[mine] >= 2]
        if len(mine) == 0:
            continue
        rows = observations[table.ragged_rows(start, landmarks[mine])]
        bits = np.unpackbits(vi_map.keypoints.descriptor[rows, :size], axis=1)
        first = np.cumsum(count[mine]) - count[mine]
        ones = np.add.reduceat(bits, first, axis=0, dtype=np.int32)
        minority = np.minimum(ones, count[mine][:, None] - ones).sum(axis=1)
        deviation[mine] = minority / (count[mine] * 8 * size)
    return deviation
