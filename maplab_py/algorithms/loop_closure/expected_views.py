"""Negative evidence: where an alignment lets two trajectories see the same landmarks, and they do not match.

Two cameras that are nearly in the same place and look the same way have common landmarks in view. If
the alignment of two missions is right, most such stretches of the trajectories have a closure.
"""

from __future__ import annotations

import numpy as np

from maplab_py.algorithms.loop_closure.mission_alignment import Alignment, MissionPair
from maplab_py.array_types import F64, I64
from maplab_py.geometry import se3, so3, yaw
from maplab_py.vimap import VIMap

_NEAR_M, _NEAR_RAD = 0.75, 0.35
"""Differences of two camera poses up to which what one sees must be in view of the other."""
_REFUTED_SHARE = 0.5
_MIN_EXPECTED = 10
"""An alignment is refuted when more than half of the stretches, of at least so many, lack a match that
they must have, and the best alignment does better by half."""
_NEIGHBOURS = 64
_SAME_VISIT_M = 5.0
"""Arc length below which vertices of one mission are the same visit."""


def unmatched_share(vi_map: VIMap, pair: MissionPair, alignment: Alignment, stretch: I64) -> float:
    """Return the share of stretches without a match among those that must have one.

    Args:
        vi_map: The map.
        pair: Two missions, or a mission and itself.
        alignment: One of their alignments.
        stretch: Stretch (V,) of each vertex; its numbers increase along a mission.
    """
    start, T_M_I = vi_map.vertex_start, vi_map.vertices.T_M_I
    rows_A = np.arange(start[pair.mission_A], start[pair.mission_A + 1])
    rows_B = np.arange(start[pair.mission_B], start[pair.mission_B + 1])
    T_B_I = se3.compose(yaw.to_pose(alignment.T_B_A), T_M_I[rows_A])
    seen_A, seen_B = _coordinates(T_B_I), _coordinates(T_M_I[rows_B])
    if pair.mission_A == pair.mission_B:
        must_see = _visited_again(seen_A, seen_B, stretch[rows_A])
        has_match = np.isin(must_see, np.union1d(alignment.stretches_A, alignment.stretches_B))
    else:
        in_A, in_B = (
            np.unique(stretch[rows[_has_neighbour(mine, others)]])
            for rows, mine, others in ((rows_A, seen_A, seen_B), (rows_B, seen_B, seen_A))
        )
        has_match = np.concatenate(
            [np.isin(in_A, alignment.stretches_A), np.isin(in_B, alignment.stretches_B)]
        )
    return 1.0 - float(np.mean(has_match)) if len(has_match) >= _MIN_EXPECTED else 0.0


def is_refuted(unmatched: float, best_unmatched: float) -> bool:
    """Return whether the landmarks that must be in view under an alignment are never matched."""
    return unmatched > max(_REFUTED_SHARE, 1.5 * best_unmatched)


def _has_neighbour(mine: F64, others: F64) -> F64:
    from scipy.spatial import cKDTree

    distance, _ = cKDTree(others).query(mine, p=np.inf, distance_upper_bound=1.0)
    return np.asarray(np.isfinite(distance))


def _visited_again(moved: F64, poses: F64, stretch: I64) -> I64:
    """Return the stretches of a mission that a displacement brings to another visit of the mission."""
    from scipy.spatial import cKDTree

    count = min(_NEIGHBOURS, len(poses))
    distance, near = cKDTree(poses).query(
        moved, k=np.arange(1, count + 1), p=np.inf, distance_upper_bound=1.0
    )
    other = np.append(stretch, stretch[0])[near]
    again = np.isfinite(distance) & (np.abs(other - stretch[:, None]) > _SAME_VISIT_M)
    return np.union1d(stretch[again.any(axis=1)], np.unique(other[again]))


def _coordinates(T: F64) -> F64:
    """Return coordinates (N, 9) of poses in which poses with a common view differ by at most 1."""
    axes = so3.to_matrix(T[:, :4])[:, :, :2].transpose(0, 2, 1).reshape(len(T), 6)
    return np.concatenate([T[:, 4:] / _NEAR_M, axes / _NEAR_RAD], axis=1)
