"""Gates of recorded closures, as `gates` judges them, and the flags that would accept one.

Geometry, correction and support are those of the record. Rivals of ambiguous places, alignments of
missions and differences between neighbours are computed from the record and the present poses.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from maplab_py.algorithms.gate import YES_NO, Gate, any_failed
from maplab_py.algorithms.loop_closure.alignment_contest import Contest
from maplab_py.algorithms.loop_closure.closure_record import ClosureRecord
from maplab_py.algorithms.loop_closure.closure_table import VERDICTS
from maplab_py.algorithms.loop_closure.gates import (
    MeasuredClosures,
    consensus,
    contests_of_missions,
    correction_gates,
    looks_alike,
    pose_gates,
    shares_of_rivals,
)
from maplab_py.algorithms.loop_closure.mission_alignment import is_refuted
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.reports import Verdict
from maplab_py.array_types import F64, Mask
from maplab_py.vimap import VIMap

_DIFFERENCES = (1.1, 1.25, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 7.0, 10.0, 20.0, 50.0, 100.0, 1000.0)
"""Values of --lc_max_neighbour_difference that are tried; with the last one all closures agree."""
_RATIO_MARGIN = 1e-3
"""Added to a ratio that must stay below its flag."""
_PREFIX = "--lc_"
_DIGITS = 4


def recorded_gates(
    vi_map: VIMap, closures: ClosureRecord, options: LoopClosureOptions
) -> list[Gate]:
    """Return the gates in the order in which they are applied.

    Args:
        vi_map: The map.
        closures: All recorded closures (N): places look alike in comparison with others.
        options: Thresholds.
    """
    c, o = MeasuredClosures.of_record(vi_map, closures), options
    pose = pose_gates(c, o)
    geometric = ~any_failed(pose)
    rivals = shares_of_rivals(c, geometric, o)
    is_alike = _has_verdict(closures, Verdict.AMBIGUOUS)
    contest = _contest_values(vi_map, c, closures, geometric, o)
    is_contested = is_alike & ~c.related
    return [
        *pose,
        *correction_gates(c, o),
        Gate.of(
            "inliers of another place / of the best", rivals,
            np.nextafter(o.ambiguous_inlier_ratio, 0.0), Verdict.AMBIGUOUS.value,
            "--lc_ambiguous_inlier_ratio", applies=is_alike & c.related,
            flag_value=rivals + _RATIO_MARGIN,
        ),
        Gate.of(
            "stretches only another alignment explains / only the best", contest.rival_share,
            o.max_ambiguous_ratio, Verdict.AMBIGUOUS.value, "--lc_max_ambiguous_ratio",
            applies=is_contested,
        ),
        Gate.of(
            "an alignment of the missions wins", contest.is_decided, 1.0,
            Verdict.AMBIGUOUS.value, unit=YES_NO, is_minimum=True, applies=is_contested,
        ),
        Gate.of(
            "agrees with the best alignment", contest.follows, 1.0, Verdict.AMBIGUOUS.value,
            unit=YES_NO, is_minimum=True, applies=is_contested,
        ),
        Gate.of(
            "query vertices nearby that agree", closures.support, o.min_support,
            Verdict.NO_SUPPORT.value, "--lc_min_support", is_minimum=True,
            applies=_has_verdict(closures, Verdict.NO_SUPPORT),
        ),
        Gate.of(
            "difference from closures nearby / tolerance", _differences(vi_map, c, closures, o),
            o.max_neighbour_difference, Verdict.CONTRADICTED.value,
            "--lc_max_neighbour_difference", applies=_has_verdict(closures, Verdict.CONTRADICTED),
        ),
        Gate.of(
            "removed by hand", _has_verdict(closures, Verdict.REMOVED), 0.0,
            Verdict.REMOVED.value, unit=YES_NO,
        ),
    ]  # fmt: skip


def shortfalls(gates: list[Gate]) -> F64:
    """Return how far each closure (N,) is from passing: the sum over the gates that it fails."""
    return np.asarray(np.sum([gate.shortfall for gate in gates], axis=0), dtype=np.float64)


def _has_verdict(closures: ClosureRecord, *verdicts: Verdict) -> Mask:
    return np.isin(closures.verdict, [VERDICTS.index(verdict) for verdict in verdicts])


@dataclasses.dataclass(frozen=True, eq=False)
class _ContestValues:
    """Comparison of the alignments of the missions of closures (N)."""

    rival_share: F64  # largest share of stretches that only a rival explains
    is_decided: F64  # 1 where an alignment wins
    follows: F64  # 1 where the closure supports the best alignment


def _contest_values(
    vi_map: VIMap,
    c: MeasuredClosures,
    closures: ClosureRecord,
    geometric: Mask,
    options: LoopClosureOptions,
) -> _ContestValues:
    # the neighbours judge what has passed the contest
    passed = _has_verdict(
        closures,
        Verdict.ACCEPTED,
        Verdict.AMBIGUOUS,
        Verdict.NO_SUPPORT,
        Verdict.CONTRADICTED,
    )
    values = _ContestValues(np.zeros(len(closures)), *np.ones((2, len(closures))))
    for contest in contests_of_missions(vi_map, c, passed, geometric, options):
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


def _differences(
    vi_map: VIMap, c: MeasuredClosures, closures: ClosureRecord, options: LoopClosureOptions
) -> F64:
    """Return the smallest of `_DIFFERENCES` with which each closure (N,) agrees with those nearby.

    It is 0 for closures that were not refused because closures nearby contradict them. Closures of
    other pairs of missions, which cannot contradict them, do not take part.
    """
    value = np.zeros(len(closures))
    contradicted = _has_verdict(closures, Verdict.CONTRADICTED)
    if not contradicted.any():
        return value
    compares = _has_verdict(closures, Verdict.CONTRADICTED, Verdict.ACCEPTED, Verdict.NO_SUPPORT)
    pair = c.mission_query * len(vi_map.missions) + c.mission_place
    left = np.flatnonzero(compares & np.isin(pair, pair[contradicted]))
    compared, refused = c.take(left), contradicted[left]
    smallest = np.full(len(left), _DIFFERENCES[-1])
    for difference in _DIFFERENCES[:-1]:
        moved = dataclasses.replace(options, max_neighbour_difference=difference)
        _, _, still = consensus(vi_map, compared, moved)
        smallest[~still] = np.minimum(smallest[~still], difference)
        if not (still & refused).any():
            break
    value[left[refused]] = smallest[refused]
    return value


@dataclasses.dataclass(frozen=True)
class Acceptance:
    """Flags that move all gates that a closure fails, and the verdict with them."""

    flags: tuple[str, ...]  # --NAME=VALUE
    verdict: Verdict


def acceptance(
    vi_map: VIMap,
    closures: ClosureRecord,
    row: int,
    gates: list[Gate],
    options: LoopClosureOptions,
) -> Acceptance | None:
    """Return the flags with which a recorded closure passes its gates; None if a gate has no flag.

    The decision is made from the record: closures that these flags admit as well take part in it,
    but a search with them may estimate other poses.

    Args:
        vi_map: The map.
        closures: All recorded closures.
        row: The closure.
        gates: Its gates with the present flags, as `recorded_gates` gives them.
        options: The present flags.
    """
    failed = [gate for gate in gates if gate.failed[row]]
    if not failed or any(not gate.flag for gate in failed):
        return None
    changes = {gate.flag.removeprefix(_PREFIX): _passing_value(gate, row) for gate in failed}
    moved = _move(options, changes)
    decision = _decide(vi_map, closures, row, moved)
    larger = [value for value in _DIFFERENCES if value > moved.max_neighbour_difference]
    while further := _further_change(decision, larger):
        changes |= further
        moved = _move(options, changes)
        decision = _decide(vi_map, closures, row, moved)
    return Acceptance(
        tuple(f"{_PREFIX}{name}={getattr(moved, name):g}" for name in changes), decision.verdict
    )


@dataclasses.dataclass(frozen=True)
class _Decision:
    """Verdict on a closure, and the values that the gates among closures compare."""

    verdict: Verdict
    support: int
    rival_share: float = 0.0  # inliers of another place / of the best


def _further_change(decision: _Decision, larger: list[float]) -> dict[str, float]:
    """Return the option that the gate moves that fails next; empty when none fails or none moves it.

    Args:
        decision: The gate that fails.
        larger: Differences between neighbours that have not been tried; the next one is removed.
    """
    if decision.verdict is Verdict.AMBIGUOUS and decision.rival_share > 0.0:
        return {"ambiguous_inlier_ratio": round(decision.rival_share + _RATIO_MARGIN, _DIGITS)}
    if decision.verdict is Verdict.CONTRADICTED and larger:
        return {"max_neighbour_difference": larger.pop(0)}
    if decision.verdict is Verdict.NO_SUPPORT:
        return {"min_support": decision.support}
    return {}


def _passing_value(gate: Gate, row: int) -> float:
    """Return the flag's value with which the closure passes, rounded so that it does."""
    value = float(gate.flag_value[row])
    scale = 10.0 ** (_DIGITS - 1 - math.floor(math.log10(max(abs(value), 1e-9))))
    return (math.floor if gate.is_minimum else math.ceil)(value * scale) / scale


def _move(options: LoopClosureOptions, changes: dict[str, float]) -> LoopClosureOptions:
    kinds = {name: type(getattr(options, name)) for name in changes}
    values = {name: kinds[name](value) for name, value in changes.items()}
    return dataclasses.replace(options, **values)


def _decide(
    vi_map: VIMap, closures: ClosureRecord, row: int, options: LoopClosureOptions
) -> _Decision:
    """Return the decision on a closure that passes the gates on its pose."""
    c = MeasuredClosures.of_record(vi_map, closures)
    pose = any_failed(pose_gates(c, options))
    failed = pose | any_failed(correction_gates(c, options))
    shares = shares_of_rivals(c, ~pose, options)
    is_alike = looks_alike(c, shares, options)
    support = int(closures.support[row])
    if is_alike[row] and not failed[row]:
        return _Decision(Verdict.AMBIGUOUS, support, float(shares[row]))
    was_alike = _has_verdict(closures, Verdict.AMBIGUOUS)
    out = (was_alike & (is_alike | ~c.related)) | _has_verdict(closures, Verdict.REMOVED)
    left = np.flatnonzero(~failed & ~out)
    place = np.flatnonzero(left == row)
    if not len(place):
        return _Decision(VERDICTS[closures.verdict[row]], support)
    supports, supported, contradicted = consensus(vi_map, c.take(left), options)
    number = int(place[0])
    verdict = Verdict.ACCEPTED if supported[number] else Verdict.NO_SUPPORT
    verdict = Verdict.CONTRADICTED if contradicted[number] else verdict
    return _Decision(verdict, int(supports[number]))
