"""Merge landmarks that verified closures identify as the same point."""

import dataclasses

import numpy as np

from maplab_py.algorithms.landmarks.evidence import with_inherited
from maplab_py.algorithms.landmarks.keypoint_rays import landmark_covariance
from maplab_py.algorithms.landmarks.quality import predicted_sigma
from maplab_py.algorithms.landmarks.triangulation import triangulate_keypoints
from maplab_py.algorithms.loop_closure.closure_table import Closures
from maplab_py.algorithms.loop_closure.features import points_in_mission
from maplab_py.algorithms.loop_closure.guided_matching import LandmarkMatches, guided_matches
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.reports import GAP, UNKNOWN_BASE_FRAME
from maplab_py.array_types import F64, I64, Mask, NDArray, Rows, mask_of
from maplab_py.distinct import distinct
from maplab_py.geometry import se3, so3
from maplab_py.vimap import VIMap, edits, observer_counts, ragged_rows, starts_of_counts
from maplab_py.vimap.table import connected_groups
from maplab_py.vision.point_covariance import ClosurePoses, LandmarkPairs, squared_sigmas
from maplab_py.vision.track_union import unite_tracks

FEW_OBSERVATIONS = "too few verified observations agree"
TOO_FAR = "too far apart once the closure is applied"
UNLIKELY = "farther apart than their rays allow"
SAME_IMAGE = "both seen in one image"


class MergeResult(Rows):
    """Result of merging: rows of pairs of landmarks (rows before) and closures that support their merge."""

    landmarks_merged: int
    observations_moved: int
    refused: dict[str, int]  # landmark pairs by reason
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
    more = dataclasses.replace(more, first=row_before[more.first], second=row_before[more.second])
    return remerged, dataclasses.replace(
        MergeResult.concatenate([result, more]),
        landmarks_merged=result.landmarks_merged + more.landmarks_merged,
        observations_moved=result.observations_moved + more.observations_moved,
    )


def _merge(
    vi_map: VIMap, closures: Closures, matches: LandmarkMatches, options: LoopClosureOptions
) -> tuple[VIMap, MergeResult]:
    """Merge the landmarks of matches (rows of the map) that pass the tests."""
    refused: dict[str, int] = {}
    closure = matches.closure
    source = vi_map.keypoints.landmark[matches.keypoint].astype(np.int64)
    target = matches.landmark

    def without(reason: str, rows: I64, refusing: Mask) -> I64:
        if refusing.any():
            pairs = np.stack([source[rows[refusing]], target[rows[refusing]]], axis=1)
            refused[reason] = len(np.unique(pairs, axis=0))
        return rows[~refusing]

    rows = np.flatnonzero((source >= 0) & (source != target))
    rows = without(UNKNOWN_BASE_FRAME, rows, ~_mergeable(vi_map, closures)[closure[rows]])
    rows = without(GAP, rows, closures.correction_m[closure[rows]] > options.max_merge_gap_m)
    distance = compare_landmarks(
        vi_map, closures, closure[rows], source[rows], target[rows], options.ransac_pixel_sigma
    )
    near = distance.gap_m <= np.maximum(
        options.max_merge_distance_m, options.max_merge_distance_ratio * distance.depth_m
    )
    likely = distance.squared_sigmas <= options.max_merge_sigma**2
    without(TOO_FAR, rows, ~near)
    without(UNLIKELY, rows, near & ~likely)
    rows = rows[near & likely]
    query = closures.query_vertex[closure[rows]]
    is_doubtful = distance.is_doubtful(options.max_merge_distance_m)[near & likely]
    votes = Votes(source[rows], target[rows], query, matches.bits[rows], is_doubtful)
    united = unite(vi_map, votes, options.min_merge_observations)
    counts = {FEW_OBSERVATIONS: united.too_few, SAME_IMAGE: united.seen_together}
    refused |= {reason: count for reason, count in counts.items() if count}
    absorbed, survivor = _into_best(vi_map, united.first, united.second)
    merged = edits.merge_landmarks(with_inherited(vi_map, absorbed, survivor), absorbed, survivor)
    ids = vi_map.landmarks.id[np.unique(survivor)]
    return _triangulate(merged, merged.landmark_index.rows(ids)), MergeResult(
        landmarks_merged=len(vi_map.landmarks) - len(merged.landmarks),
        observations_moved=int(np.count_nonzero(np.isin(vi_map.keypoints.landmark, absorbed))),
        refused=refused,
        first=united.first,
        second=united.second,
        closure=closure[rows[united.vote]],
        wanted=united.wanted,
    )


def _triangulate(vi_map: VIMap, landmarks: I64) -> VIMap:
    """Move landmarks to the points nearest to all their rays where these are better determined."""
    keypoints = vi_map.observations[ragged_rows(vi_map.observation_start, landmarks)]
    start = starts_of_counts(np.diff(vi_map.observation_start)[landmarks])
    p_G, _, is_usable = triangulate_keypoints(vi_map, keypoints, start)
    landmarks, p_G = landmarks[is_usable], p_G[is_usable]
    moved = edits.with_p_G(vi_map, landmarks, p_G)
    better = predicted_sigma(moved, landmarks) < predicted_sigma(vi_map, landmarks)
    return edits.with_p_G(vi_map, landmarks[better], p_G[better])


def _into_best(vi_map: VIMap, first: I64, second: I64) -> tuple[I64, I64]:
    """Return the landmarks (N,) that are absorbed and the best member (N,) of each one's component."""
    members, row = np.unique(np.concatenate([first, second]), return_inverse=True)
    group = connected_groups(row[: len(first)], row[len(first) :], len(members))
    sigma_m = predicted_sigma(vi_map, members)
    order = np.lexsort((members, sigma_m, -vi_map.landmarks.quality[members], group))
    begins = np.searchsorted(group[order], np.arange(int(group.max(initial=-1)) + 1))
    survivor = members[order[begins]][group]
    absorbed = survivor != members
    return members[absorbed], survivor[absorbed]


def _mergeable(vi_map: VIMap, closures: Closures) -> NDArray[np.bool_]:
    """Return which closures lie within a mission or join two missions with known base frames."""
    query = vi_map.vertices.mission[closures.query_vertex]
    place = vi_map.vertices.mission[closures.place_vertex]
    known = vi_map.baseframes.is_known[vi_map.missions.baseframe]
    return np.asarray((query == place) | (known[query] & known[place]))


_POSE_DRIFT = 0.01
"""Standard deviation of a landmark due to errors of observing poses, relative to its distance."""
_APART_RATIO = 0.1
"""Distance of two landmarks, relative to their depth, beyond which a pair is doubtful."""
_DOUBTFUL_SQUARED_SIGMAS = 6.25
"""Exceeded by a tenth of the pairs that are one point: chi square of three degrees of freedom."""


@dataclasses.dataclass(frozen=True, eq=False)
class Agreement:
    """Distances of landmarks of the query and the place after the closure is applied."""

    gap_m: F64  # (N,) between them
    depth_m: F64  # (N,) of the place's landmark from the query
    squared_sigmas: F64  # (N,) squared Mahalanobis distance, three degrees of freedom

    def is_doubtful(self, distance_m: float) -> Mask:
        """Return which pairs (N,) are unlikely the same point, or far apart since their depths are uncertain.

        These are the tenth of the true pairs that is farthest apart in deviations, and pairs farther
        apart than a distance and a tenth of their depth.
        """
        is_apart = self.gap_m > np.maximum(distance_m, _APART_RATIO * self.depth_m)
        return np.asarray(is_apart | (self.squared_sigmas > _DOUBTFUL_SQUARED_SIGMAS))


def compare_landmarks(
    vi_map: VIMap, closures: Closures, closure: I64, source: I64, target: I64, sigma_px: float
) -> Agreement:
    """Compare landmarks of queries with those of places.

    Args:
        closure: Row of the closure (N,) that matched them; its covariance is known.
        source: Landmark (N,) that the query sees.
        target: Landmark (N,) of the place.
        sigma_px: Standard deviation of keypoints.
    """
    query = closures.query_vertex
    mission = vi_map.vertices.mission[closures.place_vertex].astype(np.int64)
    T_M_I = closures.T_M_I
    T_I_G = se3.inverse(vi_map.T_G_I[query])
    p_I = se3.transform(T_I_G[closure], vi_map.p_G[source])
    p_M = points_in_mission(vi_map, target, mission[closure])
    gap_M = se3.transform(T_M_I[closure], p_I) - p_M
    depth_m = np.linalg.norm(p_M - T_M_I[closure, 4:], axis=1)
    landmarks, row = np.unique(np.concatenate([source, target]), return_inverse=True)
    pairs = LandmarkPairs(
        gap_M, p_I, _POSE_DRIFT * depth_m, closure, row[: len(source)], row[len(source) :]
    )
    poses = ClosurePoses(
        R_M_Gq=so3.to_matrix(se3.compose(T_M_I, T_I_G)[:, :4]),
        R_M_G=so3.to_matrix(se3.inverse(vi_map.T_G_M)[mission, :4]),
        R_M_I=so3.to_matrix(T_M_I[:, :4]),
        covariance=closures.covariance,
    )
    squared = squared_sigmas(pairs, landmark_covariance(vi_map, landmarks, sigma_px), poses)
    return Agreement(np.asarray(np.linalg.norm(gap_M, axis=1)), depth_m, squared)


_ROUNDS = 4
"""Merged landmarks collect the votes of their members; later rounds merge next to nothing."""


@dataclasses.dataclass(frozen=True, eq=False)
class Votes:
    """Verified observations (N,) that two landmarks are one point."""

    first: I64  # (N,) landmark that the query observes
    second: I64  # (N,) landmark that it was matched with
    query: I64  # (N,) query vertex
    bits: NDArray[np.int32]  # (N,) different bits
    is_doubtful: Mask  # (N,) the positions say little for one point; see `Agreement.is_doubtful`


class United(Rows):
    """Pairs of landmarks to merge, one row per vote for them."""

    first: I64  # (P,)
    second: I64  # (P,)
    vote: I64  # (P,) row of `Votes`
    wanted: I64  # (P,) query vertices that had to agree
    too_few: int  # pairs that fewer query vertices support
    seen_together: int  # pairs that one image sees both of


@dataclasses.dataclass(frozen=True, eq=False)
class Pairs:
    """Pairs (P,) of landmarks, `first` the larger row."""

    of_vote: I64  # (N,)
    first: I64
    second: I64
    votes: I64  # query vertices that support the pair
    bits: F64  # mean number of different bits
    is_doubtful: Mask  # according to any vote


def unite(vi_map: VIMap, votes: Votes, min_votes: int) -> United:
    """Return the pairs that enough query vertices support and no image contradicts.

    A pair needs `min_votes` query vertices, or all vertices that observe one of the two landmarks where
    they are fewer: after keyframing many landmarks have a single observer. Doubtful pairs need one
    more. Votes are counted again after merging: those for several landmarks that were merged are votes
    for one.

    Args:
        votes: Verified observations; the landmarks of a vote differ.
        min_votes: Number of query vertices.
    """
    count = len(vi_map.landmarks)
    image = vi_map.keypoint_frame[vi_map.observations].astype(np.int64)
    observers = observer_counts(vi_map)
    label = np.arange(count)
    links = np.zeros((2, 0), dtype=np.int64)
    none = np.zeros(0, dtype=np.int64)
    parts = [United(none, none, none, none, 0, 0)]
    for _ in range(_ROUNDS):
        pairs = count_pairs(votes, label)
        wanted = np.minimum(observers[pairs.first], observers[pairs.second])
        wanted = np.minimum(wanted, min_votes + pairs.is_doubtful)
        enough = pairs.votes >= wanted
        order = np.lexsort((pairs.second, pairs.first, pairs.bits, -pairs.votes))
        order = order[enough[order]]
        both = np.stack([pairs.first[order], pairs.second[order]])
        # what earlier rounds have merged comes first
        first, second = np.concatenate([links, both], axis=1)
        fits = unite_tracks(first, second, vi_map.observation_start, image, len(vi_map.frames))
        fits = fits[links.shape[1] :]
        if not fits.any():
            break
        is_united = mask_of(len(pairs.votes) + 1, order[fits])
        vote = np.flatnonzero(is_united[pairs.of_vote])
        of_vote = pairs.of_vote[vote]
        parts.append(
            United(pairs.first[of_vote], pairs.second[of_vote], vote, wanted[of_vote], 0, 0)
        )
        links = np.concatenate([links, both[:, fits]], axis=1)
        label = _components(links, count)
        np.maximum.at(observers, label, observers)
    return dataclasses.replace(
        United.concatenate(parts),
        too_few=int(np.count_nonzero(~enough)),
        seen_together=int(np.count_nonzero(~fits)),
    )


def count_pairs(votes: Votes, label: I64) -> Pairs:
    """Count the votes for pairs of landmarks.

    A pair is the same in both directions. Votes for landmarks that are merged belong to pair -1.

    Args:
        votes: Verified observations.
        label: Landmark (L,) that each landmark has been merged into.
    """
    count = max(len(label), 1)
    a, b = label[votes.first], label[votes.second]
    open_ = np.flatnonzero(a != b)
    key = np.maximum(a, b)[open_] * count + np.minimum(a, b)[open_]
    key, pair = np.unique(key, return_inverse=True)
    pair = pair.astype(np.int64)
    span = int(votes.query.max(initial=0)) + 1
    voters = distinct(pair * span + votes.query[open_])
    number = np.bincount(voters // span, minlength=len(key))
    mean = np.bincount(pair, weights=votes.bits[open_], minlength=len(key)) / np.maximum(
        np.bincount(pair, minlength=len(key)), 1
    )
    of_vote = np.full(len(a), -1, dtype=np.int64)
    of_vote[open_] = pair
    is_doubtful = np.bincount(pair, weights=votes.is_doubtful[open_], minlength=len(key)) > 0
    return Pairs(of_vote, key // count, key % count, number, mean, is_doubtful)


def _components(links: I64, count: int) -> I64:
    """Return the smallest row (count,) that each landmark is connected with by links (2, N)."""
    label = connected_groups(links[0], links[1], count)
    smallest = np.full(count, count, dtype=np.int64)
    np.minimum.at(smallest, label, np.arange(count))
    return np.asarray(smallest[label])
