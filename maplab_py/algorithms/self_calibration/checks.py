"""Calibration with checks that formal deviations cannot replace.

Formal deviations follow from the measurement noise. On recorded maps they are several times
too small for the camera's position, because they do not include model errors (decision 18).
Hence the camera's position is limited, and results on parts of the data are compared.
"""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.self_calibration import reports
from maplab_py.algorithms.self_calibration.calibration import Calibration, calibrate
from maplab_py.algorithms.self_calibration.device import device_of
from maplab_py.algorithms.self_calibration.estimation.problem import SegmentProblem, runs_of
from maplab_py.algorithms.self_calibration.options import SelfCalibrationOptions
from maplab_py.algorithms.self_calibration.segments.database import SegmentDatabase
from maplab_py.algorithms.self_calibration.segments.information_gain import select_by_gain
from maplab_py.algorithms.self_calibration.segments.selection import collect
from maplab_py.algorithms.self_calibration.segments.splitting import extract_submap
from maplab_py.algorithms.self_calibration.uncertainty import Verdict
from maplab_py.errors import UserError
from maplab_py.estimation.terms.cameras import EXTRINSICS
from maplab_py.progress import SILENT, Progress
from maplab_py.sensors import SensorSet
from maplab_py.sensors.calibration_transfer import with_calibration_of, with_sensors_of
from maplab_py.vimap import VIMap

_POSITION = "extrinsics_translation"
_MAX_CHANGE_IN_SIGMAS = 3.0
_MIN_SPAN_S = 30.0
"""Shorter data may share one error of the models: they confirm no larger change by themselves."""


def camera_shift_m(result: Calibration) -> float:
    """Return the largest distance [m] by which a camera moved on the IMU."""
    shift_m: dict[int, list[float]] = {}
    for parameter, change in zip(result.parameters.each, result.change.tolist(), strict=True):
        if parameter.block == EXTRINSICS and parameter.column < 3:
            shift_m.setdefault(parameter.row, []).append(change)
    return max((float(np.linalg.norm(shift)) for shift in shift_m.values()), default=0.0)


def calibrate_with_checks(
    vi_map: VIMap,
    options: SelfCalibrationOptions,
    *,
    max_camera_shift_m: float = 0.0,
    parts: int = 0,
    database: SegmentDatabase | None = None,
    missions: NDArray[np.integer] | None = None,
    batch: bool = False,
    progress: Progress = SILENT,
) -> tuple[SensorSet, SegmentDatabase | None, reports.SelfCalibrationReport]:
    """Calibrate; where a camera moves too far, keep its position and calibrate the rest again.

    Args:
        max_camera_shift_m: How far a camera may move from where it was; 0 = no limit.
        parts: Also calibrate on so many parts of the data, and report deviations that are at least
            the standard error of their mean; 0 = none.
        database: Segments of earlier sessions.
        batch: Use all data instead of segments.

    Raises:
        EstimationError: The data do not determine the calibration.
        UserError: The missions were recorded with different devices.
    """
    if parts == 1 or parts < 0:
        raise UserError("a spread needs two parts of the data at least")
    device, collected = device_of(vi_map, missions), None
    if not batch and options.selection != "information_gain":
        collected, _ = collect(vi_map, options, database, missions=missions, progress=progress)

    def estimate(
        options: SelfCalibrationOptions,
    ) -> tuple[SensorSet, Calibration, reports.SelfCalibrationReport]:
        if batch:
            result, report = calibrate(vi_map, options, missions=missions, progress=progress)
            return result.sensors, result, report
        if collected is not None:
            segments, count = collected.vi_map, len(collected)
        else:
            rows = select_by_gain(vi_map, options, missions, progress)
            segments, count = extract_submap(vi_map, np.unique(np.concatenate(rows))), len(rows)
        result, report = calibrate(segments, options, segments=count, progress=progress)
        source = device_of(segments)
        if device == source:
            return with_sensors_of(vi_map.sensors, result.sensors), result, report
        sensors = with_calibration_of(vi_map.sensors, device, result.sensors, source)
        return sensors, result, report

    sensors, result, report = estimate(options)
    shift_m = camera_shift_m(result)
    rest = sorted(options.estimated() - {_POSITION})
    if not 0.0 < max_camera_shift_m < shift_m or not rest:
        return sensors, collected, _with_spread(report, result, options, parts, progress)
    fewer = dataclasses.replace(options, states=",".join(rest))
    sensors, result, again = estimate(fewer)
    again = _with_spread(again, result, fewer, parts, progress)
    return sensors, collected, _with_kept_positions(again, report, shift_m)


def _with_spread(
    report: reports.SelfCalibrationReport,
    result: Calibration,
    options: SelfCalibrationOptions,
    parts: int,
    progress: Progress,
) -> reports.SelfCalibrationReport:
    """Return the report with deviations that are at least the spread of results on parts.

    The vertices are split into runs of equal length. Each is calibrated alone, from the result. The
    mean of n results has the standard deviation of their spread over sqrt(n).
    """
    if not parts:
        return doubt_large_changes(report, _span_s(result.solution.problem))
    problem = result.solution.problem
    vi_map = problem.vi_map.replace(sensors=result.sensors)
    lenient = dataclasses.replace(options, keep_unobservable_at_prior=True)
    changes = []
    for number, rows in enumerate(np.array_split(np.sort(problem.selection.vertices), parts)):
        progress.step(number, parts, "calibrate on parts")
        part, _ = calibrate(extract_submap(vi_map, rows), lenient)
        if part.parameters.names == result.parameters.names:
            changes.append(part.change)
    if len(changes) < 2:
        raise UserError(f"there are too few data to cut them into {parts} parts")
    spread = np.std(changes, axis=0, ddof=1) / np.sqrt(len(changes))
    uncertainty = dataclasses.replace(result.uncertainty, spread=spread)
    estimates = dataclasses.replace(result, uncertainty=uncertainty).estimates()
    return dataclasses.replace(report, parameters=estimates)


def _span_s(problem: SegmentProblem) -> float:
    """Return the time [s] that the runs of a problem's vertices last together."""
    rows = np.sort(problem.selection.vertices)
    run, time_ns = runs_of(problem.vi_map)[rows], problem.vi_map.vertices.timestamp_ns[rows]
    return 1e-9 * float(np.diff(time_ns)[run[1:] == run[:-1]].sum())


def doubt_large_changes(
    report: reports.SelfCalibrationReport, span_s: float
) -> reports.SelfCalibrationReport:
    """Return the report in which short data confirm no large change of a parameter."""
    if span_s >= _MIN_SPAN_S:
        return report
    determined = (Verdict.WELL_DETERMINED.text(), Verdict.WEAKLY_DETERMINED.text())

    def doubt(estimate: reports.ParameterEstimate) -> reports.ParameterEstimate:
        change = abs(estimate.change_in_sigmas)
        if change <= _MAX_CHANGE_IN_SIGMAS or estimate.verdict not in determined:
            return estimate
        return dataclasses.replace(estimate, verdict=Verdict.UNCONFIRMED.text(change, span_s))

    return dataclasses.replace(report, parameters=tuple(map(doubt, report.parameters)))


def _with_kept_positions(
    report: reports.SelfCalibrationReport, rejected: reports.SelfCalibrationReport, shift_m: float
) -> reports.SelfCalibrationReport:
    """Return a report with the camera positions of the rejected calibration, as they were before."""
    verdict = Verdict.KEPT.text(1e3 * shift_m)
    estimated = {estimate.parameter for estimate in report.parameters}
    kept = (
        dataclasses.replace(estimate, after=estimate.before, change_in_sigmas=0.0, verdict=verdict)
        for estimate in rejected.parameters
        if estimate.parameter not in estimated
    )
    return dataclasses.replace(report, parameters=(*report.parameters, *kept))
