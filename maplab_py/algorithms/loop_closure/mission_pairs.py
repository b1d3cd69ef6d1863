"""Missions whose relation is unknown: do their closures tell one alignment, and only one?

A closure of missions A and B says how frame A lies in frame B. Where the base frames do not tell
whether that is plausible, the closures of the pair must: up to drift they have to agree with one
alignment. When another alignment has as good a following, or many queries fit several places,
the missions were at places that look alike, and the largest group proves nothing.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.geometry import se3, yaw

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Mask = NDArray[np.bool_]

_MOST_HYPOTHESES = 200


@dataclasses.dataclass(frozen=True)
class PairRule:
    """When two closures tell the same alignment, and when a rival is too strong."""

    drift_offset_m: float
    drift_ratio: float  # of the way between the closures, in both missions
    max_share: float  # of the best alignment's following, that rivals and look-alikes may have
    max_turn_rad: float = 0.3


@dataclasses.dataclass(frozen=True, eq=False)
class PairedClosures:
    """Closures (N,) between missions, seen from the mission of the smaller row (A)."""

    mission_A: I64
    mission_B: I64
    T_A_I: F64  # (N, 7) the query in both
    T_B_I: F64  # (N, 7)
    way_A_m: F64  # along the missions, to the closure's ends
    way_B_m: F64
    weight: F64  # inliers

    @classmethod
    def of(
        cls,
        mission: tuple[I64, I64],
        T_I: tuple[F64, F64],
        way_m: tuple[F64, F64],
        weight: F64,
    ) -> PairedClosures:
        """Order the two ends of closures, given as (the query's, the place's), by mission."""
        swapped = mission[0] > mission[1]
        T_A_I, T_B_I = (np.where(swapped[:, None], T_I[1 - end], T_I[end]) for end in (0, 1))
        way_A, way_B = (np.where(swapped, way_m[1 - end], way_m[end]) for end in (0, 1))
        return cls(np.minimum(*mission), np.maximum(*mission), T_A_I, T_B_I, way_A, way_B, weight)

    def take(self, rows: I64) -> PairedClosures:
        """Return some of the closures."""
        return PairedClosures(
            *(getattr(self, field.name)[rows] for field in dataclasses.fields(self))
        )


@dataclasses.dataclass(frozen=True, eq=False)
class PairClarity:
    """How clearly the closures of two missions tell one alignment."""

    mission_A: int
    mission_B: int
    rows: I64  # (K,) candidates between the two
    follows: Mask  # (K,) which of them follow the best alignment
    rival_share: float  # inliers that follow the second best, over those of the best
    alike_share: float  # queries that fit several places, over closures that follow the best

    @property
    def share(self) -> float:
        """What is compared with the limit: the larger of the two."""
        return max(self.rival_share, self.alike_share)


def clarity_of_pairs(
    closures: PairedClosures, candidate: Mask, looks_alike: Mask, rule: PairRule
) -> list[PairClarity]:
    """Judge every pair of missions that candidates join; arguments as of `without_alignment`."""
    rows = np.flatnonzero(candidate)
    key = closures.mission_A * (int(closures.mission_B.max(initial=0)) + 1) + closures.mission_B
    pairs = []
    for pair in np.unique(key[rows]):
        mine = rows[key[rows] == pair]
        follows, rival = _followings(closures.take(mine), rule)
        weight = closures.weight[mine]
        alike = np.count_nonzero(looks_alike & (key == pair))
        pairs.append(
            PairClarity(
                int(closures.mission_A[mine[0]]),
                int(closures.mission_B[mine[0]]),
                mine,
                follows,
                float(weight[rival].sum() / weight[follows].sum()),
                float(alike / np.count_nonzero(follows)),
            )
        )
    return pairs


def without_alignment(
    closures: PairedClosures, candidate: Mask, looks_alike: Mask, rule: PairRule
) -> Mask:
    """Tell which closures (N,) follow no alignment that is clearly the best of their pair.

    Args:
        closures: Closures between missions.
        candidate: Those that passed all other gates.
        looks_alike: Those that were refused since their query fits several places.
        rule: When alignments are the same, and when one is clearly the best.
    """
    refused = np.zeros(len(candidate), dtype=np.bool_)
    for pair in clarity_of_pairs(closures, candidate, looks_alike, rule):
        refused[pair.rows] = ~pair.follows if pair.share <= rule.max_share else True
    return refused


def _followings(c: PairedClosures, rule: PairRule) -> tuple[Mask, Mask]:
    """Return which closures (N,) of one pair follow the best alignment, and which the second."""
    count = len(c.weight)
    hypothesis = np.unique(np.linspace(0, count - 1, min(count, _MOST_HYPOTHESES)).astype(np.int64))
    E = yaw.from_pose(se3.compose(c.T_B_I, se3.inverse(c.T_A_I)))  # frame A in frame B
    h = hypothesis[:, None]
    apart = np.linalg.norm(yaw.transform(E[h], c.T_A_I[None, :, 4:]) - c.T_B_I[None, :, 4:], axis=2)
    between = np.abs(c.way_A_m - c.way_A_m[h]) + np.abs(c.way_B_m - c.way_B_m[h])
    turn = np.abs(yaw.wrap(E[h, 3] - E[None, :, 3]))
    follows = (apart < rule.drift_offset_m + rule.drift_ratio * between) & (
        turn < rule.max_turn_rad
    )
    best = follows[np.argmax(follows @ c.weight)]
    second = follows & ~best
    return np.asarray(best), np.asarray(second[np.argmax(second @ c.weight)])
