"""Acceptance gates of closures; the verdict is the first gate that a closure fails."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.loop_closure.alignment_contest import (
    AlignmentChoice,
    Contest,
    ContestRule,
    decide,
    with_choice,
)
from maplab_py.algorithms.loop_closure.ambiguity import AmbiguityRule, ambiguous_queries
from maplab_py.algorithms.loop_closure.closure_table import VERDICTS
from maplab_py.algorithms.loop_closure.consensus import (
    ConsensusRule,
    check_consensus,
    path_lengths,
)
from maplab_py.algorithms.loop_closure.mission_alignment import (
    AgreementRule,
    PairedClosures,
    alignments_of_pairs,
)
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.record_updates import banned
from maplab_py.algorithms.loop_closure.repeated_places import with_places_that_look_alike
from maplab_py.algorithms.loop_closure.reports import Verdict
from maplab_py.algorithms.loop_closure.stretches import trajectory_stretches
from maplab_py.array_types import F64, I64, Mask
from maplab_py.geometry import se3
from maplab_py.vimap import VIMap
from maplab_py.vimap.ids import to_hex
from maplab_py.vision.absolute_pose import PoseSolutions

_DRIFT_OFFSET_M = 0.5
_USUAL_DRIFT_RATIO = 0.02
"""Drift relative to the path length, which closures between ambiguous places must not exceed.
Between missions of known base frames the path begins at their starts: anchoring leaves drift."""


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
    s = solutions
    mission = vi_map.vertices.mission[place].astype(np.int64)
    same = vi_map.vertices.mission[query] == mission
    related = is_known[vi_map.vertices.mission[query]] & is_known[mission]
    change = se3.local(vi_map.T_G_I[query], se3.compose(vi_map.T_G_M[mission], s.T_M_I))
    judgement = Judgement(
        verdict=np.full(len(query), VERDICTS.index(Verdict.ACCEPTED), dtype=np.int8),
        support=np.zeros(len(query), dtype=np.int64),
        correction_m=np.linalg.norm(change[:, :3], axis=1),
        correction_deg=np.degrees(np.linalg.norm(change[:, 3:], axis=1)),
    )
    _check_geometry(vi_map, query, place, s, options, judgement)
    geometric = judgement.passing
    way = path_lengths(vi_map)
    drift = _DRIFT_OFFSET_M + options.max_drift_ratio * np.abs(way[query] - way[place])
    is_far_same_mission = same & (judgement.correction_m > drift)
    limited = same | related
    judgement.refuse(
        is_far_same_mission | _beyond(options, judgement, limited), Verdict.IMPLAUSIBLE
    )
    rule = AmbiguityRule(
        _DRIFT_OFFSET_M, options.max_drift_ratio, inlier_share=options.ambiguous_inlier_ratio
    )
    ambiguous = np.isin(
        query,
        ambiguous_queries(
            query,
            way[place],
            mission,
            s.T_M_I,
            s.inlier_count,
            is_far_same_mission,
            geometric,
            rule,
        ),
    )
    # odometry and known base frames resolve the ambiguity
    since = np.where(same, np.abs(way[query] - way[place]), way[query] + way[place])
    usual = _DRIFT_OFFSET_M + _USUAL_DRIFT_RATIO * since
    resolved = limited & (judgement.correction_m <= usual)
    judgement.refuse(ambiguous & ~resolved & limited, Verdict.AMBIGUOUS)
    is_alias = geometric & is_far_same_mission & (s.inlier_count >= rule.min_inliers)
    _weigh_alignments(
        vi_map,
        query,
        place,
        s,
        judgement,
        _Relation(~limited, same, is_alias, judgement.correction_m <= usual),
        ContestRule(options.max_ambiguous_ratio),
        choice,
    )
    _check_neighbours(vi_map, query, place, s, options, judgement)
    return judgement


def _check_geometry(
    vi_map: VIMap,
    query: I64,
    place: I64,
    s: PoseSolutions,
    options: LoopClosureOptions,
    judgement: Judgement,
) -> None:
    """Reject closures that a user has removed or whose pose few or badly placed inliers determine."""
    judgement.refuse(banned(vi_map, query, place), Verdict.REMOVED)
    judgement.refuse(s.inlier_count < options.min_inlier_count, Verdict.FEW_INLIERS)
    low = s.inlier_count < options.min_inlier_ratio * s.keypoint_count
    judgement.refuse(low, Verdict.LOW_RATIO)
    tilted = np.degrees(s.tilt_rad) > options.max_gravity_deviation_deg
    judgement.refuse(tilted, Verdict.TILTED)
    judgement.refuse(np.isnan(s.covariance[:, 0, 0]), Verdict.FEW_INLIERS)
    uncertain = rotation_sigma_deg(s.covariance) > options.max_rotation_sigma_deg
    judgement.refuse(uncertain, Verdict.UNCERTAIN)


def rotation_sigma_deg(covariance: F64) -> F64:
    """Return the standard deviation (N,) about the worst axis, of covariances (N, 6, 6) of [dp, dtheta].

    It is NaN if the rotation is not determined.
    """
    known = np.flatnonzero(~np.isnan(covariance[:, 0, 0]))
    sigma_rad = np.full(len(covariance), np.nan)
    largest = np.linalg.eigvalsh(covariance[known, 3:, 3:])[:, -1]
    sigma_rad[known] = np.sqrt(np.maximum(largest, 0.0))
    return np.asarray(np.degrees(sigma_rad))


def _beyond(options: LoopClosureOptions, judgement: Judgement, limited: Mask) -> Mask:
    """Return which closures (N,) exceed the user's limits on the correction."""
    beyond = np.zeros(len(limited), dtype=np.bool_)
    if options.max_delta_position_m >= 0.0:
        beyond |= judgement.correction_m > options.max_delta_position_m
    if options.max_delta_rotation_deg >= 0.0:
        beyond |= judgement.correction_deg > options.max_delta_rotation_deg
    return beyond & limited


def _check_neighbours(
    vi_map: VIMap,
    query: I64,
    place: I64,
    solutions: PoseSolutions,
    options: LoopClosureOptions,
    judgement: Judgement,
) -> None:
    """Reject closures that their neighbours contradict or do not support."""
    left = np.flatnonzero(judgement.passing)
    if len(left) == 0:
        return
    rule = ConsensusRule(
        min_support=options.min_support, max_difference=options.max_neighbour_difference
    )
    support, supported, contradicted = check_consensus(
        vi_map,
        query[left],
        place[left],
        solutions.T_M_I[left],
        solutions.inlier_count[left],
        rule,
    )
    judgement.support[left] = support
    judgement.verdict[left[contradicted]] = VERDICTS.index(Verdict.CONTRADICTED)
    judgement.verdict[left[~supported & ~contradicted]] = VERDICTS.index(Verdict.NO_SUPPORT)


@dataclasses.dataclass(frozen=True, eq=False)
class _Relation:
    """What is known about the missions that closures (N,) join."""

    unrelated: Mask  # different missions without known relative pose
    same: Mask  # one mission
    is_alias: Mask  # one mission, but farther apart than it can have drifted
    is_usual: Mask  # corrects no more than odometry usually drifts


def _weigh_alignments(
    vi_map: VIMap,
    query: I64,
    place: I64,
    solutions: PoseSolutions,
    judgement: Judgement,
    relation: _Relation,
    rule: ContestRule,
    choice: AlignmentChoice | None,
) -> None:
    """Reject closures that follow no winning alignment of their missions.

    Closures with far places of the query's mission show which places look alike.
    """
    v, way, stretch = vi_map.vertices, path_lengths(vi_map), trajectory_stretches(vi_map)
    closures = PairedClosures.of(
        (v.mission[query].astype(np.int64), v.mission[place].astype(np.int64)),
        (v.T_M_I[query], solutions.T_M_I),
        (way[query], way[place]),
        (stretch[query], stretch[place]),
        solutions.inlier_count.astype(np.float64),
    )
    inside = judgement.passing & relation.same
    repeated = with_places_that_look_alike(
        vi_map, closures, inside, relation.is_usual, stretch, rule
    )
    judgement.refuse(repeated, Verdict.AMBIGUOUS)
    candidate = judgement.passing & relation.unrelated
    pairs = alignments_of_pairs(closures, candidate | relation.is_alias, AgreementRule())
    names = [to_hex(words)[:8] for words in vi_map.missions.id]
    contests = decide(vi_map, pairs, stretch, rule, names)
    if choice is not None:
        contests = with_choice(contests, choice)
    judgement.contests.extend(contests)
    follows = np.zeros(len(query), dtype=np.bool_)
    for contest in contests:
        follows[contest.accepted] = True
    judgement.refuse(candidate & ~follows, Verdict.AMBIGUOUS)
