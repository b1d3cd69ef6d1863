"""Detect loop closures: descriptors, places, poses, gates, consensus."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.loop_closure.candidates import (
    CandidateRule,
    Candidates,
    Matches,
    find_candidates,
)
from maplab_py.algorithms.loop_closure.closures import VERDICTS, Closures
from maplab_py.algorithms.loop_closure.consensus import (
    ConsensusRule,
    check_consensus,
    path_lengths,
)
from maplab_py.algorithms.loop_closure.features import MapFeatures, map_features
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.report import Verdict
from maplab_py.algorithms.loop_closure.verification import PoseSearch, search_poses
from maplab_py.geometry import se3
from maplab_py.progress import SILENT, Progress
from maplab_py.vimap import VIMap
from maplab_py.vimap.table import ragged_rows, starts_of_counts
from maplab_py.vision.descriptors import hamming
from maplab_py.vision.index import MatchRule, make_index

I64 = NDArray[np.int64]
F64 = NDArray[np.float64]

_NEIGHBOURS = 3
_DRIFT_OFFSET_M = 0.5


@dataclasses.dataclass(frozen=True, eq=False)
class Detection:
    """Closures with the size of the search."""

    closures: Closures
    query_vertices: int
    database_landmarks: int
    descriptor_matches: int
    best_votes: int  # most matches of a query vertex with one place, where no candidate came of it


def detect(
    vi_map: VIMap,
    options: LoopClosureOptions,
    *,
    missions: I64,
    only_other_missions: bool = False,
    known_base_frames: bool = True,
    progress: Progress = SILENT,
) -> Detection:
    """Look for the places of some missions in the same missions.

    Args:
        vi_map: A map whose landmarks have a quality.
        options: Thresholds.
        missions: Mission rows.
        only_other_missions: Leave out places of the query's own mission.
        known_base_frames: Base frames are to be trusted: corrections between missions are limited too.
        progress: Progress.

    Raises:
        EstimationError: No descriptors, or too few tracks to learn their projection.
    """
    progress.step(0, 4, "features")
    features, _ = map_features(vi_map, missions)
    rule = MatchRule(round(options.min_image_time_seconds * 1e9), only_other_missions)
    progress.step(1, 4, "descriptor matches")
    matches, database_landmarks = _match(features, options, rule)
    progress.step(2, 4, "places")
    candidates = find_candidates(
        vi_map,
        features,
        matches,
        CandidateRule(
            min_time_ns=rule.min_time_ns,
            other_missions_only=only_other_missions,
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
    )
    closures = _judged(vi_map, features, candidates, search, options, known_base_frames)
    progress.step(4, 4, "loop closures")
    return Detection(
        closures=closures,
        query_vertices=len(np.unique(features.vertex)),
        database_landmarks=database_landmarks,
        descriptor_matches=len(matches),
        best_votes=int(candidates.votes.max(initial=0)),
    )


def _match(
    features: MapFeatures, options: LoopClosureOptions, rule: MatchRule
) -> tuple[Matches, int]:
    """Match keypoints with the nearest landmarks; also return the number of landmarks searched."""
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
    row = index.nearest(d.take(query), k, rule).row
    i, j = np.nonzero(row >= 0)
    query, found = query[i], database[row[i, j]]
    bits = hamming(d.words, query, d.words, found)
    matches = Matches(query, found, bits)
    return matches.take(bits <= options.max_bit_fraction * features.descriptor_bits), landmarks


def _judged(
    vi_map: VIMap,
    features: MapFeatures,
    candidates: Candidates,
    search: PoseSearch,
    options: LoopClosureOptions,
    known_base_frames: bool,
) -> Closures:
    """Apply the gates one after the other; the first that fails is the verdict."""
    s = search.solutions
    query, place = candidates.query_vertex, candidates.place_vertex
    vertices = vi_map.vertices
    mission = vertices.mission[place]
    same = vertices.mission[query] == mission
    T_G_I = se3.compose(vi_map.T_G_M[mission], s.T_M_I)
    change = se3.local(vi_map.T_G_I[query], T_G_I)
    correction = np.linalg.norm(change[:, :3], axis=1)
    rotation_deg = np.degrees(np.linalg.norm(change[:, 3:], axis=1))
    way = path_lengths(vi_map)
    drift = _DRIFT_OFFSET_M + options.max_drift_ratio * np.abs(way[query] - way[place])
    implausible = same & (correction > drift)
    limited = same | known_base_frames
    if options.max_delta_position_m >= 0.0:
        implausible |= limited & (correction > options.max_delta_position_m)
    if options.max_delta_rotation_deg >= 0.0:
        implausible |= limited & (rotation_deg > options.max_delta_rotation_deg)

    verdict = np.full(len(query), VERDICTS.index(Verdict.ACCEPTED), dtype=np.int8)

    def refuse(which: NDArray[np.bool_], reason: Verdict) -> None:
        accepted = verdict == VERDICTS.index(Verdict.ACCEPTED)
        verdict[accepted & which] = VERDICTS.index(reason)

    refuse(s.inlier_count < options.min_inlier_count, Verdict.FEW_INLIERS)
    refuse(s.inlier_count < options.min_inlier_ratio * s.keypoint_count, Verdict.LOW_RATIO)
    tilt_deg = np.degrees(s.tilt_rad)
    refuse(tilt_deg > options.max_gravity_deviation_deg, Verdict.TILTED)
    refuse(np.isnan(s.covariance[:, 0, 0]), Verdict.FEW_INLIERS)
    refuse(implausible, Verdict.IMPLAUSIBLE)
    support = np.zeros(len(query), dtype=np.int64)
    left = np.flatnonzero(verdict == VERDICTS.index(Verdict.ACCEPTED))
    if len(left):
        rule = ConsensusRule(min_support=options.min_support)
        support[left], supported, contradicted = check_consensus(
            vi_map, query[left], place[left], s.T_M_I[left], s.inlier_count[left], rule
        )
        verdict[left[contradicted]] = VERDICTS.index(Verdict.CONTRADICTED)
        verdict[left[~supported & ~contradicted]] = VERDICTS.index(Verdict.NO_SUPPORT)
    inlier = np.flatnonzero(s.is_inlier)
    problem = np.repeat(np.arange(len(query)), np.diff(search.start))[inlier]
    return Closures(
        query_vertex=query,
        place_vertex=_most_seen(vi_map, search, place),
        T_M_I=s.T_M_I,
        covariance=s.covariance,
        match_count=s.keypoint_count,
        inlier_count=s.inlier_count,
        tilt_deg=tilt_deg,
        correction_m=correction,
        verdict=verdict,
        support=support,
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
