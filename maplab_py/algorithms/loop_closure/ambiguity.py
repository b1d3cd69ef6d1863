"""Ambiguous places: queries that match several places of a mission, or a distant place of their own.

A mission is rigid up to its drift, so a query cannot be at two of its places at once. If it matches
two places about equally well, its appearance does not determine the place. A closure with a third
mission that observed only one of the two places is then unreliable too.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.array_types import F64, I64, Mask
from maplab_py.geometry import se3, so3


@dataclasses.dataclass(frozen=True)
class AmbiguityRule:
    """Criteria for distinct places and for a significant second place."""

    drift_offset_m: float
    drift_ratio: float  # fraction of the arc length between the places
    max_turn_rad: float = 0.3
    min_inliers: int = 20  # of a distant place of the query's mission


def rival_shares(
    query_vertex: I64,
    place_way_m: F64,
    place_mission: I64,
    T_M_I: F64,
    inliers: I64,
    is_far_same_mission: Mask,
    candidate: Mask,
    rule: AmbiguityRule,
) -> F64:
    """Return the inliers (N,) of each query's strongest other place relative to the best place.

    A distant place of the query's mission counts as equally strong.

    Args:
        query_vertex: Query (N,) of each closure.
        place_way_m: Arc length (N,) of the place along its mission.
        place_mission: Mission (N,) of the place.
        T_M_I: Estimated poses (N, 7).
        inliers: Inliers (N,).
        is_far_same_mission: Closures (N,) with a place of the query's mission beyond any plausible drift.
        candidate: Closures (N,) that passed the geometric gates.
        rule: Criteria for distinct places.
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
    queries, of_closure = np.unique(query_vertex, return_inverse=True)
    shares = np.zeros(len(queries))
    share = inliers[order] / np.maximum(inliers[best], 1)
    np.maximum.at(shares, of_closure[order], np.where(is_other, share, 0.0))
    far = candidate & is_far_same_mission & (inliers >= rule.min_inliers)
    np.maximum.at(shares, of_closure[far], 1.0)
    return np.asarray(shares[of_closure])
