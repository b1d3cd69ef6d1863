"""What the gates of `gates.py` compare, for recorded closures: value, threshold and the flag of each.

Geometry, correction and support are those of the record. Rivals of ambiguous places and alignments of
missions are computed again from the record and the present poses.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.loop_closure.alignment_contest import Contest, ContestRule, decide
from maplab_py.algorithms.loop_closure.ambiguity import AmbiguityRule
from maplab_py.algorithms.loop_closure.closure_record import ClosureRecord
from maplab_py.algorithms.loop_closure.closure_table import VERDICTS
from maplab_py.algorithms.loop_closure.consensus import path_lengths
from maplab_py.algorithms.loop_closure.differences import differences
from maplab_py.algorithms.loop_closure.expected_views import is_refuted
from maplab_py.algorithms.loop_closure.mission_alignment import (
    AgreementRule,
    PairedClosures,
    alignments_of_pairs,
)
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.reports import Verdict
from maplab_py.algorithms.loop_closure.stretches import trajectory_stretches
from maplab_py.array_types import F64, I64, Mask
from maplab_py.geometry import se3, so3
from maplab_py.vimap import VIMap
from maplab_py.vimap.ids import to_hex

YES_NO = "yes or no"
"""Unit of gates whose value is 1 = yes or 0 = no."""

_DRIFT_OFFSET_M = 0.5
RATIO_MARGIN = 1e-3
"""Added to a ratio that must stay below its flag."""


@dataclasses.dataclass(frozen=True, eq=False)
class GateValues:
    """One gate for N closures."""

    name: str
    unit: str
    value: F64  # (N,), NaN where it was not recorded
    threshold: F64  # (N,)
    is_minimum: bool  # values below the threshold fail
    applies: Mask  # (N,)
    flag: str  # moves the threshold; empty = none does
    verdict: Verdict  # of closures that fail
    flag_value: F64  # (N,) of the flag, with which the closure just passes

    @property
    def failed(self) -> Mask:
        """Closures (N,) whose value is beyond the threshold."""
        sign = -1.0 if self.is_minimum else 1.0
        return np.asarray(self.applies & (sign * (self.value - self.threshold) > 0.0))

    def take(self, rows: I64 | Mask) -> GateValues:
        """Return the gate for some of the closures."""
        return dataclasses.replace(
            self,
            value=self.value[rows],
            threshold=self.threshold[rows],
            applies=self.applies[rows],
            flag_value=self.flag_value[rows],
        )

    @property
    def shortfall(self) -> F64:
        """Distance (N,) to the threshold relative to it; 0 for closures that pass."""
        size = np.maximum(np.abs(self.threshold), 1e-9)
        distance = np.abs(self.value - self.threshold) / size
        return np.where(self.failed, distance, 0.0)


def gate_values(
    vi_map: VIMap, closures: ClosureRecord, options: LoopClosureOptions
) -> list[GateValues]:
    """Return the gates in the order in which they are applied.

    Args:
        vi_map: The map.
        closures: All recorded closures (N): places look alike in comparison with others.
        options: Thresholds.
    """
    geometry = geometric_gates(vi_map, closures, options)
    geometric = np.asarray(~np.any([gate.failed for gate in geometry], axis=0))
    return geometry + _gates_among_closures(vi_map, closures, options, geometric)


@dataclasses.dataclass(frozen=True, eq=False)
class Relations:
    """How the ends of closures (N) are related."""

    same: Mask  # in one mission
    related: Mask  # in one mission, or in two of known base frame
    between_m: F64  # length of the path between the ends, in one mission
    drift_m: F64  # plausible drift between the ends, in one mission

    @classmethod
    def of(cls, vi_map: VIMap, c: ClosureRecord, options: LoopClosureOptions) -> Relations:
        """Return the relations of the ends of recorded closures."""
        query, place = (vi_map.vertex_index.rows(ids) for ids in (c.query, c.place))
        mission, way = vi_map.vertices.mission, path_lengths(vi_map)
        same = np.asarray(mission[query] == mission[place])
        known = vi_map.baseframes.is_known[vi_map.missions.baseframe]
        related = same | (known[mission[query]] & known[mission[place]])
        between = np.abs(way[query] - way[place])
        drift = _DRIFT_OFFSET_M + options.max_drift_ratio * between
        return cls(same, related, between, drift)


def _gate(
    name: str,
    value: NDArray[Any],
    threshold: float | F64,
    verdict: Verdict,
    flag: str = "",
    unit: str = "",
    *,
    is_minimum: bool = False,
    applies: Mask | None = None,
    flag_value: F64 | None = None,
) -> GateValues:
    count = len(value)
    values = np.asarray(value, dtype=np.float64)
    limits = np.broadcast_to(np.asarray(threshold, dtype=np.float64), (count,))
    everywhere = np.ones(count, dtype=np.bool_)
    return GateValues(
        name,
        unit,
        values,
        limits,
        is_minimum,
        everywhere if applies is None else applies,
        flag,
        verdict,
        values if flag_value is None else flag_value,
    )


def geometric_gates(vi_map: VIMap, c: ClosureRecord, o: LoopClosureOptions) -> list[GateValues]:
    """Return the gates on the pose of a closure and on its correction."""
    relations = Relations.of(vi_map, c, o)
    # the record has the deviations about three axes; their largest and their norm are bounds of that
    # about the worst axis, and the verdict tells which of them applies
    sigma_rad = np.where(
        c.verdict == VERDICTS.index(Verdict.ACCEPTED),
        c.sigma[:, 3:].max(axis=1, initial=0.0),
        np.linalg.norm(c.sigma[:, 3:], axis=1),
    )
    sigma_deg = np.degrees(sigma_rad)
    return [
        _gate(
            "inliers", c.inliers, o.min_inlier_count, Verdict.FEW_INLIERS,
            "--lc_min_inlier_count", is_minimum=True,
        ),
        _gate(
            "inliers / matches", c.inliers / np.maximum(c.matches, 1), o.min_inlier_ratio,
            Verdict.LOW_RATIO, "--lc_min_inlier_ratio", is_minimum=True,
        ),
        _gate(
            "angle of gravity", c.tilt_deg, o.max_gravity_deviation_deg, Verdict.TILTED,
            "--lc_max_gravity_deviation_deg", "deg",
        ),
        _gate(
            "deviation of the rotation", sigma_deg, o.max_rotation_sigma_deg,
            Verdict.UNCERTAIN, "--lc_max_rotation_sigma_deg", "deg",
        ),
        _gate(
            "correction", c.correction_m, relations.drift_m, Verdict.IMPLAUSIBLE,
            "--lc_max_drift_ratio", "m", applies=relations.same,
            flag_value=(c.correction_m - _DRIFT_OFFSET_M) / np.maximum(relations.between_m, 1e-9),
        ),
        _gate(
            "correction of the position", c.correction_m, o.max_delta_position_m,
            Verdict.IMPLAUSIBLE, "--lc_max_delta_position_m", "m",
            applies=relations.related & (o.max_delta_position_m >= 0.0),
        ),
        _gate(
            "correction of the attitude", c.correction_deg, o.max_delta_rotation_deg,
            Verdict.IMPLAUSIBLE, "--lc_max_delta_rotation_deg", "deg",
            applies=relations.related & (o.max_delta_rotation_deg >= 0.0),
        ),
    ]  # fmt: skip


def _gates_among_closures(
    vi_map: VIMap, c: ClosureRecord, o: LoopClosureOptions, geometric: Mask
) -> list[GateValues]:
    """Return the gates that compare a closure with others; `geometric` (N) passed those before."""
    relations = Relations.of(vi_map, c, o)
    is_far = relations.same & (c.correction_m > relations.drift_m)
    rivals = rival_shares(vi_map, c, geometric, is_far, o)
    is_alike = c.verdict == VERDICTS.index(Verdict.AMBIGUOUS)
    contest = _contest_values(vi_map, c, geometric, is_far, ~relations.related, o)
    is_contested = is_alike & ~relations.related
    return [
        _gate(
            "inliers of another place / of the best", rivals,
            np.nextafter(o.ambiguous_inlier_ratio, 0.0), Verdict.AMBIGUOUS,
            "--lc_ambiguous_inlier_ratio", applies=is_alike & relations.related,
            flag_value=rivals + RATIO_MARGIN,
        ),
        _gate(
            "stretches only another alignment explains / only the best", contest.rival_share,
            o.max_ambiguous_ratio, Verdict.AMBIGUOUS, "--lc_max_ambiguous_ratio",
            applies=is_contested,
        ),
        _gate(
            "an alignment of the missions wins", contest.is_decided, 1.0,
            Verdict.AMBIGUOUS, unit=YES_NO, is_minimum=True, applies=is_contested,
        ),
        _gate(
            "agrees with the best alignment", contest.follows, 1.0, Verdict.AMBIGUOUS,
            unit=YES_NO, is_minimum=True, applies=is_contested,
        ),
        _gate(
            "query vertices nearby that agree", c.support, o.min_support, Verdict.NO_SUPPORT,
            "--lc_min_support", is_minimum=True,
            applies=c.verdict == VERDICTS.index(Verdict.NO_SUPPORT),
        ),
        _gate(
            "difference from closures nearby / tolerance", differences(vi_map, c, o),
            o.max_neighbour_difference, Verdict.CONTRADICTED, "--lc_max_neighbour_difference",
            applies=c.verdict == VERDICTS.index(Verdict.CONTRADICTED),
        ),
        _gate(
            "removed by hand", c.verdict == VERDICTS.index(Verdict.REMOVED), 0.0,
            Verdict.REMOVED, unit=YES_NO,
        ),
    ]  # fmt: skip


def rival_shares(
    vi_map: VIMap,
    c: ClosureRecord,
    geometric: Mask,
    is_far_same_mission: Mask,
    options: LoopClosureOptions,
) -> F64:
    """Return the inliers (N,) of the strongest other place of each query relative to the best place.

    The criteria are those of `ambiguity.ambiguous_queries`; a distant place of the query's mission
    counts as equally strong.
    """
    query, place = (vi_map.vertex_index.rows(ids) for ids in (c.query, c.place))
    T_M_I = se3.compose(vi_map.vertices.T_M_I[place], se3.inverse(c.T_A_B))
    way, mission = path_lengths(vi_map), vi_map.vertices.mission[place]
    rule = AmbiguityRule(_DRIFT_OFFSET_M, options.max_drift_ratio)
    rows = np.flatnonzero(geometric)
    order = rows[np.lexsort((-c.inliers[rows], mission[rows], query[rows]))]
    shares = np.zeros(len(vi_map.vertices))
    if len(order):
        is_best = np.ones(len(order), dtype=np.bool_)
        is_best[1:] = (np.diff(query[order]) != 0) | (np.diff(mission[order]) != 0)
        best = order[np.flatnonzero(is_best)[np.cumsum(is_best) - 1]]
        apart = np.linalg.norm(T_M_I[order, 4:] - T_M_I[best, 4:], axis=1)
        turn = np.linalg.norm(so3.log(se3.relative(T_M_I[best], T_M_I[order])[:, :4]), axis=1)
        drift = rule.drift_offset_m + rule.drift_ratio * np.abs(
            way[place[order]] - way[place[best]]
        )
        is_other = (apart > drift) | (turn > rule.max_turn_rad)
        share = np.where(is_other, c.inliers[order] / np.maximum(c.inliers[best], 1), 0.0)
        np.maximum.at(shares, query[order], share)
    far = geometric & is_far_same_mission & (c.inliers >= rule.min_inliers)
    np.maximum.at(shares, query[far], 1.0)
    return shares[query]


@dataclasses.dataclass(frozen=True, eq=False)
class _ContestValues:
    """How the alignments of the missions of closures (N) compare."""

    rival_share: F64  # largest share of stretches that only a rival explains
    is_decided: F64  # 1 where an alignment wins
    follows: F64  # 1 where the closure supports the best alignment


def _contest_values(
    vi_map: VIMap,
    c: ClosureRecord,
    geometric: Mask,
    is_far_same_mission: Mask,
    unrelated: Mask,
    o: LoopClosureOptions,
) -> _ContestValues:
    """Weigh the alignments of missions again, as `gates` does when closures are found."""
    query, place = (vi_map.vertex_index.rows(ids) for ids in (c.query, c.place))
    v, way, stretch = vi_map.vertices, path_lengths(vi_map), trajectory_stretches(vi_map)
    T_M_I = se3.compose(v.T_M_I[place], se3.inverse(c.T_A_B))
    closures = PairedClosures.of(
        (v.mission[query].astype(np.int64), v.mission[place].astype(np.int64)),
        (v.T_M_I[query], T_M_I),
        (way[query], way[place]),
        (stretch[query], stretch[place]),
        c.inliers.astype(np.float64),
    )
    is_alias = geometric & is_far_same_mission & (c.inliers >= AmbiguityRule.min_inliers)
    passed = np.isin(c.verdict, [VERDICTS.index(v) for v in (Verdict.ACCEPTED, Verdict.AMBIGUOUS)])
    pairs = alignments_of_pairs(closures, (passed & unrelated) | is_alias, AgreementRule())
    rule = ContestRule(o.max_ambiguous_ratio)
    names = [to_hex(words)[:8] for words in vi_map.missions.id]
    values = _ContestValues(np.zeros(len(c)), np.ones(len(c)), np.ones(len(c)))
    for contest in decide(vi_map, pairs, stretch, rule, names):
        rows = contest.pair.rows
        values.rival_share[rows] = _largest_rival_share(contest)
        values.is_decided[rows] = contest.winner >= 0
        values.follows[rows] = 0.0
        values.follows[contest.pair.alignments[max(contest.winner, 0)].rows] = 1.0
    return values


def _largest_rival_share(contest: Contest) -> float:
    """Return how many stretches only a rival explains, per stretch that only the best one does."""
    best = contest.pair.alignments[0]
    shares = [0.0]
    for number, rival in enumerate(contest.pair.alignments[1:], start=1):
        if is_refuted(contest.unmatched[number], contest.unmatched[0]):
            continue
        for side in (0, 1):
            ours = len(np.setdiff1d(best.stretches(side), rival.stretches(side)))
            theirs = len(np.setdiff1d(rival.stretches(side), best.stretches(side)))
            shares.append(theirs / max(ours, 1))
    return max(shares)


def shortfalls(gates: list[GateValues]) -> F64:
    """Return how far each closure (N,) is from passing: the sum over the gates that it fails."""
    return np.asarray(np.sum([gate.shortfall for gate in gates], axis=0), dtype=np.float64)
