"""Acceptance gates of closures; the verdict is the first gate that a closure fails.

`judge` is the only place that decides. What the gates compared is stored with each closure
(`GateValues`), and `closure_gates` makes the table of gates from it for reports.
"""

import dataclasses
import functools
from typing import Any

import numpy as np

from maplab_py.algorithms.gate import YES_NO, Gate
from maplab_py.algorithms.landmarks.keypoint_rays import largest_sigma
from maplab_py.algorithms.loop_closure import ambiguity, mission_alignment
from maplab_py.algorithms.loop_closure.closure_record import ClosureRecord
from maplab_py.algorithms.loop_closure.closure_table import VERDICTS, GateValues
from maplab_py.algorithms.loop_closure.consensus import check_consensus, path_lengths
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.record_updates import banned
from maplab_py.algorithms.loop_closure.reports import Verdict
from maplab_py.array_types import F64, I64, Mask
from maplab_py.geometry import se3, so3
from maplab_py.vimap import VIMap, to_hex
from maplab_py.vision.absolute_pose import PoseSolutions

_DRIFT_OFFSET_M = 0.5
_USUAL_DRIFT_RATIO = 0.02
"""Drift relative to the path length, which closures between ambiguous places must not exceed.
Between missions of known base frames the path begins at their starts: anchoring leaves drift."""
_MARGIN = 1e-3
"""Added to a value that must stay below its flag."""


def pose_gates(c: GateValues | ClosureRecord, o: LoopClosureOptions) -> list[Gate]:
    """Return the gates on the pose of a closure."""
    return [
        Gate.of(
            "inliers", c.inliers, o.inlier_factor * o.min_inlier_count, Verdict.FEW_INLIERS.value,
            "--lc_min_inlier_count", is_minimum=True, flag_value=c.inliers / o.inlier_factor,
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


def correction_gates(c: GateValues | ClosureRecord, o: LoopClosureOptions) -> list[Gate]:
    """Return the gates on the correction that a closure makes."""
    return [
        Gate.of(
            "correction", c.correction_m, np.float64(_DRIFT_OFFSET_M) + o.max_drift_ratio * c.between_m,
            Verdict.IMPLAUSIBLE.value, "--lc_max_drift_ratio", "m", applies=~np.isnan(c.between_m),
            flag_value=(c.correction_m - _DRIFT_OFFSET_M) / np.maximum(c.between_m, 1e-9),
        ),
        Gate.of(
            "correction of the position", c.correction_m, o.max_delta_position_m,
            Verdict.IMPLAUSIBLE.value, "--lc_max_delta_position_m", "m",
            applies=c.is_related & (o.max_delta_position_m >= 0.0),
        ),
        Gate.of(
            "correction of the attitude", c.correction_deg, o.max_delta_rotation_deg,
            Verdict.IMPLAUSIBLE.value, "--lc_max_delta_rotation_deg", "deg",
            applies=c.is_related & (o.max_delta_rotation_deg >= 0.0),
        ),
    ]  # fmt: skip


def place_gates(c: GateValues | ClosureRecord, o: LoopClosureOptions) -> list[Gate]:
    """Return the gates that compare a closure with other places and alignments of missions."""
    alike = functools.partial(Gate.of_known, verdict=Verdict.AMBIGUOUS.value)
    return [
        alike(
            "inliers of another place / of the best", c.rival_share,
            np.nextafter(o.ambiguous_inlier_ratio, 0.0), flag="--lc_ambiguous_inlier_ratio",
            flag_value=c.rival_share + _MARGIN,
        ),
        alike(
            "stretches only another alignment explains / only the best", c.rival_stretches,
            o.max_ambiguous_ratio, flag="--lc_max_ambiguous_ratio",
        ),
        alike(
            "an alignment of the missions wins", c.is_decided, 1.0, unit=YES_NO, is_minimum=True
        ),
        alike("agrees with the best alignment", c.follows, 1.0, unit=YES_NO, is_minimum=True),
    ]  # fmt: skip


def neighbour_gates(c: GateValues | ClosureRecord, o: LoopClosureOptions) -> list[Gate]:
    """Return the gates that compare a closure with those nearby."""
    differs = Gate.of_known(
        "difference from closures nearby / tolerance", c.difference,
        np.nextafter(o.max_neighbour_difference, 0.0), Verdict.CONTRADICTED.value,
        "--lc_max_neighbour_difference", flag_value=c.difference + _MARGIN,
    )  # fmt: skip
    agrees = Gate.of(
        "query vertices nearby that agree", c.support, o.min_support, Verdict.NO_SUPPORT.value,
        "--lc_min_support", is_minimum=True, applies=differs.applies & ~differs.failed,
    )  # fmt: skip
    return [differs, agrees]


def closure_gates(c: GateValues | ClosureRecord, options: LoopClosureOptions) -> list[Gate]:
    """Return all gates of judged closures, in the order in which they are applied."""
    stages = (pose_gates, correction_gates, place_gates, neighbour_gates)
    by_hand = c.verdict == VERDICTS.index(Verdict.REMOVED)
    return [
        *(gate for stage in stages for gate in stage(c, options)),
        Gate.of("removed by hand", by_hand, 0.0, Verdict.REMOVED.value, unit=YES_NO),
    ]


def measure(
    vi_map: VIMap, query: I64, place: I64, solutions: PoseSolutions, is_known: Mask
) -> GateValues:
    """Measure closures (N) with estimated poses, before any of them is compared with others.

    Args:
        query: Query vertices (N,).
        place: Vertices of the places (N,).
        solutions: Estimated poses.
        is_known: Missions (M,) whose base frames are to be trusted.
    """
    a, b = vi_map.vertices.mission[query], vi_map.vertices.mission[place]
    way_m = path_lengths(vi_map)
    change = se3.local(vi_map.T_G_I[query], se3.compose(vi_map.T_G_M[b], solutions.T_M_I))
    known = np.flatnonzero(~np.isnan(solutions.covariance[:, 0, 0]))
    sigma_deg = np.full(len(solutions.covariance), np.nan)
    sigma_deg[known] = np.degrees(largest_sigma(solutions.covariance[known, 3:, 3:]))
    return GateValues(
        verdict=np.full(len(query), VERDICTS.index(Verdict.ACCEPTED), dtype=np.int8),
        matches=solutions.keypoint_count,
        inliers=solutions.inlier_count,
        tilt_deg=np.degrees(solutions.tilt_rad),
        rotation_sigma_deg=sigma_deg,
        correction_m=np.linalg.norm(change[:, :3], axis=1),
        correction_deg=np.degrees(np.linalg.norm(change[:, 3:], axis=1)),
        is_related=np.asarray((a == b) | (is_known[a] & is_known[b])),
        between_m=np.where(a == b, np.abs(way_m[query] - way_m[place]), np.nan),
        **_not_compared(len(query)),
    )


def _not_compared(count: int) -> dict[str, Any]:
    """Return the values of gates that compare closures, as of closures that did not reach them."""
    names = ("rival_share", "rival_stretches", "is_decided", "follows", "difference")
    unknown = {name: np.full(count, np.nan) for name in names}
    return {**unknown, "support": np.zeros(count, dtype=np.int64)}


@dataclasses.dataclass(frozen=True, eq=False)
class Judgement:
    """Closures (N) whose verdicts and values are filled in."""

    vi_map: VIMap
    query: I64  # (N,) vertices
    place: I64  # (N,)
    T_M_I: F64  # (N, 7) of the query, in the mission of the place
    values: GateValues  # changed in place
    options: LoopClosureOptions

    def refuse(self, which: Mask, reason: Verdict) -> None:
        """Reject closures unless another gate has rejected them before."""
        self.values.verdict[self.values.accepted & which] = VERDICTS.index(reason)

    def refuse_by(self, gates: list[Gate]) -> None:
        """Reject closures that fail gates."""
        for gate in gates:
            self.refuse(gate.failed, Verdict(gate.verdict))

    @functools.cached_property
    def way_m(self) -> tuple[F64, F64]:
        """Arc lengths (N,) along the missions to the query and to the place."""
        way_m = path_lengths(self.vi_map)
        return way_m[self.query], way_m[self.place]

    @functools.cached_property
    def missions(self) -> tuple[I64, I64]:
        """Missions (N,) of the query and of the place."""
        mission = self.vi_map.vertices.mission.astype(np.int64)
        return mission[self.query], mission[self.place]

    @functools.cached_property
    def stretch(self) -> I64:
        """Stretch (V,) of each vertex."""
        return mission_alignment.trajectory_stretches(self.vi_map)

    @functools.cached_property
    def is_usual(self) -> Mask:
        """Closures (N,) that correct no more than odometry usually drifts."""
        between_m, correction_m = self.values.between_m, self.values.correction_m
        since_m = np.where(np.isnan(between_m), sum(self.way_m), between_m)
        return np.asarray(correction_m <= _DRIFT_OFFSET_M + _USUAL_DRIFT_RATIO * since_m)

    @functools.cached_property
    def is_far(self) -> Mask:
        """Closures (N,) inside a mission that correct more than it can have drifted."""
        return correction_gates(self.values, self.options)[0].failed

    @functools.cached_property
    def paired(self) -> mission_alignment.LocatedClosures:
        """The closures as relative poses of their missions."""
        poses = self.vi_map.vertices.T_M_I[self.query], self.T_M_I
        stretches = self.stretch[self.query], self.stretch[self.place]
        columns = mission_alignment.ordered_by_mission(self.missions, poses, self.way_m, stretches)
        weight = self.values.inliers.astype(np.float64)
        return mission_alignment.LocatedClosures(weight, *columns)


def judge(
    vi_map: VIMap,
    query: I64,
    place: I64,
    T_M_I: F64,
    measured: GateValues,
    options: LoopClosureOptions,
    *,
    choice: ambiguity.AlignmentChoice | None = None,
) -> tuple[GateValues, list[ambiguity.Contest]]:
    """Apply all gates: geometry, plausible drift, ambiguity, consensus of neighbours.

    Args:
        query: Query vertices (N,).
        place: Vertices of the places (N,).
        T_M_I: Poses (N, 7) of the queries in the missions of the places.
        measured: Values of `measure`; closures that are not accepted there stay refused.
        choice: An alignment of two missions that a person has chosen.

    Returns:
        The values with those that compare closures, and the contests of missions to be aligned.

    Raises:
        UserError: The chosen alignment does not exist.
    """
    verdict = measured.verdict.copy()
    v = dataclasses.replace(measured, verdict=verdict, **_not_compared(len(query)))
    j = Judgement(vi_map, query, place, T_M_I, v, options)
    j.refuse(banned(vi_map, query, place), Verdict.REMOVED)
    j.refuse_by(pose_gates(v, options))
    j.refuse(np.isnan(v.rotation_sigma_deg), Verdict.FEW_INLIERS)
    geometric = v.accepted
    j.refuse_by(correction_gates(v, options))
    rows = np.flatnonzero(v.accepted & v.is_related & ~j.is_usual)
    v.rival_share[rows] = rival_shares(j, geometric)[rows]
    j.refuse_by(place_gates(v, options))
    v.follows[_repeats(j)] = 0.0
    contests = _contests(j, geometric, choice)
    j.refuse_by(place_gates(v, options))
    rows = np.flatnonzero(v.accepted)
    if len(rows):
        v.support[rows], v.difference[rows] = check_consensus(
            vi_map,
            query[rows],
            place[rows],
            T_M_I[rows],
            v.inliers[rows],
            options.max_neighbour_difference,
        )
        j.refuse_by(neighbour_gates(v, options))
    return v, contests


def _contests(
    j: Judgement, geometric: Mask, choice: ambiguity.AlignmentChoice | None
) -> list[ambiguity.Contest]:
    """Weigh the alignments of missions for which closures between unrelated missions vote.

    Closures with far places of the query's mission show which places look alike. `geometric` (N,) are
    those that passed the gates on their poses.
    """
    v, max_share = j.values, j.options.max_ambiguous_ratio
    voting = v.accepted & ~v.is_related
    v.follows[voting] = 0.0
    is_alias = geometric & j.is_far & (v.inliers >= _MIN_RIVAL_INLIERS)
    pairs = mission_alignment.alignments_of_pairs(j.paired, voting | is_alias)
    names = [to_hex(words)[:8] for words in j.vi_map.missions.id]
    contests = ambiguity.decide(j.vi_map, pairs, j.stretch, max_share, names)
    is_open = [contest.winner < 0 for contest in contests]
    if choice is not None:
        contests = ambiguity.with_choice(contests, choice)
    for contest, was_open in zip(contests, is_open, strict=True):
        rows = contest.pair.rows
        v.is_decided[rows] = contest.winner >= 0
        if contest.winner < 0 or not was_open:  # a person's choice needs no majority
            v.rival_stretches[rows] = contest.largest_rival_share()
        v.follows[contest.pair.alignments[max(contest.winner, 0)].rows] = 1.0
    return contests


# Ambiguous places: queries that match several places of a mission, or a distant place of their own.
#
# A mission is rigid up to its drift, so a query cannot be at two of its places at once. If it matches
# two places about equally well, its appearance does not determine the place. A closure with a third
# mission that observed only one of the two places is then unreliable too.

_MAX_TURN_RAD = 0.3
"""Angle between the poses that two places give, beyond which they are different places."""
_MIN_RIVAL_INLIERS = 20
"""Inliers of a distant place of the query's mission that reveal that places look alike."""


def rival_shares(j: Judgement, candidate: Mask) -> F64:
    """Return the inliers (N,) of each query's strongest other place relative to the best place.

    A distant place of the query's mission counts as equally strong. Candidates (N,) passed the gates on
    their poses.
    """
    inliers, place_way_m, mission = j.values.inliers, j.way_m[1], j.missions[1]
    rows = np.flatnonzero(candidate)
    order = rows[np.lexsort((-inliers[rows], mission[rows], j.query[rows]))]
    pair = j.query[order] * len(j.vi_map.missions) + mission[order]
    _, first, number = np.unique(pair, return_index=True, return_inverse=True)
    best = order[first[number]]
    apart_m = np.linalg.norm(j.T_M_I[order, 4:] - j.T_M_I[best, 4:], axis=1)
    between = se3.relative(j.T_M_I[best], j.T_M_I[order])
    turn_rad = np.linalg.norm(so3.log(between[:, :4]), axis=1)
    way_m = np.abs(place_way_m[order] - place_way_m[best])
    is_other = apart_m > _DRIFT_OFFSET_M + j.options.max_drift_ratio * way_m
    is_other |= turn_rad > _MAX_TURN_RAD
    queries, of_closure = np.unique(j.query, return_inverse=True)
    shares = np.zeros(len(queries))
    share = inliers[order] / np.maximum(inliers[best], 1)
    np.maximum.at(shares, of_closure[order], np.where(is_other, share, 0.0))
    shares[of_closure[candidate & j.is_far & (inliers >= _MIN_RIVAL_INLIERS)]] = 1.0
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


def _repeats(j: Judgement) -> Mask:
    """Return which closures (N,) join places of their mission that only look alike."""
    refused = np.zeros(len(j.query), dtype=np.bool_)
    candidate = j.values.accepted & (j.missions[0] == j.missions[1])
    unusual = candidate & ~j.is_usual
    if unusual.any():
        for pair in mission_alignment.alignments_of_pairs(j.paired, candidate):
            for rival in _rivals(j, pair):
                refused[rival.rows] = True
    return np.asarray(refused & unusual)


def _rivals(j: Judgement, pair: mission_alignment.MissionPair) -> list[mission_alignment.Alignment]:
    """Return the groups of closures that lose against those of usual drift."""
    usual = [a for a in pair.alignments if np.mean(j.is_usual[a.rows]) > 0.5]
    explained = np.unique(
        np.concatenate([np.zeros(0, dtype=np.int64), *(_stretches(a) for a in usual)])
    )
    if len(explained) < _MIN_STRETCHES:
        return []
    unmatched = functools.partial(
        mission_alignment.unmatched_share, j.vi_map, pair, stretch=j.stretch
    )
    least = min(map(unmatched, usual))
    return [
        a
        for a in pair.alignments
        if np.mean(j.is_usual[a.rows]) <= 0.5
        and (
            _adds_little(_stretches(a), explained)
            or mission_alignment.is_refuted(unmatched(a), least)
        )
    ]


def _adds_little(group: I64, explained: I64) -> bool:
    """Return whether most stretches of a group, and significantly more others, are explained without it."""
    theirs = len(np.setdiff1d(group, explained))
    ours = len(np.setdiff1d(explained, group))
    return ambiguity.is_significant(ours, theirs) and theirs <= _MAX_NEW_SHARE * len(group)


def _stretches(alignment: mission_alignment.Alignment) -> I64:
    return np.union1d(alignment.stretches_A, alignment.stretches_B)
