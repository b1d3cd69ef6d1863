"""Detect loop closures: descriptors, places, poses, gates, consensus."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path

import numpy as np

from maplab_py.algorithms.loop_closure import ambiguity, closure_table, gates, matching
from maplab_py.algorithms.loop_closure.candidates import Candidates, Matches, find_candidates
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
from maplab_py.vimap import Groups, VIMap, ragged_rows
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
    features, used = map_features(
        vi_map,
        missions,
        projection=given,
        dimensions=options.target_dimensionality,
        feature_type=options.type_number,
        sizes=options.sizes,
        memory=scope.projections,
    )
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
    search, notes = _Search(vi_map, features, options).all_poses(matches, candidates, progress)
    query, place = candidates.query_vertex, _most_seen(vi_map, search, candidates.place_vertex)
    is_known = vi_map.baseframes.is_known[vi_map.missions.baseframe] & trust_base_frames
    measured = gates.measure(vi_map, query, place, search, is_known)
    judged, contests = gates.judge(
        vi_map, query, place, search.T_M_I, measured, options, choice=choice
    )
    closures = _closures(vi_map, query, place, features, search, judged)
    if only_other_missions:
        mission = vi_map.vertices.mission
        closures = closures.take(mission[query] != mission[place])
    progress.step(4, 4, "loop closures")
    return Detection(
        closures=closures,
        query_vertices=len(distinct(features.vertex if asked is None else features.vertex[asked])),
        database_landmarks=database_landmarks,
        descriptor_matches=len(matches),
        best_votes=int(candidates.votes.max(initial=0)),
        notes=(*_notes(vi_map, features, options, given, used), *notes),
        contests=tuple(contests),
    )


def _closures(
    vi_map: VIMap,
    query: I64,
    place: I64,
    features: MapFeatures,
    search: PoseSearch,
    values: closure_table.GateValues,
) -> closure_table.Closures:
    return closure_table.Closures(
        **vars(values),
        id=closure_table.closure_ids(vi_map, query, place),
        query_vertex=query,
        place_vertex=place,
        T_M_I=search.T_M_I,
        T_A_B=se3.relative(search.T_M_I, vi_map.vertices.T_M_I[place]),
        covariance=search.covariance,
        start=search.start,
        keypoint=features.keypoint[search.feature],
        landmark=search.landmark,
        bits=search.bits,
    )


def _notes(
    vi_map: VIMap,
    features: MapFeatures,
    options: LoopClosureOptions,
    given: DescriptorProjection | None,
    used: DescriptorProjection,
) -> list[str]:
    """Say which type of features is matched where a map has several, and if a projection does not fit."""
    notes = []
    matched = features.kind.feature_type
    others = [type_name(other) for other in sorted(types_of(vi_map.frames) - {matched})]
    if others:
        notes.append(
            f"matched {type_name(matched)} features; the map has {', '.join(others)}, too "
            "(--lc_feature_type)"
        )
    if given is not None and given is not used:
        notes.append(
            f"{options.projection_matrix_filename} is for descriptors {given.kind.words}, the map "
            f"has {used.kind.words}: learned a projection from the map"
        )
    return notes


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


class PoseSearch(PoseSolutions, Groups, items=("is_inlier", "feature", "landmark", "bits")):
    """Estimated poses of candidates (P,), and the inliers (N,) of each."""

    feature: I64  # (N,) query feature
    landmark: I64  # (N,)
    bits: NDArray[np.int32]  # (N,)


@dataclasses.dataclass(frozen=True, eq=False)
class _Search:
    """Estimation of each candidate's pose T_M_I, where M is the frame of the place's mission."""

    vi_map: VIMap
    features: MapFeatures
    options: LoopClosureOptions

    def all_poses(
        self, matches: Matches, candidates: Candidates, progress: Progress
    ) -> tuple[PoseSearch, list[str]]:
        """Return the poses, by a second matching of those with few inliers if it is asked for."""
        first = self.poses(matches, candidates)
        needed = self.options.inlier_factor * self.options.min_inlier_count
        weak = np.flatnonzero(first.inlier_count < needed)
        if self.options.matcher == "nearest" or not len(weak):
            return first, []
        from maplab_py.algorithms.loop_closure.second_matching import match_again

        second = self.poses(
            *match_again(self.vi_map, self.features, matches, candidates, weak, progress)
        )
        better = second.inlier_count > first.inlier_count[weak]
        row = np.arange(len(first))
        row[weak[better]] = len(row) + np.flatnonzero(better)
        enough = np.count_nonzero(second.inlier_count >= needed)
        again = f"LighterGlue matched {counted(len(weak), 'candidate')} again"
        notes = [f"{again}: {enough} of them have enough inliers"]
        return PoseSearch.concatenate([first, second]).take(row), notes

    def poses(self, matches: Matches, candidates: Candidates) -> PoseSearch:
        """Solve candidates in parts, which bounds the memory; none has an influence on another."""
        part = candidates.start[:-1] // _MATCHES_AT_ONCE
        begins = np.flatnonzero(np.diff(part, prepend=-1))
        cuts = np.append(begins, len(part)) if len(part) else np.zeros(2, dtype=np.int64)
        return PoseSearch.concatenate(
            [
                self._solve(matches, candidates.take(slice(begin, end)))
                for begin, end in itertools.pairwise(cuts.tolist())
            ]
        )

    def _solve(self, matches: Matches, candidates: Candidates) -> PoseSearch:
        """Solve some candidates together, and keep the inliers."""
        vi_map, features, options = self.vi_map, self.features, self.options
        query, place = candidates.query_vertex, candidates.place_vertex
        match = matches.take(candidates.match)
        problem = np.repeat(np.arange(len(query)), np.diff(candidates.start))
        landmark = features.descriptors.label[match.database]
        order = np.lexsort((match.bits, landmark, match.query, problem))
        match, landmark, feature = match.take(order), landmark[order], match.query[order]
        mission = vi_map.vertices.mission[place].astype(np.int64)
        problems = PoseProblems(
            start=candidates.start,
            key=closure_table.closure_ids(vi_map, query, place)[:, 0].view(np.int64),
            q_M_I=vi_map.vertices.T_M_I[query, :4],
            origin_I=features.origin_I[feature],
            ray_I=features.ray_I[feature],
            point_M=points_in_mission(vi_map, landmark, mission[problem]),
            keypoint=feature,
            tolerance=options.ransac_pixel_sigma * features.rad_per_px[feature],
        )
        solved = solve_poses(problems, seed=options.seed, max_iterations=options.num_ransac_iters)
        rows = np.flatnonzero(solved.is_inlier)
        return PoseSearch(
            **vars(solved) | {"is_inlier": solved.is_inlier[rows]},
            start=np.searchsorted(rows, candidates.start),
            feature=feature[rows],
            landmark=landmark[rows],
            bits=match.bits[rows],
        )
