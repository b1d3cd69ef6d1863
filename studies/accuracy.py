"""Errors of the calibrations of simulated sessions for several selections of segments."""

import dataclasses
import sys
import time
from pathlib import Path
from typing import Self

import numpy as np

from maplab_py.algorithms.self_calibration.calibration import Calibration, calibrate
from maplab_py.algorithms.self_calibration.device import transfer_calibration
from maplab_py.algorithms.self_calibration.reports import SelfCalibrationReport
from maplab_py.algorithms.self_calibration.segments import selection, splitting
from maplab_py.algorithms.self_calibration.segments.information_gain import select_by_gain
from maplab_py.algorithms.vi_optimization.optimization import optimize
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.array_types import F64
from maplab_py.errors import EstimationError
from maplab_py.estimation.blocks import ParameterBlocks
from maplab_py.sensors import SensorSet
from maplab_py.simulation.evaluation import evaluate_map
from maplab_py.simulation.scenario import Scenario
from maplab_py.simulation.simulate import SimulatedData
from maplab_py.vimap import VIMap
from studies.data_sets import (
    OPTIONS,
    SHORT,
    Row,
    append_line,
    data_set,
    evaluation_session,
    lines_of,
    problem_of,
    true_problem,
)
from studies.published import relative_rms
from studies.selections import FEW, chosen_segments


def map_error_m(data: SimulatedData, sensors: SensorSet) -> float:
    """Return the position error [m] of the evaluation session, optimised with a calibration."""
    options = VIOptimizationOptions(num_iterations=15, hide_iterations_console_output=True)
    result, _ = optimize(transfer_calibration(data.maps[0], sensors), options)
    return float(evaluate_map(result, data.truth).ate_each_m)


@dataclasses.dataclass(frozen=True, eq=False)
class DataSet:
    """A session with its truth and the information of its segments."""

    number: int
    vi_map: VIMap
    names: tuple[str, ...]
    units: tuple[str, ...]
    nominal_error: F64  # (k,) of the nominal calibration
    truth: ParameterBlocks
    true_sensors: SensorSet
    evaluation: selection.Evaluation
    selection_s: float  # processor time per segment

    @classmethod
    def of(cls, scenario: Scenario, number: int) -> Self:
        """Simulate and evaluate."""
        data = data_set(scenario, number)
        vi_map, true, nominal = data.maps[0], true_problem(data), problem_of(data.maps[0])
        truth = true.states.blocks
        began = time.process_time()
        evaluation = selection.evaluate(vi_map, OPTIONS)
        return cls(
            number,
            vi_map,
            nominal.parameters.names,
            tuple(parameter.unit for parameter in nominal.parameters.each),
            nominal.parameters.difference(nominal.states.blocks, truth),
            truth,
            true.vi_map.sensors,
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
    """Calibrate every data set with every method; append one line per result.

    Args:
        scenario: Device and sessions.
        sets: Numbers of the data sets.
        per_group: Number of segments per group for the method "informative".
        methods: Names in `selections.METHODS`, or "information gain".
        judged: Methods whose calibrations are evaluated on another session.
        out: Output file; results that it contains are not measured again.
    """
    done = {(row["set"], row["method"]) for row in lines_of(out)}
    judge = evaluation_session(scenario)
    if (-1, "truth") not in done:
        first = DataSet.of(scenario, sets[0])
        for method, sensors in (("nominal", first.vi_map.sensors), ("truth", first.true_sensors)):
            error_m = map_error_m(judge, sensors)
            append_line(out, {"set": -1, "method": method, "map_m": error_m})
    for number in sets:
        missing = [method for method in methods if (number, method) not in done]
        data = DataSet.of(scenario, number) if missing else None
        for method in missing:
            assert data is not None
            row = calibrate_segments(
                scenario, data, method, per_group, judge if method in judged else None
            )
            append_line(out, row)
            sys.stdout.write(
                f"{number:3d} {method:26s} NEES {row['nees']:8.1f}  "
                f"error {relative_rms(row['error'], row['names']):5.2f} of table 6.1's  "
                f"map error {row['map_m'] or float('nan'):.4f} m\n"
            )
            sys.stdout.flush()


def _segments(scenario: Scenario, data: DataSet, method: str, per_group: int) -> tuple[VIMap, int]:
    """Return the segments that a method calibrates on, and their number."""
    if method == "batch":
        return data.vi_map, len(data.evaluation.segments)
    if method == "two sessions":
        options = dataclasses.replace(OPTIONS, segments_per_group=per_group)
        database, _ = selection.collect(data_set(scenario, data.number + 1).maps[0], options)
        database, _ = selection.collect(data.vi_map, options, database)
        return database.vi_map, len(database)
    if method == "information gain":
        rows = select_by_gain(data.vi_map, OPTIONS, max_segments=FEW)
    else:
        rows = chosen_segments(data.evaluation, method, data.number, per_group)
    return splitting.extract_submap(data.vi_map, np.unique(np.concatenate(rows))), len(rows)


def calibrate_segments(
    scenario: Scenario,
    data: DataSet,
    method: str,
    per_group: int,
    judge: SimulatedData | None = None,
) -> Row:
    """Return the errors of a data set's calibration with a method, as a line of results.

    Args:
        scenario: Where the data set is from.
        data: The session.
        method: As in `measure`.
        per_group: As in `measure`.
        judge: Session that evaluates the calibration.
    """
    began = time.process_time()
    submap, count = _segments(scenario, data, method, per_group)
    choice_s, began = time.process_time() - began, time.process_time()
    # parameters that a selection does not contain stay as they were
    error, sigma = data.nominal_error.copy(), np.full(len(data.names), np.nan)
    sensors, row = data.vi_map.sensors, Row(nees=float("nan"))
    try:
        result, report = calibrate(submap, OPTIONS)
    except EstimationError as refusal:
        row["refused"] = str(refusal)
    else:
        row = _compare(result, report, data.truth)
        rows = [data.names.index(name) for name in row.pop("names")]
        error[rows], sigma[rows] = row.pop("error"), row.pop("sigma")
        sensors = result.sensors
        row["iterations"] = report.iterations
        row["chi_square"] = report.chi_square_per_freedom
        row["unobservable"] = list(report.unobservable)
        row["without_scale"] = list(report.without_scale)
        row["partitions"] = report.partitions
    return {
        "set": data.number,
        "method": method,
        "names": list(data.names),
        "units": list(data.units),
        "error": error.tolist(),
        "sigma": sigma.tolist(),
        "segments": count,
        "of_segments": len(data.evaluation.segments),
        "cpu_s": time.process_time() - began,
        "choice_s": choice_s,
        "map_m": None if judge is None else map_error_m(judge, sensors),
        "selection_s_per_segment": data.selection_s,
        **row,
    }


def _compare(result: Calibration, report: SelfCalibrationReport, truth: ParameterBlocks) -> Row:
    """Return error, formal deviations and NEES of a calibration."""
    error = result.parameters.difference(result.blocks, truth)
    return {
        "names": list(result.parameters.names),
        "error": error.tolist(),
        "sigma": result.uncertainty.formal_sigma.tolist(),
        "nees": float(error @ np.linalg.solve(result.uncertainty.formal, error)),
        "noise_factor": report.keypoint_noise_factor,
        "inconsistent": report.inconsistent_landmarks,
    }


def consistency(scenario: Scenario, seeds: range, out: Path) -> None:
    """Compare errors with reported deviations over many short batches; append one line per batch."""
    scenario = dataclasses.replace(scenario, sessions=(SHORT,))
    done = {row["set"] for row in lines_of(out)}
    for seed in seeds:
        if seed in done:
            continue
        data = data_set(scenario, seed)
        result, report = calibrate(data.maps[0], OPTIONS)
        row = _compare(result, report, true_problem(data).states.blocks)
        swaps = scenario.measurement.identity_swap_share
        append_line(out, {"set": seed, "swaps": swaps, **row})
    rows = lines_of(out)
    mean = np.mean([row["nees"] for row in rows])
    sys.stdout.write(f"NEES {mean:.1f} of {len(rows[0]['error'])}, {len(rows)} seeds\n")
