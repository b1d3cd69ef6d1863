"""List the recorded closures as a table, JSON or CSV."""

import csv
import dataclasses
import io
import json
from pathlib import Path

import numpy as np

from maplab_py.algorithms.gate import failures
from maplab_py.algorithms.loop_closure import closure_record, gates, options
from maplab_py.algorithms.loop_closure.closure_table import VERDICTS
from maplab_py.algorithms.loop_closure.reports import ClosureLine, ClosureReport, Verdict
from maplab_py.array_types import F64, I64, NDArray
from maplab_py.errors import UserError
from maplab_py.geometry import se3, so3
from maplab_py.output_files import write_text
from maplab_py.report import to_json
from maplab_py.vimap import IdArray, IdIndex, VIMap, to_hex, to_hex_list


def list_closures(
    vi_map: VIMap,
    *,
    which: str = "accepted",
    missions: I64 | None = None,
    sort_by: str = "time",
    reason: str = "",
    descending: bool = False,
) -> ClosureReport:
    """Return the recorded closures.

    Args:
        which: "accepted", "refused" or "all" closures.
        missions: Only closures with an end in these missions (rows); None = all.
        sort_by: "time" of the query, or "gap", "correction" (largest first), "inliers" (fewest
            first), or "near_miss" (fewest failed gates and nearest to the default thresholds first).
        reason: Only closures whose verdict contains this text.
        descending: Reverse the order.

    Raises:
        UserError: No verdict contains the reason.
    """
    record = closure_record.read_record(vi_map)
    c = record.closures
    lines = _lines(vi_map, record)
    is_accepted = c.verdict == VERDICTS.index(Verdict.ACCEPTED)
    gap = np.array([line.gap_m for line in lines])
    chosen = {"all": np.ones(len(c), bool), "accepted": is_accepted, "refused": ~is_accepted}[which]
    query, place = (vi_map.vertex_index.rows(ids) for ids in (c.query, c.place))
    mission = vi_map.vertices.mission
    if missions is not None:
        chosen = chosen & (np.isin(mission[query], missions) | np.isin(mission[place], missions))
    if reason:
        chosen = chosen & np.isin(c.verdict, _verdicts_with(reason))
    key = {
        "near_miss": near_miss_order(c),
        "time": np.zeros(len(c)),
        "gap": -gap,
        "correction": -c.correction_m,
        "inliers": c.inliers,
    }[sort_by]
    order = np.lexsort((place, query, key))
    order = order[chosen[order]][:: -1 if descending else 1]
    codes, counts = np.unique(c.verdict[~is_accepted], return_counts=True)
    return ClosureReport(
        recorded=len(c),
        accepted=int(np.count_nonzero(is_accepted)),
        refused={VERDICTS[v].value: int(n) for v, n in zip(codes, counts, strict=True)},
        largest_gap_m=float(gap[is_accepted].max(initial=0.0)),
        shown=len(order),
        file="",
        closures=tuple(lines[row] for row in order),
        notes=() if len(c) else ("no closures are recorded: lc, relax and aam record them",),
    )


def accepted_by_mission(vi_map: VIMap) -> I64:
    """Return the number (M,) of accepted recorded closures with an end in each mission."""
    closures = closure_record.read_record(vi_map).closures
    accepted = closures.take(closures.verdict == VERDICTS.index(Verdict.ACCEPTED))
    mission = vi_map.vertices.mission.astype(np.int64)
    query, place = (
        mission[vi_map.vertex_index.rows(ids)] for ids in (accepted.query, accepted.place)
    )
    ends = np.concatenate([query, place[place != query]])
    return np.bincount(ends, minlength=len(vi_map.missions))


def _verdicts_with(reason: str) -> list[int]:
    codes = [code for code, verdict in enumerate(VERDICTS) if reason.lower() in verdict.value]
    if not codes:
        known = ", ".join(verdict.value for verdict in VERDICTS)
        raise UserError(f"--reason={reason}: no verdict contains this text (there are: {known})")
    return codes


def near_miss_order(closures: closure_record.ClosureRecord) -> F64:
    """Return failed gates (N,) plus the shortfall, which is below 1, as the order of near misses."""
    failed, total = failures(gates.closure_gates(closures, options.LoopClosureOptions()))
    return np.asarray(failed + total / (1.0 + total), dtype=np.float64)


def describe_closure(vi_map: VIMap, row: int) -> ClosureLine:
    """Return a recorded closure (a row of the closures of `read_record`)."""
    record = closure_record.read_record(vi_map)
    chosen = record.closures.take(np.array([row]))
    return _lines(vi_map, dataclasses.replace(record, closures=chosen))[0]


def find_closures(vi_map: VIMap, prefixes: list[str], *, neighbours_s: float = 0.0) -> IdArray:
    """Return the ids (N, 2) of recorded closures from prefixes of their ids.

    Args:
        prefixes: Prefixes of ids, each of a single closure.
        neighbours_s: Also select accepted closures with both ends within this time.

    Raises:
        UserError: A prefix matches no closure or several.
    """
    c = closure_record.read_record(vi_map).closures
    names = to_hex_list(c.id)
    rows = []
    for prefix in prefixes:
        matching = [
            row for row, name in enumerate(names) if name.startswith(prefix.strip().lower())
        ]
        if not prefix.strip() or len(matching) != 1:
            many = f"{len(matching)} closures begin" if matching else "no closure begins"
            raise UserError(f"{many} with '{prefix}': lc_report lists them")
        rows.append(matching[0])
    chosen = np.array(rows, dtype=np.int64)
    if neighbours_s > 0.0:
        chosen = _with_neighbours(vi_map, chosen, neighbours_s)
    return np.asarray(c.id[chosen])


def _with_neighbours(vi_map: VIMap, chosen: I64, reach_s: float) -> I64:
    c = closure_record.read_record(vi_map).closures
    a, b = (vi_map.vertex_index.rows(ids) for ids in (c.query, c.place))
    time_ns, mission = vi_map.vertices.timestamp_ns, vi_map.vertices.mission

    def near(first: I64, second: I64) -> NDArray[np.bool_]:
        apart = np.abs(time_ns[first][:, None] - time_ns[second]) * 1e-9
        return np.asarray((apart <= reach_s) & (mission[first][:, None] == mission[second]))

    same = near(a, a[chosen]) & near(b, b[chosen])
    swapped = near(a, b[chosen]) & near(b, a[chosen])
    accepted = c.verdict == VERDICTS.index(Verdict.ACCEPTED)
    return np.union1d(chosen, np.flatnonzero((same | swapped).any(axis=1) & accepted))


def _lines(vi_map: VIMap, record: closure_record.LoopRecord) -> list[ClosureLine]:
    c = record.closures
    a, b = (vi_map.vertex_index.rows(ids) for ids in (c.query, c.place))
    now = se3.relative(vi_map.T_G_I[a], vi_map.T_G_I[b])
    gap = np.linalg.norm(now[:, 4:] - c.T_A_B[:, 4:], axis=1)
    turn = so3.log(so3.multiply(so3.inverse(c.T_A_B[:, :4]), now[:, :4]))
    gap_deg = np.degrees(np.linalg.norm(turn, axis=1))
    mission = vi_map.vertices.mission
    name = [to_hex(words)[:8] for words in vi_map.missions.id]
    first_ns = vi_map.vertices.timestamp_ns[np.minimum(vi_map.vertex_start[:-1], len(mission) - 1)]
    seconds = (vi_map.vertices.timestamp_ns - first_ns[mission]) * 1e-9
    of_pair = IdIndex(c.id).rows(record.pairs.closure)
    merged = np.bincount(of_pair[of_pair >= 0], minlength=len(c))
    return [
        ClosureLine(
            id=id_[:8],
            query=name[mission[a[i]]],
            query_s=round(float(seconds[a[i]]), 2),
            place=name[mission[b[i]]],
            place_s=round(float(seconds[b[i]]), 2),
            matches=int(c.matches[i]),
            inliers=int(c.inliers[i]),
            ratio=round(float(c.inliers[i] / max(c.matches[i], 1)), 3),
            correction_m=round(float(c.correction_m[i]), 4),
            correction_deg=round(float(c.correction_deg[i]), 3),
            gap_m=round(float(gap[i]), 4),
            gap_deg=round(float(gap_deg[i]), 3),
            tilt_deg=round(float(c.tilt_deg[i]), 3),
            support=int(c.support[i]),
            merged=int(merged[i]),
            verdict=VERDICTS[c.verdict[i]].value,
            use=closure_record.USES[c.use[i]],
            weight=round(float(c.weight[i]), 3),
        )
        for i, id_ in enumerate(to_hex_list(c.id))
    ]


def write_closures(report: ClosureReport, path: Path, *, overwrite: bool) -> None:
    """Write the lines as JSON or, for a name that ends in .csv, as CSV.

    Raises:
        UserError: The name ends in neither, or the file exists and may not be replaced.
    """
    if path.suffix not in (".json", ".csv"):
        raise UserError(f"--file={path}: the name has to end in .json or .csv")
    if path.suffix == ".json":
        text = json.dumps(to_json(report), indent=1) + "\n"
    else:
        stream = io.StringIO(newline="")
        names = [field.name for field in dataclasses.fields(ClosureLine)]
        writer = csv.DictWriter(stream, names, lineterminator="\n")
        writer.writeheader()
        writer.writerows(dataclasses.asdict(line) for line in report.closures)
        text = stream.getvalue()
    write_text(path, [text], overwrite=overwrite)
