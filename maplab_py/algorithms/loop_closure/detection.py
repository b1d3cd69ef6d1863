"""Detect loop closures: descriptors, places, poses, gates, consensus."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.loop_closure.candidates import (
    CandidateRule,
    Candidates,
    Matches,
    find_candidates,
)
from maplab_py.algorithms.loop_closure.closures import Closures
from maplab_py.algorithms.loop_closure.features import MapFeatures, map_features
from maplab_py.algorithms.loop_closure.gates import judge
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.recording import closure_ids
from maplab_py.algorithms.loop_closure.verification import PoseSearch, search_poses
from maplab_py.geometry import se3
from maplab_py.progress import SILENT, Progress
from maplab_py.vimap import VIMap
from maplab_py.vimap.table import ragged_rows, starts_of_counts
from maplab_py.vision.descriptors import hamming
from maplab_py.vision.index import MatchRule, make_index
from maplab_py.vision.projection import DescriptorProjection
from maplab_py.vision.projection_file import load_projection

I64 = NDArray[np.int64]
F64 = NDArray[np.float64]

_NEIGHBOURS = 3


@dataclasses.dataclass(frozen=True, eq=False)
class Detection:
    """Closures with the size of the search."""

    closures: Closures
    query_vertices: int
    database_landmarks: int
    descriptor_matches: int
    best_votes: int  # most matches of a query vertex with one place, where no candidate came of it
    notes: tuple[str, ...] = ()


def detect(
    vi_map: VIMap,
    options: LoopClosureOptions,
    *,
    missions: I64,
    only_other_missions: bool = False,
    trust_base_frames: bool = True,
    progress: Progress = SILENT,
) -> Detection:
    """Look for the places of some missions in the same missions.

    Args:
        vi_map: A map whose landmarks have a quality.
        options: Thresholds.
        missions: Mission rows.
        only_other_missions: Leave out places of the query's own mission.
        trust_base_frames: Known base frames count: corrections between missions are limited too.
        progress: Progress.

    Raises:
        EstimationError: No descriptors, or too few tracks to learn their projection.
    """
    progress.step(0, 4, "features")
    given = None
    if options.projection_matrix_filename:
        given = load_projection(Path(options.projection_matrix_filename))
    features, used = map_features(
        vi_map, missions, projection=given, dimensions=options.target_dimensionality
    )
    # the queries' own missions are searched in any case: they tell which places look alike
    rule = MatchRule(round(options.min_image_time_seconds * 1e9))
    progress.step(1, 4, "descriptor matches")
    matches, database_landmarks = _match(features, options, rule, only_other_missions)
    progress.step(2, 4, "places")
    candidates = find_candidates(
        vi_map,
        features,
        matches,
        CandidateRule(
            min_time_ns=rule.min_time_ns,
            other_missions_only=False,
            min_matches=options.min_verify_matches_num,
            fraction_best_scores=options.fraction_best_scores,
        ),
    )
    progress.step(3, 4, "poses")
    search = search_poses(
        vi_map,
        features,
        matches,
        candidates,
        tolerance_px=options.ransac_pixel_sigma,
        seed=options.seed,
        max_iterations=options.num_ransac_iters,
        hypotheses=options.pose_hypotheses,
    )
    closures = _closures(vi_map, features, candidates, search, options, trust_base_frames)
    if only_other_missions:
        mission = vi_map.vertices.mission
        other = mission[closures.query_vertex] != mission[closures.place_vertex]
        closures = closures.take(np.flatnonzero(other))
    progress.step(4, 4, "loop closures")
    return Detection(
        closures=closures,
        query_vertices=len(np.unique(features.vertex)),
        database_landmarks=database_landmarks,
        descriptor_matches=len(matches),
        best_votes=int(candidates.votes.max(initial=0)),
        notes=_notes(options, given, used),
    )


def _notes(
    options: LoopClosureOptions, given: DescriptorProjection | None, used: DescriptorProjection
) -> tuple[str, ...]:
    if given is None or given is used:
        return ()
    return (
        f"{options.projection_matrix_filename} is for descriptors of {given.descriptor_size} "
        f"bytes, the map has {used.descriptor_size}: learned a projection from the map",
    )


def _match(
    features: MapFeatures, options: LoopClosureOptions, rule: MatchRule, apart: bool
) -> tuple[Matches, int]:
    """Match keypoints with the nearest landmarks; also return the number of landmarks searched.

    With `apart` the own mission and the others are searched one by one, as the own one's landmarks
    would take the others' places among the nearest.
    """
    query = np.arange(len(features))
    database = np.flatnonzero(features.in_database)
    landmarks = len(np.unique(features.descriptors.label[database]))
    if landmarks == 0:
        empty = np.zeros(0, dtype=np.int64)
        return Matches(empty, empty, empty.astype(np.int32)), 0
    d = features.descriptors
    index = make_index(
        options.detector_engine,
        d.take(database),
        seed=options.seed,
        words_per_query=options.num_words_for_nn_search,
    )
    k = options.num_neighbors if options.num_neighbors > 0 else _NEIGHBOURS
    queries = d.take(query)
    row = index.nearest(queries, k, rule).row
    if apart:
        own = (row >= 0) & (d.session[database][row] == d.session[query][:, None])
        others = index.nearest(queries, k, MatchRule(rule.min_time_ns, True)).row
        row = np.concatenate([np.where(own, row, -1), others], axis=1)
    i, j = np.nonzero(row >= 0)
    query, found = query[i], database[row[i, j]]
    bits = hamming(d.words, query, d.words, found)
    matches = Matches(query, found, bits)
    return matches.take(bits <= options.max_bit_fraction * features.descriptor_bits), landmarks


def _closures(
    vi_map: VIMap,
    features: MapFeatures,
    candidates: Candidates,
    search: PoseSearch,
    options: LoopClosureOptions,
    trust_base_frames: bool,
) -> Closures:
    """Make the table of closures, with the verdicts of the gates."""
    s, query = search.solutions, candidates.query_vertex
    place = _most_seen(vi_map, search, candidates.place_vertex)
    is_known = vi_map.baseframes.is_known[vi_map.missions.baseframe] & trust_base_frames
    judgement = judge(vi_map, query, place, s, options, is_known=is_known)
    inlier = np.flatnonzero(s.is_inlier)
    problem = np.repeat(np.arange(len(query)), np.diff(search.start))[inlier]
    return Closures(
        id=closure_ids(vi_map, query, place),
        query_vertex=query,
        place_vertex=place,
        T_M_I=s.T_M_I,
        T_A_B=se3.relative(s.T_M_I, vi_map.vertices.T_M_I[place]),
        covariance=s.covariance,
        match_count=s.keypoint_count,
        inlier_count=s.inlier_count,
        tilt_deg=np.degrees(s.tilt_rad),
        correction_m=judgement.correction_m,
        correction_deg=judgement.correction_deg,
        verdict=judgement.verdict,
        support=judgement.support,
        start=starts_of_counts(np.bincount(problem, minlength=len(query))),
        keypoint=features.keypoint[search.feature[inlier]],
        landmark=search.landmark[inlier],
        bits=search.bits[inlier],
    )


def _most_seen(vi_map: VIMap, search: PoseSearch, place: I64) -> I64:
    """Return, per candidate, the vertex of the place's mission that observes most inliers."""
    inlier = np.flatnonzero(search.solutions.is_inlier)
    problem = np.repeat(np.arange(len(place)), np.diff(search.start))[inlier]
    landmark = search.landmark[inlier]
    rows = vi_map.observations[ragged_rows(vi_map.observation_start, landmark)]
    of_row = np.repeat(problem, np.diff(vi_map.observation_start)[landmark])
    vertex = vi_map.keypoint_vertex[rows].astype(np.int64)
    inside = vi_map.vertices.mission[vertex] == vi_map.vertices.mission[place[of_row]]
    size = len(vi_map.vertices)
    key, count = np.unique(of_row[inside] * size + vertex[inside], return_counts=True)
    order = np.lexsort((key, count))  # the last entry of a problem is its best
    best = place.copy()
    best[key[order] // size] = key[order] % size
    return best
