"""Measure the self-calibration on simulated sessions of one device (scenario ar_room or navigation).

python docs/scripts/evaluate_self_calibration.py measure --scenario=ar_room --sets=15 --out=ar_room.jsonl
python docs/scripts/evaluate_self_calibration.py consistency --seeds=50 --out=clean.jsonl
python docs/scripts/evaluate_self_calibration.py consistency --seeds=50 --swaps=0.03 --out=swaps.jsonl
python docs/scripts/self_calibration_page.py --results=ar_room.jsonl --consistency=clean.jsonl,swaps.jsonl

Each appends one line per data set and method and goes on where it stopped. All data sets are
recorded with the same device in the same room; motion, noise and appearance differ. The last one
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
from maplab_py.algorithms.self_calibration.collection import (
    Evaluation,
    collect,
    evaluate,
    records_of,
)
from maplab_py.algorithms.self_calibration.information_gain import select_by_gain
from maplab_py.algorithms.self_calibration.options import SelfCalibrationOptions
from maplab_py.algorithms.self_calibration.problem import pose
from maplab_py.algorithms.self_calibration.segments import restricted
from maplab_py.algorithms.self_calibration.workflow import applied
from maplab_py.algorithms.vi_optimization.optimization import optimize
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.errors import EstimationError
from maplab_py.sensors import SensorSet
from maplab_py.simulation.evaluation import evaluate_map
from maplab_py.simulation.scenario import MotionOptions, Scenario, SessionOptions
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.simulation.simulate import SimulatedData, simulate
from maplab_py.simulation.true_map import true_map
from maplab_py.vimap import VIMap

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

OPTIONS = SelfCalibrationOptions(keep_unobservable_at_prior=True)
WHOLE = "imu+camera+extrinsics"
FEW = 8
"""Segments of the comparisons at equal numbers, as in the thesis."""
METHODS = (
    "informative",
    "batch",
    "two sessions",
    "8: A-optimality",
    "8: D-optimality",
    "8: E-optimality",
    "8: A-optimality by groups",
    "8: entropy by groups",
    "8: random",
    "8: least informative",
    "4: entropy",
    "4 each: entropy by groups",
    "8 each: entropy by groups",
)
JUDGED = ("informative", "batch", "8: A-optimality", "8: random", "8: least informative")
"""Their calibrations are also tried on another session."""


def data_set(scenario: Scenario, number: int) -> SimulatedData:
    """Record one of the scenario's sessions again: other motion, noise and looks, same device."""
    session = scenario.sessions[number % len(scenario.sessions)]
    seeds = dataclasses.replace(
        scenario.seeds, motion=100 + number, measurement=200 + number, appearance=300 + number
    )
    return simulate(dataclasses.replace(scenario, seeds=seeds, sessions=(session,)))


def with_noise(
    scenario: Scenario, swaps: float | None, keypoint_sigma_px: float | None, imu_noise: float
) -> Scenario:
    """Return the scenario with other noise; None = as it says, IMU noise as a multiple."""
    changes = {"identity_swap_share": swaps, "keypoint_sigma_px": keypoint_sigma_px}
    given = {name: value for name, value in changes.items() if value is not None}
    names = ("gyro_noise_density", "accel_noise_density", "gyro_bias_walk", "accel_bias_walk")
    scaled = {name: imu_noise * getattr(scenario.imu, name) for name in names}
    return dataclasses.replace(
        scenario,
        measurement=dataclasses.replace(scenario.measurement, **given),
        imu=dataclasses.replace(scenario.imu, **scaled),
    )


def evaluation_session(scenario: Scenario) -> SimulatedData:
    """Record the session on which calibrations are judged: 0.5 m/s and 40 deg/s, as the thesis'."""
    lively = {"wall_distance_m": 2.2, "shake_m": 0.05, "shake_rad": 0.15, "shake_hz": 0.7}
    session = SessionOptions(
        phases=(
            MotionOptions(kind="room_scan", duration_s=15.0, turns=0.6, **lively),
            MotionOptions(kind="figure_8", duration_s=15.0, turns=0.6, **lively),
        )
    )
    seeds = dataclasses.replace(scenario.seeds, motion=9, measurement=9, appearance=9)
    return simulate(dataclasses.replace(scenario, seeds=seeds, sessions=(session,)))


def map_error_m(data: SimulatedData, sensors: SensorSet) -> float:
    """Return the position error [m] of the evaluation session, optimised with a calibration."""
    options = VIOptimizationOptions(num_iterations=15, hide_iterations_console_output=True)
    result, _ = optimize(applied(data.maps[0], sensors), options)
    return float(evaluate_map(result, data.truth).ate_each_m)


def scores_of(evaluation: Evaluation, metric: str, groups: str) -> dict[str, F64]:
    """Return the scores (S,) of all segments by table."""
    own = dataclasses.replace(OPTIONS, metric=metric, groups=groups)
    scores = [one.scores for one in records_of(evaluation, own, evaluation.sigma_ref())]
    return {name: np.array([one[name] for one in scores]) for name in scores[0]}


def in_turn(tables: dict[str, F64], count: int) -> list[int]:
    """Return so many segments: the best of each table, the second best, and so on."""
    orders = [np.argsort(values, kind="stable") for values in tables.values()]
    chosen = dict.fromkeys(int(k) for rank in zip(*orders, strict=True) for k in rank)
    return list(chosen)[:count]


def best_of_each(tables: dict[str, F64], count: int) -> set[int]:
    """Return what tables of so many segments hold together, as the database does."""
    orders = [np.argsort(values, kind="stable") for values in tables.values()]
    return {int(k) for order in orders for k in order[:count]}


def chosen(evaluation: Evaluation, method: str, number: int, per_group: int) -> list[I64]:
    """Return the segments (vertex rows) that a method takes."""
    capacity, _, what = method.rpartition(": ")
    count = min(int(capacity.split()[0]) if capacity else FEW, len(evaluation.segments))
    if what == "informative":
        tables = scores_of(evaluation, "a_optimality", OPTIONS.groups)
        best = best_of_each(tables, per_group)
    elif what == "random":
        rng = np.random.default_rng(number)
        best = set(rng.choice(len(evaluation.segments), size=count, replace=False).tolist())
    elif what == "least informative":
        total = scores_of(evaluation, "a_optimality", WHOLE)[WHOLE]
        best = set(np.argsort(-total, kind="stable")[:count].tolist())
    else:
        metric = what.split(" by ")[0].replace("-", "_").lower()
        groups = OPTIONS.groups if what.endswith("by groups") else WHOLE
        tables = scores_of(evaluation, metric, groups)
        best = set(in_turn(tables, count))
        if capacity.endswith("each"):
            best = best_of_each(tables, count)
    return [evaluation.segments[k].rows for k in sorted(best)]


@dataclasses.dataclass(frozen=True, eq=False)
class DataSet:
    """A session with its truth and the information of its segments."""

    number: int
    vi_map: VIMap
    names: tuple[str, ...]
    units: tuple[str, ...]
    off: F64  # (k,) of the nominal calibration from the truth
    truth: Any
    true_sensors: SensorSet
    evaluation: Evaluation
    selection_s: float  # CPU time per segment

    @classmethod
    def of(cls, scenario: Scenario, number: int) -> DataSet:
        """Record and evaluate."""
        data = data_set(scenario, number)
        vi_map = data.maps[0]
        true = true_map(vi_map, data.truth)
        truth = pose(true, OPTIONS, robust=False).posed.states.blocks
        nominal = pose(vi_map, OPTIONS, robust=False)
        began = time.process_time()
        evaluation = evaluate(vi_map, OPTIONS)
        return cls(
            number,
            vi_map,
            nominal.parameters.names,
            tuple(one.unit for one in nominal.parameters.each),
            nominal.parameters.difference(nominal.posed.states.blocks, truth),
            truth,
            true.sensors,
            evaluation,
            (time.process_time() - began) / len(evaluation.segments),
        )


def measure(
    scenario: Scenario,
    sets: range,
    per_group: int,
    methods: list[str],
    judged: list[str],
    out: Path,
) -> None:
    """Calibrate every data set with every method; append a line each."""
    done = {(row["set"], row["method"]) for row in lines_of(out)}
    judge = evaluation_session(scenario)
    first = DataSet.of(scenario, sets[0]) if (-1, "truth") not in done else None
    if first is not None:
        for method, sensors in (("nominal", first.vi_map.sensors), ("truth", first.true_sensors)):
            row = {"set": -1, "method": method, "map_m": map_error_m(judge, sensors)}
            append_line(out, row)
    for number in sets:
        missing = [method for method in methods if (number, method) not in done]
        if not missing:
            continue
        data = DataSet.of(scenario, number)
        for method in missing:
            row = _measured(scenario, data, method, per_group, judge if method in judged else None)
            row["selection_s_per_segment"] = data.selection_s
            append_line(out, row)
            map_m = row["map_m"] or float("nan")
            sys.stdout.write(
                f"{number:3d} {method:26s} NEES {row['nees']:8.1f}  map error {map_m:.4f} m\n"
            )
            sys.stdout.flush()


def _segments(scenario: Scenario, data: DataSet, method: str, per_group: int) -> tuple[VIMap, int]:
    """Return what a method calibrates on, and the number of its segments."""
    if method == "batch":
        return data.vi_map, len(data.evaluation.segments)
    if method == "two sessions":
        options = dataclasses.replace(OPTIONS, segments_per_group=per_group)
        database, _ = collect(data_set(scenario, data.number + 1).maps[0], options)
        database, _ = collect(data.vi_map, options, database)
        return database.vi_map, len(database)
    if method == "information gain":
        rows = list(select_by_gain(data.vi_map, OPTIONS, max_segments=FEW).kept)
    else:
        rows = chosen(data.evaluation, method, data.number, per_group)
    return restricted(data.vi_map, np.unique(np.concatenate(rows))), len(rows)


def _measured(
    scenario: Scenario, data: DataSet, method: str, per_group: int, judge: SimulatedData | None
) -> dict[str, Any]:
    small, count = _segments(scenario, data, method, per_group)
    began = time.process_time()
    error, sigma, nees = data.off.copy(), np.full(len(data.off), np.nan), float("nan")
    facts: dict[str, Any] = {}
    sensors = data.vi_map.sensors
    try:
        result, report = calibrate(small, OPTIONS)
    except EstimationError as refusal:
        facts = {"refused": str(refusal)}
    else:
        # what a selection says nothing about stays as it was
        rows = [data.names.index(name) for name in result.parameters.names]
        found = result.parameters.difference(result.states.blocks, data.truth)
        error[rows], sigma[rows] = found, np.sqrt(np.diag(result.covariance))
        nees = float(found @ np.linalg.solve(result.covariance, found))
        sensors = result.sensors
        facts = {
            "iterations": report.iterations,
            "chi_square": report.chi_square_per_freedom,
            "noise_factor": report.keypoint_noise_factor,
            "inconsistent": report.inconsistent_landmarks,
            "unobservable": list(report.unobservable),
            "without_scale": list(report.without_scale),
            "partitions": report.partitions,
        }
    seconds = time.process_time() - began
    return {
        "set": data.number,
        "method": method,
        "names": list(data.names),
        "units": list(data.units),
        "error": error.tolist(),
        "sigma": sigma.tolist(),
        "nees": nees,
        "segments": count,
        "of_segments": len(data.evaluation.segments),
        "cpu_s": seconds,
        "map_m": None if judge is None else map_error_m(judge, sensors),
        **facts,
    }


SHORT = (
    MotionOptions(kind="room_scan", duration_s=10.0, turns=0.2, wall_distance_m=2.6, height_m=1.4),
    MotionOptions(
        kind="figure_8",
        duration_s=10.0,
        turns=0.25,
        wall_distance_m=2.6,
        shake_m=0.06,
        shake_rad=0.15,
    ),
    MotionOptions(kind="hover", duration_s=6.0, shake_m=0.08, shake_rad=0.3),
)
"""A motion that excites everything, short enough for 50 seeds."""


def consistency(scenario: Scenario, seeds: range, out: Path) -> None:
    """Compare errors with announced deviations over many short batches; append a line each."""
    scenario = dataclasses.replace(scenario, sessions=(SessionOptions(phases=SHORT),))
    done = {row["set"] for row in lines_of(out)}
    for seed in seeds:
        if seed in done:
            continue
        data = data_set(scenario, seed)
        truth = pose(true_map(data.maps[0], data.truth), OPTIONS, robust=False).posed.states.blocks
        result, report = calibrate(data.maps[0], OPTIONS)
        error = result.parameters.difference(result.states.blocks, truth)
        row = {
            "set": seed,
            "swaps": scenario.measurement.identity_swap_share,
            "names": list(result.parameters.names),
            "error": error.tolist(),
            "sigma": np.sqrt(np.diag(result.covariance)).tolist(),
            "nees": float(error @ np.linalg.solve(result.covariance, error)),
            "noise_factor": report.keypoint_noise_factor,
            "inconsistent": report.inconsistent_landmarks,
        }
        append_line(out, row)


def append_line(path: Path, row: dict[str, Any]) -> None:
    """Append a result to a file."""
    with path.open("a") as file:
        file.write(json.dumps(row) + "\n")


def lines_of(path: Path) -> list[dict[str, Any]]:
    """Return the results in a file; none where there is no file."""
    if not path.exists():
        return []
    return [json.loads(line) for line in path.read_text().splitlines()]


def main() -> int:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("measure", "consistency"))
    parser.add_argument("--scenario", default="ar_room")
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--sets", type=int, default=15)
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--swaps", type=float, help="share; 0 for consistency, else the scenario's")
    parser.add_argument("--keypoint_sigma_px", type=float)
    parser.add_argument("--imu_noise", type=float, default=1.0, help="times the scenario's")
    parser.add_argument("--segments_per_group", type=int, default=OPTIONS.segments_per_group)
    parser.add_argument("--methods", default=",".join(METHODS))
    parser.add_argument(
        "--judged", default=",".join(JUDGED), help="methods tried on another session"
    )
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    is_consistency = arguments.what == "consistency"
    swaps = 0.0 if is_consistency and arguments.swaps is None else arguments.swaps
    scenario = with_noise(
        load_scenario(arguments.scenario), swaps, arguments.keypoint_sigma_px, arguments.imu_noise
    )
    if is_consistency:
        seeds = range(arguments.first, arguments.first + arguments.seeds)
        consistency(scenario, seeds, arguments.out)
    else:
        sets = range(arguments.first, arguments.first + arguments.sets)
        methods = arguments.methods.split(",")
        judged = arguments.judged.split(",")
        per_group = arguments.segments_per_group
        measure(scenario, sets, per_group, methods, judged, arguments.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
