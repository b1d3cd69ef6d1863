"""Acceptance gates of closures; the verdict is the first gate that a closure fails.

Closures of a search and those of the record are measured alike and pass the same gates.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.gate import Gate
from maplab_py.algorithms.loop_closure.alignment_contest import (
    AlignmentChoice,
    Contest,
    ContestRule,
    decide,
    is_significant,
    with_choice,
)
from maplab_py.algorithms.loop_closure.closure_record import ClosureRecord
from maplab_py.algorithms.loop_closure.closure_table import VERDICTS
from maplab_py.algorithms.loop_closure.consensus import ConsensusRule, check_consensus, path_lengths
from maplab_py.algorithms.loop_closure.mission_alignment import (
    AgreementRule,
    Alignment,
    MissionPair,
    PairedClosures,
    alignments_of_pairs,
    is_refuted,
    trajectory_stretches,
    unmatched_share,
)
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.record_updates import banned
from maplab_py.algorithms.loop_closure.reports import Verdict
from maplab_py.array_types import F64, I64, Mask
from maplab_py.geometry import se3, so3, symmetric
from maplab_py.vimap import VIMap
from maplab_py.vimap.ids import to_hex
from maplab_py.vision.absolute_pose import PoseSolutions

_DRIFT_OFFSET_M = 0.5
_USUAL_DRIFT_RATIO = 0.02
"""Drift relative to the path length, which closures between ambiguous places must not exceed.
Between missions of known base frames the path begins at their starts: anchoring leaves drift."""


@dataclasses.dataclass(frozen=True, eq=False)
class MeasuredClosures:
    """Measurements (N) that the gates test, and the relations of the ends of closures."""

    query: I64  # (N,) vertices
    place: I64  # (N,)
    mission_query: I64
    mission_place: I64
    way_query_m: F64  # arc length along the mission
    way_place_m: F64
    T_M_I: F64  # (N, 7) of the query, in the mission of the place
    matches: I64
    inliers: I64
    tilt_deg: F64
    rotation_sigma_deg: F64  # about the worst axis, NaN where the rotation is not determined
    correction_m: F64
    correction_deg: F64
    related: Mask  # ends in one mission, or in two whose base frames are known

    @classmethod
    def of_solutions(
        cls, vi_map: VIMap, query: I64, place: I64, s: PoseSolutions, is_known: Mask
    ) -> MeasuredClosures:
        """Measure estimated poses; `is_known` (M,) are missions whose base frames are trusted."""
        T_G_M = vi_map.T_G_M[vi_map.vertices.mission[place]]
        change = se3.local(vi_map.T_G_I[query], se3.compose(T_G_M, s.T_M_I))
        return cls(
            **_ends(vi_map, query, place, is_known),
            T_M_I=s.T_M_I,
            matches=s.keypoint_count,
            inliers=s.inlier_count,
            tilt_deg=np.degrees(s.tilt_rad),
            rotation_sigma_deg=_rotation_sigma_deg(s.covariance),
            correction_m=np.linalg.norm(change[:, :3], axis=1),
            correction_deg=np.degrees(np.linalg.norm(change[:, 3:], axis=1)),
        )

    @classmethod
    def of_record(cls, vi_map: VIMap, c: ClosureRecord) -> MeasuredClosures:
        """Measure recorded closures."""
        query, place = (vi_map.vertex_index.rows(ids) for ids in (c.query, c.place))
        # the record has the deviations about three axes; their largest and their norm are bounds of
        # that about the worst axis, and the verdict tells which of them applies
        sigma_rad = np.where(
            c.verdict == VERDICTS.index(Verdict.ACCEPTED),
            c.sigma[:, 3:].max(axis=1, initial=0.0),
            np.linalg.norm(c.sigma[:, 3:], axis=1),
        )
        is_known = vi_map.baseframes.is_known[vi_map.missions.baseframe]
        return cls(
            **_ends(vi_map, query.astype(np.int64), place.astype(np.int64), is_known),
            T_M_I=se3.compose(vi_map.vertices.T_M_I[place], se3.inverse(c.T_A_B)),
            matches=c.matches.astype(np.int64),
            inliers=c.inliers.astype(np.int64),
            tilt_deg=c.tilt_deg.astype(np.float64),
            rotation_sigma_deg=np.degrees(sigma_rad),
            correction_m=c.correction_m.astype(np.float64),
            correction_deg=c.correction_deg.astype(np.float64),
        )

    def take(self, rows: I64) -> MeasuredClosures:
        """Return some of the closures."""
        return MeasuredClosures(
            **{f.name: getattr(self, f.name)[rows] for f in dataclasses.fields(self)}
        )

    @property
    def same(self) -> Mask:
        """Closures (N,) inside one mission."""
        return np.asarray(self.mission_query == self.mission_place)

    @property
    def between_m(self) -> F64:
        """Length (N,) of the path between the ends, inside one mission."""
        return np.abs(self.way_query_m - self.way_place_m)

    @property
    def is_usual(self) -> Mask:
        """Closures (N,) that correct no more than odometry usually drifts."""
        since = np.where(self.same, self.between_m, self.way_query_m + self.way_place_m)
        return np.asarray(self.correction_m <= _DRIFT_OFFSET_M + _USUAL_DRIFT_RATIO * since)

    def is_far(self, options: LoopClosureOptions) -> Mask:
        """Return which closures (N,) inside a mission correct more than it can have drifted."""
        drift_m = _DRIFT_OFFSET_M + options.max_drift_ratio * self.between_m
        return np.asarray(self.same & (self.correction_m > drift_m))

    def paired(self, vi_map: VIMap, stretch: I64) -> PairedClosures:
        """Return the closures as relative poses of their missions."""
        return PairedClosures.of(
            (self.mission_query, self.mission_place),
            (vi_map.vertices.T_M_I[self.query], self.T_M_I),
            (self.way_query_m, self.way_place_m),
            (stretch[self.query], stretch[self.place]),
            self.inliers.astype(np.float64),
        )


def _ends(vi_map: VIMap, query: I64, place: I64, is_known: Mask) -> dict[str, NDArray[Any]]:
    mission, way = vi_map.vertices.mission.astype(np.int64), path_lengths(vi_map)
    a, b = mission[query], mission[place]
    return {
        "query": query, "place": place, "mission_query": a, "mission_place": b,
        "way_query_m": way[query], "way_place_m": way[place],
        "related": np.asarray((a == b) | (is_known[a] & is_known[b])),
    }  # fmt: skip


def _rotation_sigma_deg(covariance: F64) -> F64:
    """Return the deviation (N,) about the worst axis, of covariances (N, 6, 6) of [dp, dtheta]."""
    known = np.flatnonzero(~np.isnan(covariance[:, 0, 0]))
    sigma_rad = np.full(len(covariance), np.nan)
    largest = symmetric.eigen(covariance[known, 3:, 3:])[0][:, -1]
    sigma_rad[known] = np.sqrt(np.maximum(largest, 0.0))
    return np.asarray(np.degrees(sigma_rad))


def pose_gates(c: MeasuredClosures, o: LoopClosureOptions) -> list[Gate]:
    """Return the gates on the pose of a closure."""
    return [
        Gate.of(
            "inliers", c.inliers, o.min_inlier_count, Verdict.FEW_INLIERS.value,
            "--lc_min_inlier_count", is_minimum=True,
        ),
        Gate.of(
            "inliers / matches", c.inliers / np.maximum(c.matches, 1), o.min_inlier_ratio,
            Verdict.LOW_RATIO.value, "--lc_min_inlier_ratio", is_minimum=True,
        ),
        Gate.of(
            "angle of gravity", c.tilt_deg, o.max_gravity_deviation_deg, Verdict.TILTED.value,
            "--lc_max_gravity_deviation_deg", "deg",
        ),
        Gate.of(
            "deviation of the rotation", c.rotation_sigma_deg, o.max_rotation_sigma_deg,
            Verdict.UNCERTAIN.value, "--lc_max_rotation_sigma_deg", "deg",
        ),
    ]  # fmt: skip


def correction_gates(c: MeasuredClosures, o: LoopClosureOptions) -> list[Gate]:
    """Return the gates on the correction that a closure makes."""
    return [
        Gate.of(
            "correction", c.correction_m, _DRIFT_OFFSET_M + o.max_drift_ratio * c.between_m,
            Verdict.IMPLAUSIBLE.value, "--lc_max_drift_ratio", "m", applies=c.same,
            flag_value=(c.correction_m - _DRIFT_OFFSET_M) / np.maximum(c.between_m, 1e-9),
        ),
        Gate.of(
            "correction of the position", c.correction_m, o.max_delta_position_m,
            Verdict.IMPLAUSIBLE.value, "--lc_max_delta_position_m", "m",
            applies=c.related & (o.max_delta_position_m >= 0.0),
        ),
        Gate.of(
            "correction of the attitude", c.correction_deg, o.max_delta_rotation_deg,
            Verdict.IMPLAUSIBLE.value, "--lc_max_delta_rotation_deg", "deg",
            applies=c.related & (o.max_delta_rotation_deg >= 0.0),
        ),
    ]  # fmt: skip


def shares_of_rivals(c: MeasuredClosures, geometric: Mask, options: LoopClosureOptions) -> F64:
    """Return the inliers (N,) of the strongest other place / of the best; `geometric` pass on pose."""
    rule = AmbiguityRule(_DRIFT_OFFSET_M, options.max_drift_ratio)
    return rival_shares(
        c.query, c.way_place_m, c.mission_place, c.T_M_I, c.inliers, c.is_far(options), geometric,
        rule,
    )  # fmt: skip


def looks_alike(c: MeasuredClosures, shares: F64, options: LoopClosureOptions) -> Mask:
    """Return which related closures (N,) are ambiguous; odometry and known base frames resolve it."""
    ambiguous = (shares > 0.0) & (shares >= options.ambiguous_inlier_ratio)
    return np.asarray(ambiguous & c.related & ~c.is_usual)


def contests_of_missions(
    vi_map: VIMap, c: MeasuredClosures, candidate: Mask, geometric: Mask, o: LoopClosureOptions
) -> list[Contest]:
    """Weigh the alignments of missions for which closures between unrelated missions vote.

    Closures with far places of the query's mission show which places look alike.

    Args:
        vi_map: The map.
        c: Closures (N).
        candidate: Closures (N,) that passed all gates so far.
        geometric: Closures (N,) that passed the gates on their poses.
        o: Thresholds.
    """
    stretch = trajectory_stretches(vi_map)
    is_alias = geometric & c.is_far(o) & (c.inliers >= AmbiguityRule.min_inliers)
    voting = (candidate & ~c.related) | is_alias
    pairs = alignments_of_pairs(c.paired(vi_map, stretch), voting, AgreementRule())
    names = [to_hex(words)[:8] for words in vi_map.missions.id]
    return decide(vi_map, pairs, stretch, ContestRule(o.max_ambiguous_ratio), names)


def consensus(
    vi_map: VIMap, c: MeasuredClosures, options: LoopClosureOptions
) -> tuple[I64, Mask, Mask]:
    """Return support (N,), and which closures neighbours support and which they contradict (N,)."""
    rule = ConsensusRule(
        min_support=options.min_support, max_difference=options.max_neighbour_difference
    )
    return check_consensus(vi_map, c.query, c.place, c.T_M_I, c.inliers, rule)


@dataclasses.dataclass(frozen=True, eq=False)
class Judgement:
    """Verdicts on closures (N) and the quantities that the gates test."""

    verdict: NDArray[np.int8]  # (N,) index into VERDICTS
    support: I64  # (N,)
    correction_m: F64  # (N,)
    correction_deg: F64  # (N,)
    contests: list[Contest] = dataclasses.field(default_factory=list)  # of missions to be aligned

    def refuse(self, which: Mask, reason: Verdict) -> None:
        """Reject closures unless another gate has rejected them before."""
        self.verdict[self.passing & which] = VERDICTS.index(reason)

    @property
    def passing(self) -> Mask:
        """Closures (N,) that no gate has rejected."""
        return np.asarray(self.verdict == VERDICTS.index(Verdict.ACCEPTED))


def judge(
    vi_map: VIMap,
    query: I64,
    place: I64,
    solutions: PoseSolutions,
    options: LoopClosureOptions,
    *,
    is_known: Mask,
    choice: AlignmentChoice | None = None,
) -> Judgement:
    """Apply all gates: geometry, plausible drift, ambiguity, consensus of neighbours.

    Args:
        vi_map: The map.
        query: Query vertices (N,).
        place: Vertices of the places (N,).
        solutions: Estimated poses.
        options: Thresholds.
        is_known: Missions (M,) whose base frames are to be trusted.
        choice: An alignment of two missions that a person has chosen.

    Raises:
        UserError: The chosen alignment does not exist.
    """
    c = MeasuredClosures.of_solutions(vi_map, query, place, solutions, is_known)
    judgement = Judgement(
        verdict=np.full(len(query), VERDICTS.index(Verdict.ACCEPTED), dtype=np.int8),
        support=np.zeros(len(query), dtype=np.int64),
        correction_m=c.correction_m,
        correction_deg=c.correction_deg,
    )
    judgement.refuse(banned(vi_map, query, place), Verdict.REMOVED)
    for gate in pose_gates(c, options):
        judgement.refuse(gate.failed, Verdict(gate.verdict))
    judgement.refuse(np.isnan(c.rotation_sigma_deg), Verdict.FEW_INLIERS)
    geometric = judgement.passing
    for gate in correction_gates(c, options):
        judgement.refuse(gate.failed, Verdict(gate.verdict))
    shares = shares_of_rivals(c, geometric, options)
    judgement.refuse(looks_alike(c, shares, options), Verdict.AMBIGUOUS)
    judgement.refuse(_repeats(vi_map, c, judgement.passing & c.same, options), Verdict.AMBIGUOUS)
    contests = contests_of_missions(vi_map, c, judgement.passing, geometric, options)
    if choice is not None:
        contests = with_choice(contests, choice)
    judgement.contests.extend(contests)
    follows = np.zeros(len(query), dtype=np.bool_)
    for contest in contests:
        follows[contest.accepted] = True
    judgement.refuse(~c.related & ~follows, Verdict.AMBIGUOUS)
    left = np.flatnonzero(judgement.passing)
    if len(left):
        support, supported, contradicted = consensus(vi_map, c.take(left), options)
        judgement.support[left] = support
        judgement.verdict[left[contradicted]] = VERDICTS.index(Verdict.CONTRADICTED)
        judgement.verdict[left[~supported & ~contradicted]] = VERDICTS.index(Verdict.NO_SUPPORT)
    return judgement


def _repeats(
    vi_map: VIMap, c: MeasuredClosures, candidate: Mask, options: LoopClosureOptions
) -> Mask:
    """Return which closures (N,) inside missions join places that only look alike."""
    stretch = trajectory_stretches(vi_map)
    rule = ContestRule(options.max_ambiguous_ratio)
    return with_places_that_look_alike(
        vi_map, c.paired(vi_map, stretch), candidate, c.is_usual, stretch, rule
    )


# Ambiguous places: queries that match several places of a mission, or a distant place of their own.
#
# A mission is rigid up to its drift, so a query cannot be at two of its places at once. If it matches
# two places about equally well, its appearance does not determine the place. A closure with a third
# mission that observed only one of the two places is then unreliable too.


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


# Places of one mission that look alike: weigh its closures as those of two missions are weighed.
#
# A closure inside a mission says how far odometry has drifted between two visits. Closures that join
# floors that look alike agree with each other, too: on a drift by the height of a floor. Where other
# closures show that odometry has hardly drifted, such a group competes with them, and loses when they
# explain significantly more of the trajectory, or when it lets two visits coincide whose landmarks
# never match. Without other closures there is nothing to compare, and the group stays.
#
# A stretch that was visited once has no closure of usual drift, but may have one that joins floors.
# What only the group explains is therefore compared with the group itself, not with what the others
# explain as between missions: 10 to 14 stretches in a building of 180 are enough to exceed the latter.


_MIN_STRETCHES = 10
"""Stretches that closures of usual drift must explain before they can refute others."""
_MAX_NEW_SHARE = 1.0 / 3.0
"""Share of its stretches that only a group may explain if it loses."""


def with_places_that_look_alike(
    vi_map: VIMap,
    closures: PairedClosures,
    candidate: Mask,
    is_usual: Mask,
    stretch: I64,
    rule: ContestRule,
) -> Mask:
    """Return which closures (N,) join places of a mission that only look alike.

    Args:
        vi_map: The map.
        closures: Closures, A and B being the same mission for the candidates.
        candidate: Closures (N,) inside missions that passed all other gates.
        is_usual: Closures (N,) that correct no more than odometry usually drifts.
        stretch: Stretch (V,) of each vertex.
        rule: Criteria.
    """
    refused = np.zeros(len(candidate), dtype=np.bool_)
    if not (candidate & ~is_usual).any():
        return refused
    for pair in alignments_of_pairs(closures, candidate, AgreementRule()):
        for rival in _rivals(vi_map, pair, is_usual, stretch, rule):
            refused[rival.rows] = True
    return refused & candidate & ~is_usual


def _rivals(
    vi_map: VIMap, pair: MissionPair, is_usual: Mask, stretch: I64, rule: ContestRule
) -> list[Alignment]:
    """Return the groups of closures that lose against those of usual drift."""
    usual = [a for a in pair.alignments if np.mean(is_usual[a.rows]) > 0.5]
    explained = np.unique(
        np.concatenate([np.zeros(0, dtype=np.int64), *(_stretches(a) for a in usual)])
    )
    if len(explained) < _MIN_STRETCHES:
        return []
    unmatched = min(unmatched_share(vi_map, pair, a, stretch) for a in usual)
    others = [a for a in pair.alignments if np.mean(is_usual[a.rows]) <= 0.5]
    return [
        a
        for a in others
        if _adds_little(_stretches(a), explained, rule)
        or is_refuted(unmatched_share(vi_map, pair, a, stretch), unmatched)
    ]


def _adds_little(group: I64, explained: I64, rule: ContestRule) -> bool:
    """Return whether most stretches of a group, and significantly more others, are explained without it."""
    theirs = len(np.setdiff1d(group, explained))
    ours = len(np.setdiff1d(explained, group))
    return is_significant(ours, theirs, rule) and theirs <= _MAX_NEW_SHARE * len(group)


def _stretches(alignment: Alignment) -> I64:
    return np.union1d(alignment.stretches_A, alignment.stretches_B)
