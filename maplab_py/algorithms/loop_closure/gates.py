"""The gates that a closure has to pass; the first that it fails is its verdict."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.loop_closure.ambiguity import AmbiguityRule, ambiguous_queries
from maplab_py.algorithms.loop_closure.closures import VERDICTS
from maplab_py.algorithms.loop_closure.consensus import (
    ConsensusRule,
    check_consensus,
    path_lengths,
)
from maplab_py.algorithms.loop_closure.mission_pairs import (
    PairedClosures,
    PairRule,
    without_alignment,
)
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.recording import banned
from maplab_py.algorithms.loop_closure.report import Verdict
from maplab_py.geometry import se3
from maplab_py.vimap import VIMap
from maplab_py.vision.absolute_pose import PoseSolutions

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Mask = NDArray[np.bool_]

_DRIFT_OFFSET_M = 0.5
_USUAL_DRIFT_RATIO = 0.02
"""Of the way; among places that look alike, a closure has to keep within it. Between missions of
known base frames the way counts from where they began: what anchoring has left."""


@dataclasses.dataclass(frozen=True, eq=False)
class Judgement:
    """Verdicts on closures (N) and what they stand on."""

    verdict: NDArray[np.int8]  # (N,) index into VERDICTS
    support: I64  # (N,)
    correction_m: F64  # (N,)
    correction_deg: F64  # (N,)

    def refuse(self, which: Mask, reason: Verdict) -> None:
        """Refuse those of the closures that no gate has refused yet."""
        self.verdict[self.passing & which] = VERDICTS.index(reason)

    @property
    def passing(self) -> Mask:
        """Which closures (N,) no gate has refused yet."""
        return np.asarray(self.verdict == VERDICTS.index(Verdict.ACCEPTED))


def judge(
    vi_map: VIMap,
    query: I64,
    place: I64,
    solutions: PoseSolutions,
    options: LoopClosureOptions,
    *,
    is_known: Mask,
) -> Judgement:
    """Judge closures: geometry, plausibility against drift, look-alikes, consensus of neighbours.

    Args:
        vi_map: The map.
        query: Query vertices (N,).
        place: Vertices of the places (N,).
        solutions: Poses found.
        options: Thresholds.
        is_known: Missions (M,) whose base frames are to be trusted.
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
    judgement.refuse(banned(vi_map, query, place), Verdict.REMOVED)
    judgement.refuse(s.inlier_count < options.min_inlier_count, Verdict.FEW_INLIERS)
    low = s.inlier_count < options.min_inlier_ratio * s.keypoint_count
    judgement.refuse(low, Verdict.LOW_RATIO)
    tilted = np.degrees(s.tilt_rad) > options.max_gravity_deviation_deg
    judgement.refuse(tilted, Verdict.TILTED)
    judgement.refuse(np.isnan(s.covariance[:, 0, 0]), Verdict.FEW_INLIERS)
    uncertain = rotation_sigma_deg(s.covariance) > options.max_rotation_sigma_deg
    judgement.refuse(uncertain, Verdict.UNCERTAIN)
    geometric = judgement.passing
    way = path_lengths(vi_map)
    drift = _DRIFT_OFFSET_M + options.max_drift_ratio * np.abs(way[query] - way[place])
    is_far_own = same & (judgement.correction_m > drift)
    limited = same | related
    judgement.refuse(is_far_own | _beyond(options, judgement, limited), Verdict.IMPLAUSIBLE)
    rule = AmbiguityRule(_DRIFT_OFFSET_M, options.max_drift_ratio)
    unclear = np.isin(
        query,
        ambiguous_queries(
            query, way[place], mission, s.T_M_I, s.inlier_count, is_far_own, geometric, rule
        ),
    )
    # odometry and known base frames tell which of the places it is
    since = np.where(same, np.abs(way[query] - way[place]), way[query] + way[place])
    usual = _DRIFT_OFFSET_M + _USUAL_DRIFT_RATIO * since
    settled = limited & (judgement.correction_m <= usual)
    judgement.refuse(unclear & ~settled, Verdict.AMBIGUOUS)
    _check_neighbours(vi_map, query, place, s, options, judgement)
    _check_pairs(vi_map, query, place, s, options, judgement, ~limited)
    return judgement


def rotation_sigma_deg(covariance: F64) -> F64:
    """Return the standard deviation (N,) about the worst axis, of covariances (N, 6, 6) of [dp, dtheta].

    It is nan where nothing is determined.
    """
    known = np.flatnonzero(~np.isnan(covariance[:, 0, 0]))
    sigma_rad = np.full(len(covariance), np.nan)
    largest = np.linalg.eigvalsh(covariance[known, 3:, 3:])[:, -1]
    sigma_rad[known] = np.sqrt(np.maximum(largest, 0.0))
    return np.asarray(np.degrees(sigma_rad))


def _beyond(options: LoopClosureOptions, judgement: Judgement, limited: Mask) -> Mask:
    """Tell which closures (N,) correct more than the user allows."""
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
    """Refuse closures that their neighbours contradict or do not support."""
    left = np.flatnonzero(judgement.passing)
    if len(left) == 0:
        return
    rule = ConsensusRule(min_support=options.min_support)
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


def _check_pairs(
    vi_map: VIMap,
    query: I64,
    place: I64,
    solutions: PoseSolutions,
    options: LoopClosureOptions,
    judgement: Judgement,
    unrelated: Mask,
) -> None:
    """Refuse closures between missions of unknown relation that do not tell a clear alignment."""
    v, way = vi_map.vertices, path_lengths(vi_map)
    closures = PairedClosures.of(
        (v.mission[query].astype(np.int64), v.mission[place].astype(np.int64)),
        (v.T_M_I[query], solutions.T_M_I),
        (way[query], way[place]),
        solutions.inlier_count.astype(np.float64),
    )
    looks_alike = judgement.verdict == VERDICTS.index(Verdict.AMBIGUOUS)
    rule = PairRule(_DRIFT_OFFSET_M, options.max_drift_ratio, options.max_ambiguous_ratio)
    refused = without_alignment(closures, judgement.passing & unrelated, looks_alike, rule)
    judgement.refuse(refused, Verdict.AMBIGUOUS)
