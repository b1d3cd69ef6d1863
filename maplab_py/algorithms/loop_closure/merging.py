"""Which landmarks of verified closures are one point, and uniting them."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.loop_closure.agreement import compare_landmarks
from maplab_py.algorithms.loop_closure.closures import Closures
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.vimap import VIMap
from maplab_py.vimap.edits import merge_landmarks
from maplab_py.vision.track_union import unite_tracks

I64 = NDArray[np.int64]
F64 = NDArray[np.float64]

FEW_OBSERVATIONS = "too few verified observations agree"
TOO_FAR = "too far apart once the closure is applied"
UNLIKELY = "farther apart than their rays allow"
SAME_IMAGE = "both seen in one image"
GAP = "the closure corrects too much: relax first"
UNKNOWN_BASE_FRAME = "between missions without known base frames: anchor first"


@dataclasses.dataclass(frozen=True, eq=False)
class MergeResult:
    """What merging did, and because of which closures."""

    landmarks_merged: int
    observations_moved: int
    refused: dict[str, int]  # landmark pairs by reason
    first: I64  # (P,) landmark rows of united pairs before, one row per closure that speaks for it
    second: I64  # (P,)
    closure: I64  # (P,) row of the closure
    wanted: int  # closures that had to agree


def merge_verified_landmarks(
    vi_map: VIMap, closures: Closures, options: LoopClosureOptions
) -> tuple[VIMap, MergeResult]:
    """Unite the landmarks of query keypoints with the database landmarks that they were matched to."""
    refused: dict[str, int] = {}
    closure = np.repeat(np.arange(len(closures)), np.diff(closures.start))
    source = vi_map.keypoints.landmark[closures.keypoint].astype(np.int64)
    open_ = closures.accepted[closure] & (source >= 0) & (source != closures.landmark)

    def refuse(reason: str, mask: NDArray[np.bool_]) -> None:
        if mask.any():
            pairs = np.stack([source[mask], closures.landmark[mask]], axis=1)
            refused[reason] = len(np.unique(pairs, axis=0))

    unknown = open_ & ~_mergeable(vi_map, closures)[closure]
    refuse(UNKNOWN_BASE_FRAME, unknown)
    open_ &= ~unknown
    gap = open_ & (closures.correction_m[closure] > options.max_merge_gap_m)
    refuse(GAP, gap)
    open_ &= ~gap
    rows = np.flatnonzero(open_)
    target = closures.landmark[rows]
    found = compare_landmarks(
        vi_map, closures, closure[rows], source[rows], target, options.ransac_pixel_sigma
    )
    allowed = np.maximum(
        options.max_merge_distance_m, options.max_merge_distance_ratio * found.depth_m
    )
    near = found.gap_m <= allowed
    likely = found.squared_sigmas <= options.max_merge_sigma**2
    for reason, which in ((TOO_FAR, ~near), (UNLIKELY, near & ~likely)):
        mask = np.zeros(len(source), dtype=np.bool_)
        mask[rows[which]] = True
        refuse(reason, mask)
    rows = rows[near & likely]

    pair, first, second, votes, bits = _pairs(
        source[rows], closures.landmark[rows], closures.query_vertex[closure[rows]],
        closures.bits[rows], len(vi_map.landmarks),
    )  # fmt: skip
    enough = votes >= options.min_merge_observations
    if not enough.all():
        refused[FEW_OBSERVATIONS] = int(np.count_nonzero(~enough))
    order = np.lexsort((second, first, bits, -votes))
    order = order[enough[order]]
    first, second = first[order], second[order]
    image = vi_map.keypoint_frame[vi_map.observations].astype(np.int64)
    fits = unite_tracks(first, second, vi_map.observation_start, image, len(vi_map.frames))
    if not fits.all():
        refused[SAME_IMAGE] = int(np.count_nonzero(~fits))
    merged = merge_landmarks(vi_map, first[fits], second[fits])
    moved = np.isin(vi_map.keypoints.landmark, first[fits])
    is_united = np.zeros(len(votes), dtype=np.bool_)
    is_united[order[fits]] = True
    speaks = np.flatnonzero(is_united[pair])
    return merged, MergeResult(
        landmarks_merged=len(vi_map.landmarks) - len(merged.landmarks),
        observations_moved=int(np.count_nonzero(moved)),
        refused=refused,
        first=source[rows[speaks]],
        second=closures.landmark[rows[speaks]],
        closure=closure[rows[speaks]],
        wanted=options.min_merge_observations,
    )


def _mergeable(vi_map: VIMap, closures: Closures) -> NDArray[np.bool_]:
    """Tell which closures lie in one mission, or join two with known base frames."""
    query = vi_map.vertices.mission[closures.query_vertex]
    place = vi_map.vertices.mission[closures.place_vertex]
    known = vi_map.baseframes.is_known[vi_map.missions.baseframe]
    return np.asarray((query == place) | (known[query] & known[place]))


def _pairs(
    source: I64, target: I64, query: I64, bits: NDArray[np.int32], size: int
) -> tuple[I64, I64, I64, I64, F64]:
    """Return pairs of landmarks, how many query vertices say so, and their mean bits.

    A pair is the same in both directions; the row that is larger merges into the smaller one.

    Returns:
        The pair of each match (N,); of each pair (P,) the two landmarks, votes and bits.
    """
    key = np.maximum(source, target) * size + np.minimum(source, target)
    key, pair = np.unique(key, return_inverse=True)
    span = int(query.max(initial=0)) + 1
    voters = np.unique(pair.astype(np.int64) * span + query)
    votes = np.bincount(voters // span, minlength=len(key))
    mean = np.bincount(pair, weights=bits, minlength=len(key)) / np.maximum(
        np.bincount(pair, minlength=len(key)), 1
    )
    return pair, key // size, key % size, votes.astype(np.int64), mean
