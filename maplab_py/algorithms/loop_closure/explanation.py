"""Explanations of refused closures and of missions that are not joined: every gate with its value."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

from maplab_py.algorithms.gate import Gate, any_failed, failures
from maplab_py.algorithms.loop_closure import listing, record_updates
from maplab_py.algorithms.loop_closure.closure_record import ClosureRecord, read_record
from maplab_py.algorithms.loop_closure.closure_table import VERDICTS, GateValues
from maplab_py.algorithms.loop_closure.detection import detect
from maplab_py.algorithms.loop_closure.gates import closure_gates, judge
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.reports import OF_CLOUDS, Verdict
from maplab_py.array_types import I64, Mask
from maplab_py.geometry import se3
from maplab_py.progress import SILENT, Progress
from maplab_py.report import Report, counted
from maplab_py.vimap import VIMap, to_hex, to_hex_list

_NEAREST = 5


@dataclasses.dataclass(frozen=True)
class GateLine:
    """One gate for one closure or landmark."""

    gate: str
    value: str
    wanted: str
    result: str  # passed or failed
    flag: str  # moves the threshold


class ClosureExplanation(Report):
    """Gates of one closure."""

    closure: str
    query: str  # mission
    query_s: float
    place: str
    place_s: float
    verdict: str
    use: str
    weight: float
    gates: tuple[GateLine, ...]
    summary: str = dataclasses.field(metadata={"is_prose": True})


@dataclasses.dataclass(frozen=True)
class PairGate:
    """One gate for all closures between two missions."""

    gate: str
    failed: int  # closures
    nearest: str  # value of the closure that fails by least
    wanted: str
    flag: str


@dataclasses.dataclass(frozen=True)
class NearMiss:
    """A refused closure that nearly passes the gates."""

    closure: str
    verdict: str
    gates_failed: int
    shortfall: float  # relative to the thresholds, summed over the gates


class PairExplanation(Report):
    """Gates that the closures between two missions fail."""

    missions: tuple[str, str]
    closures: int
    accepted: int
    gates: tuple[PairGate, ...]
    nearest: tuple[NearMiss, ...] = dataclasses.field(metadata={"title": "refused by least"})
    summary: str = dataclasses.field(metadata={"is_prose": True})


class MissionExplanation(Report):
    """Whether the base frame of a mission is known, and its closures with every other mission."""

    mission: str
    known: bool
    pairs: tuple[PairLine, ...] = dataclasses.field(metadata={"title": ""})
    summary: str = dataclasses.field(metadata={"is_prose": True})


@dataclasses.dataclass(frozen=True)
class PairLine:
    """The closures of a mission with another one."""

    other: str
    known: bool
    accepted: int
    refused: int
    most_refused_for: str


def explain_closure(vi_map: VIMap, row: int, options: LoopClosureOptions) -> ClosureExplanation:
    """Return the gates of a recorded closure (a row of the closures of `read_record`)."""
    closures = read_record(vi_map).closures
    line = listing.describe_closure(vi_map, row)
    gates = closure_gates(closures, options)
    lines = [
        GateLine(gate.name, *gate.describe(row), gate.flag) for gate in gates if gate.applies[row]
    ]
    verdict = VERDICTS[closures.verdict[row]]
    failed = [gate for gate in gates if gate.failed[row]]
    if verdict is not Verdict.ACCEPTED and not failed:
        lines.append(GateLine(verdict.value, "yes", "no", "failed", ""))
    shared = ("query", "query_s", "place", "place_s", "verdict", "use", "weight")
    return ClosureExplanation(
        closure=line.id,
        **{name: getattr(line, name) for name in shared},
        gates=tuple(lines),
        summary=_summary_of_closure(
            verdict, failed, line.merged, acceptance(vi_map, closures, row, options)
        ),
    )


def explain_pair(
    vi_map: VIMap,
    first: int,
    second: int,
    options: LoopClosureOptions,
    min_anchoring_closures: int,
    progress: Progress = SILENT,
) -> PairExplanation:
    """Return the gates that the closures between two missions (rows) fail.

    If the map has no record of closures between them, they are searched for; the map does not change.

    Args:
        first: Mission row.
        second: Another one.
        min_anchoring_closures: Accepted closures that anchoring needs.

    Raises:
        EstimationError: No descriptors, or too few tracks to learn their projection.
    """
    names = tuple(to_hex(vi_map.missions.id[row])[:8] for row in (first, second))
    recorded, origin = read_record(vi_map).closures, "recorded"
    chosen = _between(vi_map, recorded, first, second)
    if not chosen.any():
        rows = np.array([first, second], dtype=np.int64)
        detection = detect(
            vi_map, options, missions=rows, only_other_missions=True, progress=progress
        )
        vi_map = record_updates.with_closures(vi_map, detection.closures, "")
        recorded, origin = read_record(vi_map).closures, "found by a search that changed nothing"
        chosen = _between(vi_map, recorded, first, second)
        if not chosen.any():
            return _without_candidates((names[0], names[1]), detection.best_votes, options)
    closures = recorded.take(chosen)
    gates = closure_gates(closures, options)
    accepted = int(np.count_nonzero(closures.verdict == VERDICTS.index(Verdict.ACCEPTED)))
    lines = [_pair_gate(gate) for gate in gates if gate.failed.any()]
    known = vi_map.baseframes.is_known[vi_map.missions.baseframe[[first, second]]]
    if not known.all() and accepted < min_anchoring_closures:
        lines.append(
            PairGate(
                "accepted closures for anchoring",
                1,
                str(accepted),
                f"at least {min_anchoring_closures}",
                "--anchor_transform_min_inlier_count",
            )
        )
    count = counted(len(closures), "closure")
    summary = f"{count} {origin}, {accepted} accepted."
    if lines:
        most = max(lines, key=lambda line: line.failed)
        summary += f" Most fail: {most.gate}" + (f" ({most.flag})." if most.flag else ".")
    passing = len(closures) - accepted - len(_refused_rows(closures, gates))
    if passing:
        summary += f" {counted(passing, 'refused closure')} would pass with these flags."
    return PairExplanation(
        (names[0], names[1]), len(closures), accepted, tuple(lines), _near_misses(closures, gates),
        summary,
    )  # fmt: skip


def explain_mission(vi_map: VIMap, mission: int) -> MissionExplanation:
    """Return the recorded closures between a mission (row) and every other one."""
    names = [to_hex(words)[:8] for words in vi_map.missions.id]
    known = vi_map.baseframes.is_known[vi_map.missions.baseframe]
    record = read_record(vi_map).closures
    lines = []
    for other in range(len(names)):
        if other == mission:
            continue
        closures = record.take(_between(vi_map, record, mission, other))
        refused = closures.verdict[closures.verdict != VERDICTS.index(Verdict.ACCEPTED)]
        most = VERDICTS[np.bincount(refused).argmax()].value if len(refused) else ""
        lines.append(
            PairLine(
                names[other], bool(known[other]), len(closures) - len(refused), len(refused), most
            )
        )
    if len(names) == 1:
        summary = "The map has no other mission."
    elif known[mission]:
        summary = "The base frame is known: other missions are anchored to this one."
    elif not known.any():
        summary = (
            "No mission has a known base frame to anchor to: set_mission_baseframe_to_known "
            "chooses one."
        )
    else:
        summary = (
            "The base frame is not known. Closures with a known mission anchor it: "
            f"`why {names[mission]} <other>` shows the gates of a pair."
        )
    return MissionExplanation(names[mission], bool(known[mission]), tuple(lines), summary)


def _between(vi_map: VIMap, closures: ClosureRecord, first: int, second: int) -> Mask:
    """Return which closures join two missions."""
    mission = vi_map.vertices.mission
    query, place = (
        mission[vi_map.vertex_index.rows(ids)] for ids in (closures.query, closures.place)
    )
    forth, back = (query == first) & (place == second), (query == second) & (place == first)
    return np.asarray(forth | back)


def _without_candidates(
    names: tuple[str, str], best_votes: int, options: LoopClosureOptions
) -> PairExplanation:
    least = options.min_verify_matches_num
    line = PairGate(
        "matches of a query with a place",
        1,
        str(best_votes),
        f"at least {least}",
        "--lc_min_verify_matches_num",
    )
    if best_votes >= least:  # all of them within the missions, not between the two
        line = dataclasses.replace(line, nearest=f"fewer than {least} between the two")
    summary = "No image of one mission resembles a place of the other."
    return PairExplanation(names, 0, 0, (line,), (), summary)


def _summary_of_closure(
    verdict: Verdict, failed: list[Gate], merged: int, acceptance: Acceptance | None
) -> str:
    if verdict is Verdict.ACCEPTED:
        pairs = counted(merged, "pair") if merged else "no pair"
        text = f"Accepted; {pairs} of landmarks merged by it."
        names = ", ".join(gate.name for gate in failed)
        return f"{text} With these flags it would fail: {names}." if failed else text
    if not failed:
        if verdict in OF_CLOUDS:
            return f"Refused: {verdict.value}. The flags are those of register_point_clouds."
        return f"Refused: {verdict.value}. With these flags and poses it would pass."
    text = f"Refused: {verdict.value}."
    if acceptance is None:
        return f"{text} No flag accepts it."
    flags = " ".join(acceptance.flags)
    if acceptance.verdict is Verdict.ACCEPTED:
        others = f" and {counted(acceptance.others, 'other')}" if acceptance.others else ""
        return f"{text} {flags} would accept it{others}."
    return (
        f"{text} {flags} would not suffice: it would then be refused ({acceptance.verdict.value}), "
        "and no flag moves that."
    )


@dataclasses.dataclass(frozen=True)
class Acceptance:
    """Flags that move the gates that a closure fails, and the verdict with them."""

    flags: tuple[str, ...]  # --NAME=VALUE
    verdict: Verdict
    others: int  # refused closures that the flags accept as well


def acceptance(
    vi_map: VIMap, closures: ClosureRecord, row: int, options: LoopClosureOptions
) -> Acceptance | None:
    """Return the flags with which a recorded closure passes its gates; None if a gate has no flag.

    Recorded closures are judged again with these flags, which admit others of them as well. A search
    may estimate other poses.
    """
    query = vi_map.vertex_index.rows(closures.query).astype(np.int64)
    place = vi_map.vertex_index.rows(closures.place).astype(np.int64)
    T_M_I = se3.compose(vi_map.vertices.T_M_I[place], se3.inverse(closures.T_A_B))
    by_clouds = np.isin(closures.verdict, [VERDICTS.index(verdict) for verdict in OF_CLOUDS])
    verdict = np.where(by_clouds, closures.verdict, VERDICTS.index(Verdict.ACCEPTED))
    fields = {f.name: getattr(closures, f.name) for f in dataclasses.fields(GateValues)}
    measured = GateValues(**fields | {"verdict": verdict.astype(np.int8)})
    failed = [gate for gate in closure_gates(closures, options) if gate.failed[row]]
    changes: dict[str, Any] = {}
    moved = options
    decided, others = Verdict.ACCEPTED, 0
    before = judge(vi_map, query, place, T_M_I, measured, options)[0].accepted
    while failed:
        values = {gate.flag: gate.passing_value(row) for gate in failed}
        wanted = {name.removeprefix("--lc_"): value for name, value in values.items()}
        if (
            not all(map(math.isfinite, wanted.values()))
            or "" in wanted
            or wanted.items() <= changes.items()
        ):
            break
        changes |= wanted
        kinds = {name: type(getattr(options, name)) for name in changes}
        moved = dataclasses.replace(options, **{n: kinds[n](v) for n, v in changes.items()})
        judged, _ = judge(vi_map, query, place, T_M_I, measured, moved)
        decided = VERDICTS[judged.verdict[row]]
        others = int(np.count_nonzero(np.delete(judged.accepted & ~before, row)))
        failed = [gate for gate in closure_gates(judged, moved) if gate.failed[row]]
    flags = tuple(f"--lc_{name}={getattr(moved, name):g}" for name in changes)
    return Acceptance(flags, decided, others) if flags else None


def _near_misses(closures: ClosureRecord, gates: list[Gate]) -> tuple[NearMiss, ...]:
    failed, total = failures(gates)
    refused = _refused_rows(closures, gates)
    order: I64 = refused[np.lexsort((total[refused], failed[refused]))][:_NEAREST]
    ids = to_hex_list(closures.id)
    return tuple(
        NearMiss(
            ids[row][:8],
            VERDICTS[closures.verdict[row]].value,
            int(failed[row]),
            round(float(total[row]), 3),
        )
        for row in order.tolist()
    )


def _refused_rows(closures: ClosureRecord, gates: list[Gate]) -> I64:
    """Return the refused closures that also fail a gate with the present flags."""
    refused = closures.verdict != VERDICTS.index(Verdict.ACCEPTED)
    return np.asarray(np.flatnonzero(refused & any_failed(gates)), dtype=np.int64)


def _pair_gate(gate: Gate) -> PairGate:
    failing = np.flatnonzero(gate.failed)
    nearest = int(failing[np.argmin(gate.shortfall[failing])])
    value, wanted, _ = gate.describe(nearest)
    return PairGate(gate.name, len(failing), value, wanted, gate.flag)
