"""Merge landmarks that verified closures identify as the same point."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.landmarks.quality import predicted_sigma
from maplab_py.algorithms.landmarks.triangulation import triangulate_keypoints
from maplab_py.algorithms.loop_closure.closure_table import Closures
from maplab_py.algorithms.loop_closure.guided_matching import LandmarkMatches, guided_matches
from maplab_py.algorithms.loop_closure.landmark_distance import compare_landmarks
from maplab_py.algorithms.loop_closure.landmark_votes import Votes, unite
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.array_types import I64
from maplab_py.vimap import VIMap
from maplab_py.vimap.edits import merge_landmarks, with_p_G
from maplab_py.vimap.table import ragged_rows, starts_of_counts

FEW_OBSERVATIONS = "too few verified observations agree"
TOO_FAR = "too far apart once the closure is applied"
UNLIKELY = "farther apart than their rays allow"
SAME_IMAGE = "both seen in one image"
GAP = "the closure corrects too much: relax first"
UNKNOWN_BASE_FRAME = "between missions without known base frames: anchor first"


@dataclasses.dataclass(frozen=True, eq=False)
class MergeResult:
    """Result of merging, with the closures that support each merge."""

    landmarks_merged: int
    observations_moved: int
    refused: dict[str, int]  # landmark pairs by reason
    # one row per pair of landmarks (rows before merging) and closure that supports their merge
    first: I64  # (P,)
    second: I64  # (P,)
    closure: I64  # (P,) row of the closure
    wanted: I64  # (P,) query vertices that had to agree


def merge_verified_landmarks(
    vi_map: VIMap, closures: Closures, options: LoopClosureOptions
) -> tuple[VIMap, MergeResult]:
    """Merge the landmarks of query keypoints with the database landmarks that they match.

    With `guided_matching` the merged landmarks are then searched near the other keypoints of the queries,
    and what matches is merged as well. `landmark_votes.unite` says which pairs have enough observations
    that agree. A merged landmark keeps the quality and the position of its best member, or gets the point
    nearest to all rays where that is better determined.
    """
    closure = np.repeat(np.arange(len(closures)), np.diff(closures.start))
    inliers = LandmarkMatches(closure, closures.keypoint, closures.landmark, closures.bits)
    merged, result = _merge(
        vi_map, closures, inliers.take(closures.accepted[inliers.closure]), options
    )
    if not options.guided_matching or result.landmarks_merged == 0:
        return merged, result
    usable = closures.accepted & _mergeable(vi_map, closures)
    usable &= closures.correction_m <= options.max_merge_gap_m
    guided = guided_matches(merged, closures, usable, options)
    remerged, more = _merge(merged, closures, guided, options)
    row_before = vi_map.landmark_index.rows(merged.landmarks.id)
    return remerged, MergeResult(
        landmarks_merged=result.landmarks_merged + more.landmarks_merged,
        observations_moved=result.observations_moved + more.observations_moved,
        refused=result.refused,
        first=np.concatenate([result.first, row_before[more.first]]),
        second=np.concatenate([result.second, row_before[more.second]]),
        closure=np.concatenate([result.closure, more.closure]),
        wanted=np.concatenate([result.wanted, more.wanted]),
    )


def _merge(
    vi_map: VIMap, closures: Closures, matches: LandmarkMatches, options: LoopClosureOptions
) -> tuple[VIMap, MergeResult]:
    """Merge the landmarks of matches (rows of the map) that pass the tests."""
    refused: dict[str, int] = {}
    closure = matches.closure
    source = vi_map.keypoints.landmark[matches.keypoint].astype(np.int64)
    target = matches.landmark
    open_ = (source >= 0) & (source != target)

    def refuse(reason: str, mask: NDArray[np.bool_]) -> None:
        if mask.any():
            pairs = np.stack([source[mask], target[mask]], axis=1)
            refused[reason] = len(np.unique(pairs, axis=0))

    unknown = open_ & ~_mergeable(vi_map, closures)[closure]
    refuse(UNKNOWN_BASE_FRAME, unknown)
    open_ &= ~unknown
    gap = open_ & (closures.correction_m[closure] > options.max_merge_gap_m)
    refuse(GAP, gap)
    open_ &= ~gap
    rows = np.flatnonzero(open_)
    distance = compare_landmarks(
        vi_map, closures, closure[rows], source[rows], target[rows], options.ransac_pixel_sigma
    )
    near = distance.gap_m <= np.maximum(
        options.max_merge_distance_m, options.max_merge_distance_ratio * distance.depth_m
    )
    likely = distance.squared_sigmas <= options.max_merge_sigma**2
    for reason, which in ((TOO_FAR, ~near), (UNLIKELY, near & ~likely)):
        mask = np.zeros(len(source), dtype=np.bool_)
        mask[rows[which]] = True
        refuse(reason, mask)
    rows = rows[near & likely]
    query = closures.query_vertex[closure[rows]]
    is_doubtful = distance.is_doubtful(options.max_merge_distance_m)[near & likely]
    votes = Votes(source[rows], target[rows], query, matches.bits[rows], is_doubtful)
    united = unite(vi_map, votes, options.min_merge_observations)
    counts = {FEW_OBSERVATIONS: united.too_few, SAME_IMAGE: united.seen_together}
    refused |= {reason: count for reason, count in counts.items() if count}
    absorbed, survivor = _into_best(vi_map, united.first, united.second)
    merged = merge_landmarks(vi_map, absorbed, survivor)
    ids = vi_map.landmarks.id[np.unique(survivor)]
    return _triangulated(merged, merged.landmark_index.rows(ids)), MergeResult(
        landmarks_merged=len(vi_map.landmarks) - len(merged.landmarks),
        observations_moved=int(np.count_nonzero(np.isin(vi_map.keypoints.landmark, absorbed))),
        refused=refused,
        first=united.first,
        second=united.second,
        closure=closure[rows[united.vote]],
        wanted=united.wanted,
    )


def _triangulated(vi_map: VIMap, landmarks: I64) -> VIMap:
    """Move landmarks to the points nearest to all their rays where these are better determined."""
    keypoints = vi_map.observations[ragged_rows(vi_map.observation_start, landmarks)]
    start = starts_of_counts(np.diff(vi_map.observation_start)[landmarks])
    p_G, _, is_usable = triangulate_keypoints(vi_map, keypoints, start)
    landmarks, p_G = landmarks[is_usable], p_G[is_usable]
    moved = with_p_G(vi_map, landmarks, p_G)
    better = predicted_sigma(moved, landmarks) < predicted_sigma(vi_map, landmarks)
    return with_p_G(vi_map, landmarks[better], p_G[better])


def _into_best(vi_map: VIMap, first: I64, second: I64) -> tuple[I64, I64]:
    """Return the landmarks (N,) that are absorbed and the best member (N,) of each one's component."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    members, row = np.unique(np.concatenate([first, second]), return_inverse=True)
    a, b = row[: len(first)], row[len(first) :]
    links = coo_array((np.ones(len(a), dtype=np.int8), (a, b)), shape=(len(members),) * 2)
    groups, group = connected_components(links, directed=False)
    sigma_m = predicted_sigma(vi_map, members)
    order = np.lexsort((members, sigma_m, -vi_map.landmarks.quality[members], group))
    begins = np.searchsorted(group[order], np.arange(groups))
    survivor = members[order[begins]][group]
    absorbed = survivor != members
    return members[absorbed], survivor[absorbed]


def _mergeable(vi_map: VIMap, closures: Closures) -> NDArray[np.bool_]:
    """Return which closures lie within a mission or join two missions with known base frames."""
    query = vi_map.vertices.mission[closures.query_vertex]
    place = vi_map.vertices.mission[closures.place_vertex]
    known = vi_map.baseframes.is_known[vi_map.missions.baseframe]
    return np.asarray((query == place) | (known[query] & known[place]))
