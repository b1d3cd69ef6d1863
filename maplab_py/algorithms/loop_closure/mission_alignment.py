"""Alignments of two missions that the closures between them vote for.

A closure of missions A and B gives the pose of frame A in frame B, up to drift. Closures that agree
support one alignment. Where places look alike there are several alignments, and a query may have
closures with several of them: it counts once for each. Support is counted in stretches of both
trajectories (`stretches`), because an alignment is a statement about both missions.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.array_types import F64, I64, Mask
from maplab_py.geometry import se3, so3, yaw
from maplab_py.vimap import VIMap

_MAX_HYPOTHESES = 200
"""Number of closures that are tried as hypotheses for one alignment."""
_MAX_ALIGNMENTS = 5
_MIN_STRETCHES = 2
"""Stretches of either mission that an alignment needs to be listed; fewer may be a single error."""


@dataclasses.dataclass(frozen=True)
class AgreementRule:
    """Criteria for closures that support the same alignment."""

    drift_offset_m: float = 0.5
    drift_ratio: float = 0.02  # per arc length between the closures, in both missions
    max_turn_rad: float = 0.3


@dataclasses.dataclass(frozen=True, eq=False)
class PairedClosures:
    """Closures (N,) between missions; A is the mission with the smaller row."""

    mission_A: I64
    mission_B: I64
    T_A_I: F64  # (N, 7) pose of the query in both missions
    T_B_I: F64  # (N, 7)
    way_A_m: F64  # arc length along the missions to the ends of the closure
    way_B_m: F64
    stretch_A: I64  # stretches of the trajectories at the ends
    stretch_B: I64
    weight: F64  # inliers

    @classmethod
    def of(
        cls,
        mission: tuple[I64, I64],
        T_I: tuple[F64, F64],
        way_m: tuple[F64, F64],
        stretch: tuple[I64, I64],
        weight: F64,
    ) -> PairedClosures:
        """Order the two ends of closures, given as (the query's, the place's), by mission."""
        swapped = mission[0] > mission[1]
        T_A_I, T_B_I = (np.where(swapped[:, None], T_I[1 - end], T_I[end]) for end in (0, 1))
        way_A, way_B = (np.where(swapped, way_m[1 - end], way_m[end]) for end in (0, 1))
        at_A, at_B = (np.where(swapped, stretch[1 - end], stretch[end]) for end in (0, 1))
        first, second = np.minimum(*mission), np.maximum(*mission)
        return cls(first, second, T_A_I, T_B_I, way_A, way_B, at_A, at_B, weight)

    def take(self, rows: I64) -> PairedClosures:
        """Return the closures of a mask or rows."""
        return PairedClosures(
            *(getattr(self, field.name)[rows] for field in dataclasses.fields(self))
        )


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


def alignments_of_pairs(
    closures: PairedClosures, candidate: Mask, rule: AgreementRule
) -> list[MissionPair]:
    """Return the alignments of every pair of missions that candidates (N,) join."""
    rows = np.flatnonzero(candidate)
    key = closures.mission_A * (int(closures.mission_B.max(initial=0)) + 1) + closures.mission_B
    rows = rows[np.argsort(key[rows], kind="stable")]
    # frame A in frame B
    E = yaw.from_pose(se3.compose(closures.T_B_I, se3.inverse(closures.T_A_I)))
    pairs = []
    for mine in np.split(rows, np.flatnonzero(np.diff(key[rows])) + 1):
        if len(mine):
            alignments = _alignments(closures.take(mine), E[mine], mine, rule)
            ends = int(closures.mission_A[mine[0]]), int(closures.mission_B[mine[0]])
            pairs.append(MissionPair(*ends, mine, alignments))
    return pairs


def _alignments(c: PairedClosures, E: F64, rows: I64, rule: AgreementRule) -> tuple[Alignment, ...]:
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
        agree = _error(E, c, tried, left, rule) < 1.0
        support = ((csr_array(agree.astype(np.int32)) @ sees[left]) > 0).sum(axis=1)
        best = int(np.lexsort((-(agree @ c.weight[left]), -support))[0])
        mine = left[agree[best]]
        ends_of_mine = np.unique(c.stretch_A[mine]), np.unique(c.stretch_B[mine])
        if (hypotheses and min(map(len, ends_of_mine)) < _MIN_STRETCHES) or not len(mine):
            break  # nothing agrees with a closure that contains no number
        hypotheses.append(int(tried[best]))
        left = left[~agree[best]]
    # drift allows for several alignments far from where they were found: the nearest is meant
    error = _error(E, c, np.array(hypotheses, dtype=np.int64), np.arange(len(rows)), rule)
    nearest = np.argmin(error, axis=0) if hypotheses else np.zeros(len(rows), dtype=np.int64)
    alignments = []
    for number, hypothesis in enumerate(hypotheses):
        mine = np.flatnonzero((nearest == number) & (error[number] < 1.0))
        stretches = np.unique(c.stretch_A[mine]), np.unique(c.stretch_B[mine])
        alignments.append(Alignment(E[hypothesis], rows[mine], *stretches))
    return tuple(sorted(alignments, key=lambda alignment: -alignment.support))


def _error(E: F64, c: PairedClosures, hypothesis: I64, rows: I64, rule: AgreementRule) -> F64:
    """Return the errors (H, L) of closures under hypotheses; below 1 they agree."""
    h = hypothesis[:, None]
    p_B = yaw.transform(E[h], c.T_A_I[None, rows, 4:])
    apart = np.linalg.norm(p_B - c.T_B_I[None, rows, 4:], axis=2)
    between = np.abs(c.way_A_m[rows] - c.way_A_m[h]) + np.abs(c.way_B_m[rows] - c.way_B_m[h])
    turn = np.abs(yaw.wrap(E[h, 3] - E[None, rows, 3]))
    of_position = apart / (rule.drift_offset_m + rule.drift_ratio * between)
    error = np.maximum(of_position, turn / rule.max_turn_rad)
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
