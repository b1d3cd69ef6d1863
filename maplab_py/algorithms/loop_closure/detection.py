"""Detect loop closures: descriptors, places, poses, gates, consensus."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path

import numpy as np

from maplab_py.algorithms.loop_closure import ambiguity, closure_table, gates, matching
from maplab_py.algorithms.loop_closure.candidates import (
    Candidates,
    Matches,
    find_candidates,
)
from maplab_py.algorithms.loop_closure.features import (
    MapFeatures,
    SearchScope,
    map_features,
    points_in_mission,
)
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.array_types import I64, NDArray
from maplab_py.distinct import distinct
from maplab_py.geometry import se3
from maplab_py.progress import SILENT, Progress
from maplab_py.report import counted
from maplab_py.vimap import VIMap, ragged_rows, starts_of_counts
from maplab_py.vimap.descriptors import type_name, types_of
from maplab_py.vision.absolute_pose import PoseProblems, PoseSolutions, solve_poses
from maplab_py.vision.index import MatchRule
from maplab_py.vision.projection import DescriptorProjection, load_projection

_EVERYTHING = SearchScope()


@dataclasses.dataclass(frozen=True, eq=False)
class Detection:
    """Detected closures and statistics of the search."""

    closures: closure_table.Closures
    query_vertices: int
    database_landmarks: int
    descriptor_matches: int
    best_votes: int  # most matches of a query vertex with a place if there is no candidate
    notes: tuple[str, ...] = ()
    contests: tuple[ambiguity.Contest, ...] = ()  # of missions of unknown relative pose


def detect(
    vi_map: VIMap,
    options: LoopClosureOptions,
    *,
    missions: I64,
    only_other_missions: bool = False,
    trust_base_frames: bool = True,
    choice: ambiguity.AlignmentChoice | None = None,
    scope: SearchScope = _EVERYTHING,
    progress: Progress = SILENT,
) -> Detection:
    """Detect loop closures within and between missions.

    Args:
        vi_map: A map whose landmarks have a quality.
        missions: Mission rows.
        only_other_missions: Ignore places of the query's mission.
        trust_base_frames: Limit the corrections between missions with known base frames too.
        choice: An alignment of two missions that a person has chosen.
        scope: What is left out.

    Raises:
        UserError: The chosen alignment does not exist, or the matcher cannot be used.
        EstimationError: No descriptors, or too few tracks to learn their projection.
    """
    progress.step(0, 4, "features")
    given = None
    if options.projection_matrix_filename:
        given = load_projection(Path(options.projection_matrix_filename))
    features, used = _features(vi_map, missions, options, given, scope)
    if options.matcher == "lighterglue":
        from maplab_py.algorithms.loop_closure.second_matching import check_matcher

        check_matcher(features.kind)
    # the queries' missions are always searched: they reveal ambiguous places
    rule = MatchRule(round(options.min_image_time_seconds * 1e9))
    progress.step(1, 4, "descriptor matches")
    asked = None if scope.queries is None else np.flatnonzero(scope.queries[features.vertex])
    matches, database_landmarks = matching.match_features(
        features, options, rule, only_other_missions, asked
    )
    progress.step(2, 4, "places")
    candidates = find_candidates(vi_map, features, matches, options)
    progress.step(3, 4, "poses")
    search, notes = _search(vi_map, features, matches, candidates, options, progress)
    closures, contests = _closures(
        vi_map, features, candidates, search, options, trust_base_frames, choice
    )
    if only_other_missions:
        mission = vi_map.vertices.mission
        other = mission[closures.query_vertex] != mission[closures.place_vertex]
        closures = closures.take(np.flatnonzero(other))
    progress.step(4, 4, "loop closures")
    return Detection(
        closures=closures,
        query_vertices=len(distinct(features.vertex if asked is None else features.vertex[asked])),
        database_landmarks=database_landmarks,
        descriptor_matches=len(matches),
        best_votes=int(candidates.votes.max(initial=0)),
        notes=(*_types(vi_map, features), *_notes(options, given, used), *notes),
        contests=contests,
    )


def _features(
    vi_map: VIMap,
    missions: I64,
    options: LoopClosureOptions,
    given: DescriptorProjection | None,
    scope: SearchScope,
) -> tuple[MapFeatures, DescriptorProjection]:
    return map_features(
        vi_map,
        missions,
        projection=given,
        dimensions=options.target_dimensionality,
        feature_type=options.type_number,
        sizes=options.sizes,
        memory=scope.projections,
    )


def _types(vi_map: VIMap, features: MapFeatures) -> tuple[str, ...]:
    """Say which type of features is matched, where a map has several."""
    types = types_of(vi_map.frames)
    others = [type_name(other) for other in sorted(types - {features.kind.feature_type})]
    if not others:
        return ()
    matched = type_name(features.kind.feature_type)
    return (
        f"matched {matched} features; the map has {', '.join(others)}, too (--lc_feature_type)",
    )


def _notes(
    options: LoopClosureOptions, given: DescriptorProjection | None, used: DescriptorProjection
) -> tuple[str, ...]:
    if given is None or given is used:
        return ()
    return (
        f"{options.projection_matrix_filename} is for descriptors {given.kind.words}, the map has "
        f"{used.kind.words}: learned a projection from the map",
    )


def _closures(
    vi_map: VIMap,
    features: MapFeatures,
    candidates: Candidates,
    search: PoseSearch,
    options: LoopClosureOptions,
    trust_base_frames: bool,
    choice: ambiguity.AlignmentChoice | None,
) -> tuple[closure_table.Closures, tuple[ambiguity.Contest, ...]]:
    """Build the table of closures with the verdicts of the gates."""
    s, query = search.solutions, candidates.query_vertex
    place = _most_seen(vi_map, search, candidates.place_vertex)
    is_known = vi_map.baseframes.is_known[vi_map.missions.baseframe] & trust_base_frames
    measured = gates.measure(vi_map, query, place, s, is_known)
    judged, contests = gates.judge(vi_map, query, place, s.T_M_I, measured, options, choice=choice)
    closures = closure_table.Closures(
        **vars(judged),
        id=closure_table.closure_ids(vi_map, query, place),
        query_vertex=query,
        place_vertex=place,
        T_M_I=s.T_M_I,
        T_A_B=se3.relative(s.T_M_I, vi_map.vertices.T_M_I[place]),
        covariance=s.covariance,
        start=search.start,
        keypoint=features.keypoint[search.feature],
        landmark=search.landmark,
        bits=search.bits,
    )
    return closures, tuple(contests)


def _search(
    vi_map: VIMap,
    features: MapFeatures,
    matches: Matches,
    candidates: Candidates,
    options: LoopClosureOptions,
    progress: Progress,
) -> tuple[PoseSearch, tuple[str, ...]]:
    """Return the poses of candidates, by a second matching of those with few inliers if it is asked for."""

    def poses(some: Matches, of: Candidates) -> PoseSearch:
        return search_poses(
            vi_map,
            features,
            some,
            of,
            tolerance_px=options.ransac_pixel_sigma,
            seed=options.seed,
            max_iterations=options.num_ransac_iters,
        )

    first = poses(matches, candidates)
    needed = options.inlier_factor * options.min_inlier_count
    weak = np.flatnonzero(first.solutions.inlier_count < needed)
    if options.matcher == "nearest" or not len(weak):
        return first, ()
    from maplab_py.algorithms.loop_closure.second_matching import match_again

    second = poses(*match_again(vi_map, features, matches, candidates, weak, progress))
    count = second.solutions.inlier_count
    better = count > first.solutions.inlier_count[weak]
    row = np.arange(len(candidates.query_vertex))
    row[weak[better]] = len(row) + np.flatnonzero(better)
    enough = np.count_nonzero(count >= needed)
    again = f"LighterGlue matched {counted(len(weak), 'candidate')} again"
    note = f"{again}: {enough} of them have enough inliers"
    return _joined([first, second]).take(row), (note,)


def _most_seen(vi_map: VIMap, search: PoseSearch, place: I64) -> I64:
    """Return, per candidate, the vertex of the place's mission that observes most inliers."""
    problem = np.repeat(np.arange(len(place)), np.diff(search.start))
    landmark = search.landmark
    rows = vi_map.observations[ragged_rows(vi_map.observation_start, landmark)]
    of_row = np.repeat(problem, np.diff(vi_map.observation_start)[landmark])
    vertex = vi_map.keypoint_vertex[rows].astype(np.int64)
    inside = vi_map.vertices.mission[vertex] == vi_map.vertices.mission[place[of_row]]
    size = len(vi_map.vertices)
    key, count = np.unique(of_row[inside] * size + vertex[inside], return_counts=True)
    order = np.lexsort((key, count))  # the last entry of a problem has the most inliers
    best = place.copy()
    best[key[order] // size] = key[order] % size
    return best


_MATCHES_AT_ONCE = 400_000
"""Matches whose rays and points are in memory together, about 200 bytes each."""


@dataclasses.dataclass(frozen=True, eq=False)
class PoseSearch:
    """Estimated poses of candidates (P,), and the inliers (N,) of each."""

    solutions: PoseSolutions  # of all candidates; `is_inlier` is that of the rows here: true
    start: I64  # (P + 1,)
    feature: I64  # (N,) query feature
    landmark: I64  # (N,)
    bits: NDArray[np.int32]  # (N,)

    def take(self, rows: I64) -> PoseSearch:
        """Return some candidates."""
        inner = ragged_rows(self.start, rows)
        columns = {
            field.name: getattr(self.solutions, field.name)[
                inner if field.name == "is_inlier" else rows
            ]
            for field in dataclasses.fields(PoseSolutions)
        }
        start = starts_of_counts(np.diff(self.start)[rows])
        solutions = PoseSolutions(**columns)
        return PoseSearch(
            solutions, start, self.feature[inner], self.landmark[inner], self.bits[inner]
        )


def search_poses(
    vi_map: VIMap,
    features: MapFeatures,
    matches: Matches,
    candidates: Candidates,
    *,
    tolerance_px: float,
    seed: int,
    max_iterations: int,
) -> PoseSearch:
    """Estimate each candidate's pose T_M_I, where M is the frame of the place's mission.

    Candidates are solved in parts, which bounds the memory; none has an influence on another.
    """
    start = candidates.start
    part = start[:-1] // _MATCHES_AT_ONCE
    begins = np.flatnonzero(np.diff(part, prepend=-1))
    cuts = np.append(begins, len(part)) if len(part) else np.zeros(2, dtype=np.int64)
    parts = []
    for begin, end in itertools.pairwise(cuts.tolist()):
        problems, landmark, bits = _problems(
            vi_map, features, matches, candidates, slice(begin, end), tolerance_px
        )
        solutions = solve_poses(problems, seed=seed, max_iterations=max_iterations)
        parts.append(_inliers(problems, solutions, landmark, bits))
    return _joined(parts)


def _problems(
    vi_map: VIMap,
    features: MapFeatures,
    matches: Matches,
    candidates: Candidates,
    which: slice,
    tolerance_px: float,
) -> tuple[PoseProblems, I64, NDArray[np.int32]]:
    """Return the pose problems of some candidates, and landmark and bits of each row."""
    query, place = candidates.query_vertex[which], candidates.place_vertex[which]
    start = candidates.start[which.start : which.stop + 1]
    match = candidates.match[start[0] : start[-1]]
    problem = np.repeat(np.arange(len(query)), np.diff(start))
    feature = matches.query[match]
    landmark = features.descriptors.label[matches.database[match]]
    bits = matches.bits[match]
    order = np.lexsort((bits, landmark, feature, problem))
    problem, feature = problem[order], feature[order]
    landmark, bits = landmark[order], bits[order]
    mission = vi_map.vertices.mission[place].astype(np.int64)
    problems = PoseProblems(
        start=starts_of_counts(np.bincount(problem, minlength=len(mission))),
        key=closure_table.closure_ids(vi_map, query, place)[:, 0].view(np.int64),
        q_M_I=vi_map.vertices.T_M_I[query, :4],
        origin_I=features.origin_I[feature],
        ray_I=features.ray_I[feature],
        point_M=points_in_mission(vi_map, landmark, mission[problem]),
        keypoint=feature,
        tolerance=tolerance_px * features.rad_per_px[feature],
    )
    return problems, landmark, bits


def _inliers(
    problems: PoseProblems, solutions: PoseSolutions, landmark: I64, bits: NDArray[np.int32]
) -> PoseSearch:
    """Keep the inliers of solved problems."""
    rows = np.flatnonzero(solutions.is_inlier)
    start = np.searchsorted(rows, problems.start)
    solutions = dataclasses.replace(solutions, is_inlier=solutions.is_inlier[rows])
    return PoseSearch(solutions, start, problems.keypoint[rows], landmark[rows], bits[rows])


def _joined(parts: list[PoseSearch]) -> PoseSearch:
    names = [field.name for field in dataclasses.fields(PoseSolutions)]
    columns = {n: np.concatenate([getattr(part.solutions, n) for part in parts]) for n in names}
    return PoseSearch(
        PoseSolutions(**columns),
        starts_of_counts(np.concatenate([np.diff(part.start) for part in parts])),
        np.concatenate([part.feature for part in parts]),
        np.concatenate([part.landmark for part in parts]),
        np.concatenate([part.bits for part in parts]),
    )
