"""Which flags would accept a refused closure: the gates on its pose, then those among closures."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from maplab_py.algorithms.loop_closure.closure_record import ClosureRecord
from maplab_py.algorithms.loop_closure.closure_table import VERDICTS
from maplab_py.algorithms.loop_closure.consensus import ConsensusRule, check_consensus
from maplab_py.algorithms.loop_closure.gate_values import (
    RIVAL_SHARE,
    GateValues,
    Relations,
    geometric_gates,
    rival_shares,
)
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.reports import Verdict
from maplab_py.geometry import se3
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
    verdict, support = _decision(vi_map, closures, row, moved)
    if verdict is Verdict.NO_SUPPORT:
        changes["min_support"] = support
        moved = _moved(options, changes)
        verdict, _ = _decision(vi_map, closures, row, moved)
    return Acceptance(
        tuple(f"{_PREFIX}{name}={getattr(moved, name):g}" for name in changes), verdict
    )


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
) -> tuple[Verdict, int]:
    """Return the verdict on a closure that passes the gates on its pose, and its support."""
    c, relations = closures, Relations.of(vi_map, closures, options)
    failed = np.any([gate.failed for gate in geometric_gates(vi_map, c, options)], axis=0)
    is_far = relations.same & (c.correction_m > relations.drift_m)
    if relations.related[row] and not failed[row]:
        shares = rival_shares(vi_map, c, np.asarray(~failed), is_far, options)
        if shares[row] >= RIVAL_SHARE:
            return Verdict.AMBIGUOUS, int(c.support[row])
    out = [VERDICTS.index(v) for v in (Verdict.AMBIGUOUS, Verdict.REMOVED)]
    left = np.flatnonzero(~failed & ~np.isin(c.verdict, out))
    place = np.flatnonzero(left == row)
    if not len(place):
        return VERDICTS[c.verdict[row]], int(c.support[row])
    query, target = (vi_map.vertex_index.rows(ids[left]) for ids in (c.query, c.place))
    T_M_I = se3.compose(vi_map.vertices.T_M_I[target], se3.inverse(c.T_A_B[left]))
    support, supported, contradicted = check_consensus(
        vi_map,
        query.astype(np.int64),
        target.astype(np.int64),
        T_M_I,
        c.inliers[left].astype(np.int64),
        ConsensusRule(min_support=options.min_support),
    )
    number = int(place[0])
    verdict = Verdict.ACCEPTED if supported[number] else Verdict.NO_SUPPORT
    return (Verdict.CONTRADICTED if contradicted[number] else verdict), int(support[number])
