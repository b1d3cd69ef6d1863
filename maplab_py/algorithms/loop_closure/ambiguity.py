"""Places that look alike: queries that fit several places of one mission, or a far one of their own.

A mission is rigid up to its drift, so a query cannot be in two of its places at once. When it fits
two about equally well, its looks do not tell where it is, and a closure with a third mission, which
may have seen only one of the two, is no better.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.geometry import se3, so3

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclasses.dataclass(frozen=True)
class AmbiguityRule:
    """When two places are two, and when the second one counts."""

    drift_offset_m: float
    drift_ratio: float  # of the way between the places
    max_turn_rad: float = 0.3
    inlier_share: float = 0.5  # that the second place needs of the best one's
    min_inliers: int = 20  # of a far place of the query's own mission


def ambiguous_queries(
    query_vertex: I64,
    place_way_m: F64,
    place_mission: I64,
    T_M_I: F64,
    inliers: I64,
    is_far_own: Mask,
    candidate: Mask,
    rule: AmbiguityRule,
) -> I64:
    """Return the query vertices that fit several places.

    Args:
        query_vertex: Query (N,) of each closure.
        place_way_m: Way along its mission (N,) of the place.
        place_mission: Mission (N,) of the place.
        T_M_I: Poses found (N, 7).
        inliers: Inliers (N,).
        is_far_own: Closures (N,) with a place of the query's own mission that is beyond any drift.
        candidate: Closures (N,) that passed the geometric gates.
        rule: When two places are two.
    """
    rows = np.flatnonzero(candidate)
    order = rows[np.lexsort((-inliers[rows], place_mission[rows], query_vertex[rows]))]
    is_best = np.ones(len(order), dtype=np.bool_)
    is_best[1:] = (query_vertex[order[1:]] != query_vertex[order[:-1]]) | (
        place_mission[order[1:]] != place_mission[order[:-1]]
    )
    best = order[np.flatnonzero(is_best)[np.cumsum(is_best) - 1]] if len(order) else order
    apart = np.linalg.norm(T_M_I[order, 4:] - T_M_I[best, 4:], axis=1)
    between = se3.relative(T_M_I[best], T_M_I[order])
    turn = np.linalg.norm(so3.log(between[:, :4]), axis=1)
    drift = rule.drift_offset_m + rule.drift_ratio * np.abs(place_way_m[order] - place_way_m[best])
    is_other = (apart > drift) | (turn > rule.max_turn_rad)
    rivals = is_other & (inliers[order] >= rule.inlier_share * inliers[best])
    own = rows[is_far_own[rows] & (inliers[rows] >= rule.min_inliers)]
    return np.union1d(query_vertex[order[rivals]], query_vertex[own])
