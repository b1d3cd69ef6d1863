"""Which flags would accept a refused closure: the gates on its pose, then those among closures."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from maplab_py.algorithms.loop_closure.closure_record import ClosureRecord
from maplab_py.algorithms.loop_closure.closure_table import VERDICTS
from maplab_py.algorithms.loop_closure.differences import DIFFERENCES, consensus_of_record
from maplab_py.algorithms.loop_closure.gate_values import (
    RATIO_MARGIN,
    GateValues,
    Relations,
    geometric_gates,
    rival_shares,
)
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.reports import Verdict
from maplab_py.vimap import VIMap

_PREFIX = "--lc_"
_DIGITS = 4


@dataclasses.dataclass(frozen=True)
class Acceptance:
    """Flags that move all gates that a closure fails, and what would be decided with them."""

    flags: tuple[str, ...]  # --NAME=VALUE
    verdict: Verdict


def acceptance(
    vi_map: VIMap,
    closures: ClosureRecord,
    row: int,
    gates: list[GateValues],
    options: LoopClosureOptions,
) -> Acceptance | None:
    """Return the flags with which a recorded closure passes its gates; None if a gate has no flag.

    The decision is made from the record: closures that these flags admit as well take part in it,
    but a search with them may estimate other poses.

    Args:
        vi_map: The map.
        closures: All recorded closures.
        row: The closure.
        gates: Its gates with the present flags, as `gate_values` gives them.
        options: The present flags.
    """
    failed = [gate for gate in gates if gate.failed[row]]
    if not failed or any(not gate.flag for gate in failed):
        return None
    changes = {gate.flag.removeprefix(_PREFIX): _passing_value(gate, row) for gate in failed}
    moved = _moved(options, changes)
    decision = _decision(vi_map, closures, row, moved)
    larger = [value for value in DIFFERENCES if value > moved.max_neighbour_difference]
    while further := _further_change(decision, larger):
        changes |= further
        moved = _moved(options, changes)
        decision = _decision(vi_map, closures, row, moved)
    return Acceptance(
        tuple(f"{_PREFIX}{name}={getattr(moved, name):g}" for name in changes), decision.verdict
    )


@dataclasses.dataclass(frozen=True)
class _Decision:
    """What would be decided on a closure, and the values that the gates among closures compare."""

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
        return {"ambiguous_inlier_ratio": round(decision.rival_share + RATIO_MARGIN, _DIGITS)}
    if decision.verdict is Verdict.CONTRADICTED and larger:
        return {"max_neighbour_difference": larger.pop(0)}
    if decision.verdict is Verdict.NO_SUPPORT:
        return {"min_support": decision.support}
    return {}


def _passing_value(gate: GateValues, row: int) -> float:
    """Return the flag's value with which the closure passes, rounded so that it does."""
    value = float(gate.flag_value[row])
    scale = 10.0 ** (_DIGITS - 1 - math.floor(math.log10(max(abs(value), 1e-9))))
    return (math.floor if gate.is_minimum else math.ceil)(value * scale) / scale


def _moved(options: LoopClosureOptions, changes: dict[str, float]) -> LoopClosureOptions:
    kinds = {name: type(getattr(options, name)) for name in changes}
    values = {name: kinds[name](value) for name, value in changes.items()}
    return dataclasses.replace(options, **values)


def _decision(
    vi_map: VIMap, closures: ClosureRecord, row: int, options: LoopClosureOptions
) -> _Decision:
    """Return what is decided on a closure that passes the gates on its pose."""
    c, relations = closures, Relations.of(vi_map, closures, options)
    failed = np.any([gate.failed for gate in geometric_gates(vi_map, c, options)], axis=0)
    is_far = relations.same & (c.correction_m > relations.drift_m)
    shares = rival_shares(vi_map, c, np.asarray(~failed), is_far, options)
    is_alike = relations.related & (shares >= options.ambiguous_inlier_ratio)
    support = int(c.support[row])
    if is_alike[row] and not failed[row]:
        return _Decision(Verdict.AMBIGUOUS, support, float(shares[row]))
    was_alike = c.verdict == VERDICTS.index(Verdict.AMBIGUOUS)
    out = (was_alike & (is_alike | ~relations.related)) | (
        c.verdict == VERDICTS.index(Verdict.REMOVED)
    )
    left = np.flatnonzero(~failed & ~out)
    place = np.flatnonzero(left == row)
    if not len(place):
        return _Decision(VERDICTS[c.verdict[row]], support)
    supports, supported, contradicted = consensus_of_record(vi_map, c.take(left), options)
    number = int(place[0])
    verdict = Verdict.ACCEPTED if supported[number] else Verdict.NO_SUPPORT
    verdict = Verdict.CONTRADICTED if contradicted[number] else verdict
    return _Decision(verdict, int(supports[number]))
