"""How far a calibration can be believed: against drawings, and against parts of its own data.

Formal deviations follow from the noise of measurements. What a model leaves out they do not know:
on recorded maps they are too small by a factor of several for the camera's position (decisions 97
and 99).
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.self_calibration.calibration import calibrate
from maplab_py.algorithms.self_calibration.segments import restricted
from maplab_py.algorithms.self_calibration.workflow import into_map, self_calibrate
from maplab_py.errors import UserError
from maplab_py.estimation.camera_terms import EXTRINSICS
from maplab_py.progress import SILENT, Progress

if TYPE_CHECKING:
    from maplab_py.algorithms.self_calibration.calibration import Calibration
    from maplab_py.algorithms.self_calibration.database import SegmentDatabase
    from maplab_py.algorithms.self_calibration.options import SelfCalibrationOptions
    from maplab_py.algorithms.self_calibration.reports import (
        ParameterEstimate,
        SelfCalibrationReport,
    )
    from maplab_py.sensors import SensorSet
    from maplab_py.vimap import VIMap

_POSITION = "extrinsics_translation"


def camera_shift_m(result: Calibration) -> float:
    """Return how far [m] a calibration moved the camera that moved farthest on the IMU."""
    shift = np.zeros(3)
    farthest = 0.0
    for one, change in zip(result.parameters.each, result.change, strict=True):
        if one.block == EXTRINSICS and one.column < 3:
            shift[one.column] = change
            if one.column == 2:
                farthest = max(farthest, float(np.linalg.norm(shift)))
    return farthest


def calibrate_plausibly(
    vi_map: VIMap,
    options: SelfCalibrationOptions,
    *,
    max_camera_shift_m: float = 0.0,
    parts: int = 0,
    database: SegmentDatabase | None = None,
    missions: NDArray[np.integer] | None = None,
    batch: bool = False,
    progress: Progress = SILENT,
) -> tuple[SensorSet, SegmentDatabase | None, SelfCalibrationReport]:
    """Calibrate; where the camera moves too far, keep its position and calibrate the rest again.

    Args:
        vi_map: The map.
        options: What to estimate.
        max_camera_shift_m: How far the camera may be from where it was; 0 = anywhere.
        parts: Calibrate on so many parts of the data as well, and report deviations that are not
            smaller than the spread of the results tells; 0 = formal deviations.
        database: Segments of earlier sessions.
        missions: Missions (rows, None = all).
        batch: Use all data instead of segments.
        progress: Shown one line an iteration.

    Raises:
        EstimationError: The data do not determine the calibration.
        UserError: The missions were recorded with different devices.
    """
    if parts == 1 or parts < 0:
        raise UserError("a spread needs two parts of the data at least")
    sensors, collected, result, report = self_calibrate(
        vi_map, options, database=database, missions=missions, batch=batch, progress=progress
    )
    shift_m = camera_shift_m(result)
    rest = sorted(options.estimated() - {_POSITION})
    if not 0.0 < max_camera_shift_m < shift_m or not rest:
        report = with_spread(report, result, options, parts, progress)
        return sensors, collected, report
    without = dataclasses.replace(options, states=",".join(rest))
    if collected is None:
        sensors, _, result, again = self_calibrate(
            vi_map, without, missions=missions, batch=batch, progress=progress
        )
    else:
        result, again = calibrate(
            collected.vi_map, without, segments=len(collected), progress=progress
        )
        sensors = into_map(vi_map, collected.vi_map, result.sensors, missions)
    again = with_spread(again, result, without, parts, progress)
    return sensors, collected, _with_kept(again, report, shift_m)


def with_spread(
    report: SelfCalibrationReport,
    result: Calibration,
    options: SelfCalibrationOptions,
    parts: int,
    progress: Progress = SILENT,
) -> SelfCalibrationReport:
    """Return the report with deviations that results on parts of the data support.

    The vertices are cut into runs of equal length, each is calibrated by itself, beginning at the
    result. The mean of n results has the deviation of their spread over sqrt(n); where that is more
    than the formal deviation, it is what the report says.

    Args:
        report: With formal deviations.
        result: What the report is about.
        options: What was estimated.
        parts: n; 0 = return the report as it is.
        progress: Shown between parts.
    """
    if not parts:
        return report
    posed = result.problem.posed
    vi_map = posed.vi_map.replace(sensors=result.sensors)
    alone = dataclasses.replace(options, keep_unobservable_at_prior=True)
    changes = []
    for number, rows in enumerate(np.array_split(np.sort(posed.selection.vertices), parts)):
        progress.step(number, parts, "calibrate on parts")
        one, _ = calibrate(restricted(vi_map, rows), alone)
        if one.parameters.names == result.parameters.names:
            changes.append(one.change)
    if len(changes) < 2:
        raise UserError(f"there are too few data to cut them into {parts} parts")
    spread = np.std(changes, axis=0, ddof=1) / np.sqrt(len(changes))
    pairs = zip(report.parameters, spread.tolist(), strict=True)
    estimates = tuple(_widened(one, sigma) for one, sigma in pairs)
    return dataclasses.replace(report, parameters=estimates)


def _widened(one: ParameterEstimate, sigma: float) -> ParameterEstimate:
    """Return an estimate with at least a deviation; verdicts are those of `calibrate`."""
    if sigma <= one.sigma:
        return one
    verdict = one.verdict
    if sigma > 2.0 * one.sigma:
        verdict = f"weakly determined: parts of the data disagree by {sigma / one.sigma:.1f} sigma"
    factor = one.sigma / sigma
    return dataclasses.replace(
        one, sigma=sigma, change_in_sigmas=one.change_in_sigmas * factor, verdict=verdict
    )


def _with_kept(
    again: SelfCalibrationReport, first: SelfCalibrationReport, shift_m: float
) -> SelfCalibrationReport:
    """Return the second report with the positions of the first, which were not believed."""
    verdict = f"kept: the data would move the camera by {1e3 * shift_m:.0f} mm"
    known = {one.parameter for one in again.parameters}
    kept = tuple(
        dataclasses.replace(one, after=one.before, change_in_sigmas=0.0, verdict=verdict)
        for one in first.parameters
        if one.parameter not in known
    )
    return dataclasses.replace(again, parameters=(*again.parameters, *kept))
