"""Keep the landmarks that are most useful for localisation and remove all others."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.algorithms.landmarks.quality import evaluate_unknown_quality
from maplab_py.algorithms.sparsification import greedy, integer_programme, partition
from maplab_py.algorithms.sparsification.coverage import CoverageProblem, level_values
from maplab_py.algorithms.sparsification.options import SparsificationOptions
from maplab_py.algorithms.sparsification.reports import (
    CoverageOfMission,
    KeyframeCoverage,
    SparsificationReport,
)
from maplab_py.algorithms.sparsification.scores import landmark_scores, landmark_weights
from maplab_py.array_types import I64, Mask
from maplab_py.distinct import distinct
from maplab_py.errors import UserError
from maplab_py.memory import require_memory
from maplab_py.progress import SILENT, Progress
from maplab_py.vimap import LandmarkQuality, VIMap
from maplab_py.vimap.edits import remove_landmarks
from maplab_py.vimap.ids import to_hex

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
    *,
    progress: Progress = SILENT,
) -> tuple[VIMap, SparsificationReport, Coverage]:
    """Keep exactly `keep` good landmarks and remove all others, bad ones included.

    The quality of landmarks is evaluated first where it is unknown. A map with at most `keep` good
    landmarks keeps them all.

    Args:
        vi_map: The map.
        keep: Landmarks to keep.
        options: Method and parameters of the selection.
        progress: Progress.

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
        raise UserError("no landmark is of good quality: run retriangulate_landmarks first")
    problem, vertex = coverage_problem(judged, good, min(keep, len(good)), options)
    if keep >= len(good):
        everything = np.ones(len(good), dtype=np.bool_)
        value = problem.objective(everything)
        solution, parts = integer_programme.Solution(everything, value, value), 0
        notes = (*notes, f"all {len(good)} good landmarks stay: no more than {keep}")
    else:
        solution, parts = choose(problem, options, progress)
    kept = np.zeros(len(judged.landmarks), dtype=np.bool_)
    kept[good[solution.chosen]] = True
    result = remove_landmarks(judged, ~kept)
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
) -> tuple[CoverageProblem, I64]:
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
        weight = landmark_weights(vi_map, landmarks, threshold_bits=threshold)
    available = np.bincount(keyframe, weight[landmark], minlength=len(vertices))
    wanted = float(options.min_keypoints_per_keyframe)
    problem = CoverageProblem(
        keyframe=keyframe,
        landmark=landmark,
        score=landmark_scores(vi_map, landmarks, threshold_bits=threshold),
        weight=weight,
        wanted=np.minimum(available, wanted),
        base=np.zeros(len(vertices)),
        level_value=level_values(options.slack_levels),
        full=wanted,
        keep=keep,
    )
    return problem, vertices


def _coverage(
    problem: CoverageProblem, vertex: I64, chosen: Mask, options: SparsificationOptions
) -> Coverage:
    """Count the landmarks that each keyframe observes, without weights."""
    size = problem.keyframes
    before = np.bincount(problem.keyframe, minlength=size)
    after = np.bincount(problem.keyframe[chosen[problem.landmark]], minlength=size)
    wanted = np.minimum(before, options.min_keypoints_per_keyframe)
    return Coverage(vertex, before, after, wanted)


def choose(
    problem: CoverageProblem, options: SparsificationOptions, progress: Progress = SILENT
) -> tuple[integer_programme.Solution, int]:
    """Select landmarks with the given method; also return the number of parts."""
    if options.method == "ilp":
        if problem.landmarks <= options.exact_up_to:
            return integer_programme.solve_exactly(problem), 1
        if problem.landmarks <= options.landmarks_per_part:
            return integer_programme.solve_relaxed(problem), 1
        return partition.solve_by_parts(problem, options.landmarks_per_part, progress=progress)
    if options.method == "greedy":
        chosen = greedy.choose_greedily(problem)
    elif options.method == "most_observed":
        chosen = greedy.choose_most_observed(problem)
    else:
        chosen = greedy.choose_random(problem, options.seed)
    value = problem.objective(chosen)
    return integer_programme.Solution(chosen, value, float("nan")), 1


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
