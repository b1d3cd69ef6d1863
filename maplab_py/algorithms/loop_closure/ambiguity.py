"""Decide between the alignments of two missions, or leave the relation open.

Two missions in places that look alike have several alignments, and the size of the largest group of
closures is no evidence. The best alignment is accepted when, in both missions, it explains many
stretches that a rival does not explain, and a rival explains hardly any that it does not. Sessions
that visit two similar rooms have such an alignment: a rival that exchanges the rooms explains half of
the stretches. A session that visits only one of them has not: whichever room it is matched with, the
other mission's stretches in the other room stay unexplained.

A rival is refuted where it contradicts visibility: it brings trajectories together, but landmarks of
one mission are never matched by the other.

A third mission that has visited two places which one of the two missions cannot distinguish reveals
rivals that the closures between the two do not show, because one of them never visited the second
place. Such a pair stays undecided.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from maplab_py.algorithms.loop_closure.mission_alignment import (
    MissionPair,
    is_refuted,
    unmatched_share,
)
from maplab_py.array_types import F64, I64
from maplab_py.errors import UserError
from maplab_py.geometry import yaw
from maplab_py.vimap import VIMap

_CHOICE_M, _CHOICE_RAD = 3.0, 0.5
"""Error that is allowed to a pose which a person gives."""
_SAME_M, _SAME_RAD = 1.5, 0.3
"""Distances of alignments that count as the same; drift separates them."""


_MIN_SIGMAS = 2.0
"""Difference of two counts that is significant, in deviations of a sign test."""


@dataclasses.dataclass(frozen=True, eq=False)
class Contest:
    """The alignments of two missions and the outcome."""

    pair: MissionPair
    winner: int  # number of the alignment, -1 if none wins
    reason: str = ""  # why none wins
    unmatched: tuple[float, ...] = ()  # share of the stretches with landmarks that must be in view

    @property
    def accepted(self) -> I64:
        """Return the rows of the closures that follow the winner."""
        if self.winner < 0:
            return np.zeros(0, dtype=np.int64)
        return self.pair.alignments[self.winner].rows

    def largest_rival_share(self) -> float:
        """Return how many stretches only a rival explains, per stretch that only the best one does."""
        best = self.pair.alignments[0]
        shares = [0.0]
        for number, rival in enumerate(self.pair.alignments[1:], start=1):
            if is_refuted(self.unmatched[number], self.unmatched[0]):
                continue
            for side in (0, 1):
                ours = len(np.setdiff1d(best.stretches(side), rival.stretches(side)))
                theirs = len(np.setdiff1d(rival.stretches(side), best.stretches(side)))
                shares.append(theirs / max(ours, 1))
        return max(shares)


@dataclasses.dataclass(frozen=True)
class AlignmentChoice:
    """A person's decision for an alignment: by its number in the report, or by an approximate pose."""

    number: int = 0  # in `listed_alignments`, counted from 1; 0 = by pose
    missions: tuple[int, int] = (-1, -1)  # A and B of the pose
    T_B_A: F64 = dataclasses.field(default_factory=lambda: np.zeros(4))


def listed_alignments(contests: Sequence[Contest]) -> list[tuple[int, int]]:
    """Return the alignments that a report lists, as rows (contest, alignment), in its order.

    Contests without rival are not listed, rivals of a winner but for the second not either.
    """
    rows = []
    for i, contest in enumerate(contests):
        count = len(contest.pair.alignments)
        if contest.winner < 0 or count > 1:
            shown = count if contest.winner < 0 else max(2, contest.winner + 1)
            rows += [(i, k) for k in range(shown)]
    return rows


def with_choice(contests: Sequence[Contest], choice: AlignmentChoice) -> list[Contest]:
    """Accept the alignment that a person has chosen.

    Raises:
        UserError: There is no such alignment.
    """
    rows = listed_alignments(contests)
    if choice.number:
        if not 1 <= choice.number <= len(rows):
            listed = f"from 1 to {len(rows)}" if rows else "none: no alignment is in doubt"
            raise UserError(f"--anchor_hypothesis={choice.number}: the alignments are {listed}")
        chosen, number = rows[choice.number - 1]
    else:
        chosen, number = _nearest_alignment(contests, choice)
    result = list(contests)
    result[chosen] = dataclasses.replace(result[chosen], winner=number, reason="")
    return result


def _nearest_alignment(contests: Sequence[Contest], choice: AlignmentChoice) -> tuple[int, int]:
    for i, contest in enumerate(contests):
        if contest.pair.missions == choice.missions:
            away = np.array([a.T_B_A for a in contest.pair.alignments]) - choice.T_B_A
            away_m = np.linalg.norm(away[:, :3], axis=1)
            turned = np.abs(yaw.wrap(away[:, 3]))
            number = int(np.argmin(away_m + turned))
            if away_m[number] < _CHOICE_M and turned[number] < _CHOICE_RAD:
                return i, number
            raise UserError(
                "--T_G_M: no alignment with the mission of --to is near; the nearest is "
                f"{away_m[number]:.1f} m and {np.degrees(turned[number]):.0f} deg away"
            )
    raise UserError("--to: no verified closure joins the two missions")


def decide(
    vi_map: VIMap, pairs: list[MissionPair], stretch: I64, max_share: float, names: list[str]
) -> list[Contest]:
    """Decide every pair of different missions.

    Args:
        pairs: Alignments of pairs; those of a mission and itself reveal places that look alike.
        stretch: Stretch (V,) of each vertex.
        max_share: Stretches that only a rival may explain, per stretch that only the winner does.
        names: Names of the missions, for reasons.
    """
    contests = []
    confusions = _confusions(pairs)
    for pair in pairs:
        if pair.mission_A == pair.mission_B:
            continue
        unmatched: tuple[float, ...] = ()
        if len(pair.alignments) > 1:
            unmatched = tuple(
                unmatched_share(vi_map, pair, alignment, stretch) for alignment in pair.alignments
            )
        reason = _rival(pair, unmatched, max_share) or _hidden_rival(
            vi_map, pair, confusions, max_share, names
        )
        contests.append(Contest(pair, -1 if reason else 0, reason, unmatched))
    return contests


def _rival(pair: MissionPair, unmatched: tuple[float, ...], max_share: float) -> str:
    """Return why the best alignment does not win against the others; empty if it does."""
    best = pair.alignments[0]
    for number, rival in enumerate(pair.alignments[1:], start=1):
        if is_refuted(unmatched[number], unmatched[0]):
            continue
        for side in (0, 1):
            if not is_beaten(rival.stretches(side), best.stretches(side), max_share):
                return (
                    "places that look like other places: "
                    f"the best alignment explains {best.support} stretches of the trajectories, "
                    f"another one {rival.support}"
                )
    return ""


def is_beaten(rival: I64, best: I64, max_share: float) -> bool:
    """Return whether one set of stretches has many that a rival lacks, and lacks hardly any."""
    ours, theirs = len(np.setdiff1d(best, rival)), len(np.setdiff1d(rival, best))
    return is_significant(ours, theirs) and theirs <= max_share * ours


def is_significant(ours: int, theirs: int) -> bool:
    """Return whether two counts differ by more than the deviations of a sign test."""
    return bool(ours - theirs >= _MIN_SIGMAS * np.sqrt(ours + theirs))


_Confusion = tuple[MissionPair, F64, I64]
"""A pair of missions, a displacement in the frame of one and the stretches concerned."""


def _hidden_rival(
    vi_map: VIMap,
    pair: MissionPair,
    confusions: dict[int, list[_Confusion]],
    max_share: float,
    names: list[str],
) -> str:
    """Return which mission shows that the places of the best alignment look like others."""
    best = pair.alignments[0]
    for side, mission in enumerate(pair.missions):
        for other, T_alias, stretches in confusions.get(mission, []):
            if other is pair:
                continue
            shared = np.isin(best.stretches(side), stretches).sum()
            if shared <= max_share * len(best.stretches(side)):
                continue
            if not _is_listed(vi_map, pair, side, T_alias):
                third = other.missions[other.missions[0] == mission]
                return (
                    "places that look like other places: mission "
                    f"{names[third]} shows that {shared} of {len(best.stretches(side))} "
                    f"stretches of {names[mission]} may lie elsewhere"
                )
    return ""


def _confusions(pairs: list[MissionPair]) -> dict[int, list[_Confusion]]:
    """Return the places that each mission cannot distinguish, as other missions show them."""
    confusions: dict[int, list[_Confusion]] = {}
    for pair in pairs:
        if pair.mission_A == pair.mission_B:
            confusions.setdefault(pair.mission_A, []).extend(
                (pair, a.T_B_A, np.union1d(a.stretches_A, a.stretches_B)) for a in pair.alignments
            )
            continue
        for i, first in enumerate(pair.alignments):
            for second in pair.alignments[i + 1 :]:
                T_A = yaw.compose(yaw.inverse(second.T_B_A), first.T_B_A)
                T_B = yaw.compose(second.T_B_A, yaw.inverse(first.T_B_A))
                for side, T in ((0, T_A), (1, T_B)):
                    common = np.intersect1d(first.stretches(side), second.stretches(side))
                    confusions.setdefault(pair.missions[side], []).append((pair, T, common))
    return confusions


def _is_listed(vi_map: VIMap, pair: MissionPair, side: int, T_alias: F64) -> bool:
    """Return whether a displaced best alignment is one of those that the closures show."""
    best = pair.alignments[0]
    rows = np.arange(vi_map.vertex_start[pair.mission_A], vi_map.vertex_start[pair.mission_A + 1])
    p_A = vi_map.vertices.T_M_I[rows, 4:]
    for T in (T_alias, yaw.inverse(T_alias)):
        T_B_A = yaw.compose(best.T_B_A, T) if side == 0 else yaw.compose(T, best.T_B_A)
        for rival in pair.alignments[1:]:
            gap = yaw.transform(T_B_A, p_A) - yaw.transform(rival.T_B_A, p_A)
            turn = abs(float(yaw.wrap(T_B_A[3] - rival.T_B_A[3])))
            if np.median(np.linalg.norm(gap, axis=1)) < _SAME_M and turn < _SAME_RAD:
                return True
    return False
