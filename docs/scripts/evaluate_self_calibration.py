"""Measure the self-calibration on simulated sessions of one device (scenario ar_room or navigation).

python docs/scripts/evaluate_self_calibration.py measure --scenario=ar_room --sets=15 --out=ar_room.jsonl
python docs/scripts/evaluate_self_calibration.py report --results ar_room.jsonl

`measure` appends one line per data set and method and goes on where it stopped. All data sets are
recorded with the same device in the same room; motion, noise and appearance differ. `report`
writes docs/self_calibration_results.md.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.self_calibration.calibration import calibrate
from maplab_py.algorithms.self_calibration.collection import Evaluation, evaluate, records_of
from maplab_py.algorithms.self_calibration.information_gain import select_by_gain
from maplab_py.algorithms.self_calibration.options import SelfCalibrationOptions
from maplab_py.algorithms.self_calibration.problem import pose
from maplab_py.algorithms.self_calibration.segments import restricted
from maplab_py.algorithms.vi_optimization.optimization import optimize
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.sensors import SensorSet
from maplab_py.simulation.evaluation import evaluate_map
from maplab_py.simulation.scenario import MotionOptions, Scenario, SessionOptions
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.simulation.simulate import SimulatedData, simulate
from maplab_py.simulation.true_map import true_map
from maplab_py.vimap import VIMap

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

DOCS = Path(__file__).resolve().parents[1]
OPTIONS = SelfCalibrationOptions(keep_unobservable_at_prior=True)
METHODS = ("informative", "batch", "random", "least informative", "single group")


def data_set(scenario: Scenario, number: int) -> SimulatedData:
    """Record one of the scenario's sessions again: other motion, noise and looks, same device."""
    session = scenario.sessions[number % len(scenario.sessions)]
    seeds = dataclasses.replace(
        scenario.seeds, motion=100 + number, measurement=200 + number, appearance=300 + number
    )
    return simulate(dataclasses.replace(scenario, seeds=seeds, sessions=(session,)))


def evaluation_session(scenario: Scenario) -> SimulatedData:
    """Record the session on which calibrations are judged."""
    session = SessionOptions(
        phases=(
            MotionOptions(kind="room_scan", duration_s=18.0, turns=0.35, wall_distance_m=2.6),
            MotionOptions(kind="figure_8", duration_s=14.0, turns=0.3, wall_distance_m=2.6),
        )
    )
    seeds = dataclasses.replace(scenario.seeds, motion=9, measurement=9, appearance=9)
    return simulate(dataclasses.replace(scenario, seeds=seeds, sessions=(session,)))


def map_error_m(data: SimulatedData, sensors: SensorSet) -> float:
    """Return the position error [m] of the evaluation session, optimised with a calibration."""
    options = VIOptimizationOptions(num_iterations=15, hide_iterations_console_output=True)
    result, _ = optimize(data.maps[0].replace(sensors=sensors), options)
    return float(evaluate_map(result, data.truth).ate_each_m)


def chosen(evaluation: Evaluation, method: str, number: int, per_group: int) -> list[I64]:
    """Return the segments (vertex rows) that a method takes; all take as many as `informative`."""
    own = dataclasses.replace(OPTIONS, segments_per_group=per_group)
    scores = [one.scores for one in records_of(evaluation, own, evaluation.sigma_ref())]
    table = {name: np.array([one[name] for one in scores]) for name in scores[0]}
    best = set[int]()
    for values in table.values():
        best |= set(np.argsort(values, kind="stable")[:per_group].tolist())
    count = len(best)
    if method == "random":
        rng = np.random.default_rng(number)
        best = set(rng.choice(len(scores), size=count, replace=False).tolist())
    elif method in ("single group", "least informative"):
        single = dataclasses.replace(own, groups="imu+camera+extrinsics")
        records = records_of(evaluation, single, evaluation.sigma_ref())
        total = np.array([one.scores["imu+camera+extrinsics"] for one in records])
        order = np.argsort(total if method == "single group" else -total, kind="stable")
        best = set(order[:count].tolist())
    return [evaluation.segments[k].rows for k in sorted(best)]


def measure(scenario_name: str, sets: int, per_group: int, methods: list[str], out: Path) -> None:
    """Calibrate every data set with every method; append a line each."""
    scenario = load_scenario(scenario_name)
    done = {(row["set"], row["method"]) for row in _lines(out)}
    judge = evaluation_session(scenario)
    for number in range(sets):
        missing = [method for method in methods if (number, method) not in done]
        if not missing:
            continue
        data = data_set(scenario, number)
        vi_map = data.maps[0]
        truth = pose(true_map(vi_map, data.truth), OPTIONS, robust=False).posed.states.blocks
        began = time.process_time()
        evaluation = evaluate(vi_map, OPTIONS)
        selection_s = (time.process_time() - began) / len(evaluation.segments)
        for method in missing:
            row = _measured(vi_map, evaluation, method, number, per_group, truth, judge)
            row["selection_s_per_segment"] = selection_s
            with out.open("a") as file:
                file.write(json.dumps(row) + "\n")
            sys.stdout.write(
                f"{number:3d} {method:18s} NEES {row['nees']:8.1f}  map error {row['map_m']:.4f} m\n"
            )


def _measured(
    vi_map: VIMap,
    evaluation: Evaluation,
    method: str,
    number: int,
    per_group: int,
    truth: Any,
    judge: SimulatedData,
) -> dict[str, Any]:
    began = time.process_time()
    if method == "batch":
        small, count = vi_map, len(evaluation.segments)
    elif method == "information gain":
        most = len(chosen(evaluation, "informative", number, per_group))
        rows = list(select_by_gain(vi_map, OPTIONS, max_segments=most).kept)
        small, count = restricted(vi_map, np.unique(np.concatenate(rows))), len(rows)
    else:
        rows = chosen(evaluation, method, number, per_group)
        small, count = restricted(vi_map, np.unique(np.concatenate(rows))), len(rows)
    if method != "information gain":
        began = time.process_time()
    result, report = calibrate(small, OPTIONS)
    seconds = time.process_time() - began
    error = result.parameters.difference(result.states.blocks, truth)
    return {
        "set": number,
        "method": method,
        "names": list(result.parameters.names),
        "units": [one.unit for one in result.parameters.each],
        "error": error.tolist(),
        "sigma": np.sqrt(np.diag(result.covariance)).tolist(),
        "nees": float(error @ np.linalg.solve(result.covariance, error)),
        "segments": count,
        "of_segments": len(evaluation.segments),
        "cpu_s": seconds,
        "iterations": report.iterations,
        "chi_square": report.chi_square_per_freedom,
        "unobservable": len(report.unobservable),
        "map_m": map_error_m(judge, result.sensors),
    }


def _lines(path: Path) -> list[dict[str, Any]]:
    if not path.exists():
        return []
    return [json.loads(line) for line in path.read_text().splitlines()]


THESIS_SIGMA = {
    "focal length": (0.35, 1.0, "px"),
    "centre": (0.7, 1.0, "px"),
    "distortion": (5e-4, 1.0, ""),
    "gyroscope scale": (1e-3, 1.0, ""),
    "accelerometer scale": (2.5e-3, 1.0, ""),
    "gyroscope misalignment": (1e-3, 1.0, ""),
    "accelerometer misalignment": (5e-3, 1.0, ""),
    "accelerometer rotation": (0.15, float(np.rad2deg(1.0)), "deg"),
    "camera position": (3.0, 1e3, "mm"),
    "camera rotation": (0.07, float(np.rad2deg(1.0)), "deg"),
}
"""Level of the thesis' table 6.1, factor to its unit, unit."""


def kind_of(name: str) -> str:
    """Return the row of the table that a parameter belongs to."""
    words = name.split()
    if words[0] == "camera" and words[1] in ("position", "rotation"):
        return " ".join(words[:2])
    if words[0] == "camera":
        return "focal length" if words[1] == "focal" else words[1]
    return f"{words[0]} {words[1] if words[1] == 'rotation' else words[2]}"


def report(results: list[Path]) -> str:
    """Return the page of results."""
    lines = [
        "# Self-calibration: results",
        "",
        "Made by `docs/scripts/evaluate_self_calibration.py`; simulated sessions of one device with an",
        "unknown calibration, beginning at the nominal one (sensors and motion as in the thesis).",
        "Numbers of the thesis are from its table 6.1: recordings of a real tablet, no truth.",
        "",
    ]
    for path in results:
        lines += _of_scenario(path.stem, _lines(path))
    return "\n".join(lines).rstrip() + "\n"


def _of_scenario(name: str, rows: list[dict[str, Any]]) -> list[str]:
    methods = [m for m in (*METHODS, "information gain") if any(r["method"] == m for r in rows)]
    by_method = {m: [r for r in rows if r["method"] == m] for m in methods}
    lines = [f"## Scenario {name}", "", "### Cost and quality", ""]
    lines += [
        "| selection | data sets | segments | of | CPU time [s] | NEES (of 26) | map error [mm] |",
        "|---|---|---|---|---|---|---|",
    ]
    for method, own in by_method.items():
        column = {
            key: np.median([row[key] for row in own])
            for key in ("segments", "of_segments", "cpu_s", "nees", "map_m")
        }
        lines.append(
            f"| {method} | {len(own)} | {column['segments']:.0f} | {column['of_segments']:.0f} | "
            f"{column['cpu_s']:.1f} | {column['nees']:.0f} | {1e3 * column['map_m']:.1f} |"
        )
    each = np.median([row["selection_s_per_segment"] for row in rows])
    lines += [
        "",
        f"Medians. Evaluating a segment takes {each:.2f} s of CPU time. The map error is that of",
        "another session of 32 s, optimised with the calibration held.",
        "",
        "### Error of the parameters (RMS over the data sets, against truth)",
        "",
        "| parameter | unit | thesis (std) | " + " | ".join(methods) + " |",
        "|---|---|---|" + "---|" * len(methods),
    ]
    names = rows[0]["names"]
    for kind, (level, factor, unit) in THESIS_SIGMA.items():
        own = [k for k, one in enumerate(names) if kind_of(one) == kind]
        cells = []
        for method in methods:
            error = np.array([row["error"] for row in by_method[method]])[:, own] * factor
            cells.append(f"{np.sqrt(np.mean(error**2)):.2g}")
        lines.append(f"| {kind} | {unit} | {level:.2g} | " + " | ".join(cells) + " |")
    return [*lines, ""]


def main() -> int:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("measure", "report"))
    parser.add_argument("--scenario", default="ar_room")
    parser.add_argument("--sets", type=int, default=15)
    parser.add_argument("--segments_per_group", type=int, default=8)
    parser.add_argument("--methods", default=",".join(METHODS))
    parser.add_argument("--out", type=Path, default=Path("self_calibration.jsonl"))
    parser.add_argument("--results", type=Path, nargs="*", default=[])
    arguments = parser.parse_args()
    if arguments.what == "measure":
        methods = arguments.methods.split(",")
        measure(
            arguments.scenario,
            arguments.sets,
            arguments.segments_per_group,
            methods,
            arguments.out,
        )
    else:
        (DOCS / "self_calibration_results.md").write_text(report(arguments.results))
    return 0


if __name__ == "__main__":
    sys.exit(main())
