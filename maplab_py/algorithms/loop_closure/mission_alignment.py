"""Alignments of two missions that the closures between them vote for.

A closure of missions A and B gives the pose of frame A in frame B, up to drift. Closures that agree
support one alignment. Where places look alike there are several alignments, and a query may have
closures with several of them: it counts once for each. Support is counted in stretches of both
trajectories (`stretches`), because an alignment is a statement about both missions.
"""

import dataclasses
import functools
from typing import Any

import numpy as np

from maplab_py.array_types import F64, I64, Mask, NDArray, Rows
from maplab_py.geometry import se3, so3, yaw
from maplab_py.vimap import VIMap

_MAX_HYPOTHESES = 200
"""Number of closures that are tried as hypotheses for one alignment."""
_MAX_ALIGNMENTS = 5
_MIN_STRETCHES = 2
"""Stretches of either mission that an alignment needs to be listed; fewer may be a single error."""


_DRIFT_OFFSET_M, _DRIFT_RATIO = 0.5, 0.02
"""Drift, per arc length between closures in both missions, up to which they support the same alignment."""
_MAX_TURN_RAD = 0.3


class PairedClosures(Rows):
    """Closures (N,) between missions; A is the mission with the smaller row."""

    weight: F64  # inliers
    mission_A: I64
    mission_B: I64
    T_A_I: F64  # (N, 7) pose of the query in both missions
    T_B_I: F64  # (N, 7)

    @functools.cached_property
    def T_B_A(self) -> F64:
        """Frame A in frame B as position and yaw (N, 4)."""
        return yaw.from_pose(se3.compose(self.T_B_I, se3.inverse(self.T_A_I)))

    def rows_of_pairs(self, rows: I64 | None = None) -> dict[tuple[int, int], I64]:
        """Return the closures (of some rows, None = all) of each pair of missions."""
        rows = np.arange(len(self)) if rows is None else rows
        key = self.mission_A * (int(self.mission_B.max(initial=0)) + 1) + self.mission_B
        rows = rows[np.argsort(key[rows], kind="stable")]
        parts = np.split(rows, np.flatnonzero(np.diff(key[rows])) + 1)
        return {
            (int(self.mission_A[part[0]]), int(self.mission_B[part[0]])): part
            for part in parts
            if len(part)
        }


def ordered_by_mission(
    mission: tuple[I64, I64], *ends: tuple[NDArray[Any], NDArray[Any]]
) -> list[NDArray[Any]]:
    """Return values at both ends of closures, given as (the query's, the place's), of A and of B.

    Args:
        mission: Missions (N,), which come first.
        ends: Values (N, ...) at the ends.
    """
    swapped = mission[0] > mission[1]
    columns: list[NDArray[Any]] = []
    for query, place in (mission, *ends):
        is_swapped = swapped.reshape(-1, *[1] * (query.ndim - 1))
        columns += [np.where(is_swapped, place, query), np.where(is_swapped, query, place)]
    return columns


class LocatedClosures(PairedClosures):
    """Closures (N,) between missions with the places of their ends along the trajectories."""

    way_A_m: F64  # arc length along the missions to the ends of the closure
    way_B_m: F64
    stretch_A: I64  # stretches of the trajectories at the ends
    stretch_B: I64


@dataclasses.dataclass(frozen=True, eq=False)
class Alignment:
    """A relative pose of two missions and the closures that support it."""

    T_B_A: F64  # (4,) position and yaw of frame A in frame B
    rows: I64  # (K,) rows of the closures
    stretches_A: I64  # stretches of A's trajectory at the closures' ends, sorted
    stretches_B: I64

    @property
    def support(self) -> int:
        """Number of stretches of both trajectories."""
        return len(self.stretches_A) + len(self.stretches_B)

    def stretches(self, side: int) -> I64:
        """Return the stretches of A (side 0) or of B (side 1)."""
        return self.stretches_B if side else self.stretches_A


@dataclasses.dataclass(frozen=True, eq=False)
class MissionPair:
    """Two missions (or one and itself) and the alignments between them, best first."""

    mission_A: int
    mission_B: int
    rows: I64  # (K,) rows of all closures between the two
    alignments: tuple[Alignment, ...]

    @property
    def missions(self) -> tuple[int, int]:
        """Both rows."""
        return self.mission_A, self.mission_B


def alignments_of_pairs(closures: LocatedClosures, candidate: Mask) -> list[MissionPair]:
    """Return the alignments of every pair of missions that candidates (N,) join."""
    rows = closures.rows_of_pairs(np.flatnonzero(candidate))
    return [
        MissionPair(*ends, mine, _alignments(closures.take(mine), mine))
        for ends, mine in rows.items()
    ]


def _alignments(c: LocatedClosures, rows: I64) -> tuple[Alignment, ...]:
    """Take the alignment with most support, remove its closures, and repeat; share them out at last."""
    from scipy.sparse import csr_array

    stretch = np.concatenate([c.stretch_A, c.stretch_B + c.stretch_A.max(initial=0) + 1])
    column = np.unique(stretch, return_inverse=True)[1]
    ends = (np.tile(np.arange(len(rows)), 2), column)
    sees = csr_array((np.ones(len(column), dtype=np.int32), ends))
    left = np.arange(len(rows))
    hypotheses: list[int] = []
    while len(left) and len(hypotheses) < _MAX_ALIGNMENTS:
        pick = np.linspace(0, len(left) - 1, min(len(left), _MAX_HYPOTHESES)).astype(np.int64)
        tried = left[np.unique(pick)]
        agree = _error(c, tried, left) < 1.0
        support = ((csr_array(agree.astype(np.int32)) @ sees[left]) > 0).sum(axis=1)
        best = int(np.lexsort((-(agree @ c.weight[left]), -support))[0])
        mine = left[agree[best]]
        ends_of_mine = np.unique(c.stretch_A[mine]), np.unique(c.stretch_B[mine])
        if (hypotheses and min(map(len, ends_of_mine)) < _MIN_STRETCHES) or not len(mine):
            break  # nothing agrees with a closure that contains no number
        hypotheses.append(int(tried[best]))
        left = left[~agree[best]]
    # drift allows for several alignments far from where they were found: the nearest is meant
    error = _error(c, np.array(hypotheses, dtype=np.int64), np.arange(len(rows)))
    nearest = np.argmin(error, axis=0) if hypotheses else np.zeros(len(rows), dtype=np.int64)
    alignments = []
    for number, hypothesis in enumerate(hypotheses):
        mine = np.flatnonzero((nearest == number) & (error[number] < 1.0))
        stretches = np.unique(c.stretch_A[mine]), np.unique(c.stretch_B[mine])
        alignments.append(Alignment(c.T_B_A[hypothesis], rows[mine], *stretches))
    return tuple(sorted(alignments, key=lambda alignment: -alignment.support))


def _error(c: LocatedClosures, hypothesis: I64, rows: I64) -> F64:
    """Return the errors (H, L) of closures under hypotheses; below 1 they agree."""
    h, E = hypothesis[:, None], c.T_B_A
    p_B = yaw.transform(E[h], c.T_A_I[None, rows, 4:])
    apart = np.linalg.norm(p_B - c.T_B_I[None, rows, 4:], axis=2)
    between = np.abs(c.way_A_m[rows] - c.way_A_m[h]) + np.abs(c.way_B_m[rows] - c.way_B_m[h])
    turn = np.abs(yaw.wrap(E[h, 3] - E[None, rows, 3]))
    of_position = apart / (_DRIFT_OFFSET_M + _DRIFT_RATIO * between)
    error = np.maximum(of_position, turn / _MAX_TURN_RAD)
    return np.asarray(np.where(np.isnan(error), np.inf, error))


# Stretches of trajectories: what counts as one observation of a place.
#
# Neighbouring images see the same landmarks, so their closures are no independent evidence, and a
# device at rest would outvote everything else. Evidence is therefore counted in stretches, within
# which the body moves by about a metre or turns by about a radian.

_LENGTH = 1.0
"""Length of a stretch: metres travelled plus radians turned."""


def trajectory_stretches(vi_map: VIMap) -> I64:
    """Return the number of the stretch (V,) of each vertex, increasing over the whole map."""
    T, mission = vi_map.vertices.T_M_I, vi_map.vertices.mission
    if len(T) == 0:
        return np.zeros(0, dtype=np.int64)
    turn = so3.log(so3.multiply(so3.inverse(T[:-1, :4]), T[1:, :4]))
    motion = np.linalg.norm(np.diff(T[:, 4:], axis=0), axis=1) + np.linalg.norm(turn, axis=1)
    starts = mission[1:] != mission[:-1]
    motion[starts] = 0.0
    travelled = np.append(0.0, np.cumsum(motion))
    first = vi_map.vertex_start[:-1][mission]
    within = np.floor((travelled - travelled[first]) / _LENGTH).astype(np.int64)
    begins = np.append(True, (np.diff(within) > 0) | starts)
    return np.asarray(np.cumsum(begins) - 1)


# Negative evidence: where an alignment lets two trajectories see the same landmarks, and they do not match.
#
# Two cameras that are nearly in the same place and look the same way have common landmarks in view. If
# the alignment of two missions is right, most such stretches of the trajectories have a closure.


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
