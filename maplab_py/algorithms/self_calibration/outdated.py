"""Does a segment still fit the calibration? A device that was dropped is not what it was."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.self_calibration.calibration import chi_square_per_freedom, solve
from maplab_py.algorithms.self_calibration.curvature import with_curvature
from maplab_py.algorithms.self_calibration.database import SegmentDatabase, with_calibration
from maplab_py.algorithms.self_calibration.information import posterior_covariance
from maplab_py.algorithms.self_calibration.options import SelfCalibrationOptions
from maplab_py.algorithms.self_calibration.parameters import Parameters
from maplab_py.algorithms.self_calibration.problem import pose
from maplab_py.progress import SILENT, Progress
from maplab_py.sensors import SensorSet

F64 = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class SegmentFit:
    """How well a segment agrees with a calibration."""

    mission: str
    first_vertex: str
    distance: float  # squared, of the segment's own estimate from the calibration, in its sigmas
    limit: float  # of the distance, at the chosen probability
    chi_square_per_freedom: float
    is_outdated: bool


def fits(
    database: SegmentDatabase,
    sensors: SensorSet,
    options: SelfCalibrationOptions,
    *,
    probability: float = 0.999,
    calibration_covariance: F64 | None = None,
    progress: Progress = SILENT,
) -> list[SegmentFit]:
    """Test every segment's measurements against a calibration.

    Each segment is calibrated by itself, beginning at the given calibration; under the hypothesis
    that it still holds, the change is a chi-square distance in the covariance of the estimate.
    Directions that the segment says nothing about are held by the prior and add nothing.

    Args:
        database: Segments.
        sensors: The calibration to test.
        options: What was estimated.
        probability: Of calling a good segment good.
        calibration_covariance: (k, k) of the calibration itself; None = it is exact.
        progress: Shown while segments are tested.
    """
    from scipy.stats import chi2

    result = []
    for number, record in enumerate(database.records):
        progress.step(number, len(database), "test segments")
        own = database.map_of(record)
        own = own.replace(sensors=with_calibration(own.sensors, sensors))
        problem = pose(with_curvature(own) if options.imu_curvature else own, options)
        states, _ = solve(problem, options, progress=SILENT)
        change = problem.parameters.difference(states.blocks, problem.posed.states.blocks)
        covariance = posterior_covariance(problem, states)
        fit = chi_square_per_freedom(problem, states)
        scaled = covariance * max(fit, 1.0)
        if calibration_covariance is not None:
            scaled = scaled + calibration_covariance
        distance, freedom = _distance(change, scaled, problem.parameters)
        limit = float(chi2.ppf(probability, max(freedom, 1)))
        result.append(
            SegmentFit(
                record.mission[:8],
                record.first_vertex,
                distance,
                limit,
                fit,
                bool(freedom and distance > limit),
            )
        )
    return result


def _distance(change: F64, covariance: F64, parameters: Parameters) -> tuple[float, int]:
    """Return the squared distance along the directions that the data determine, and their number."""
    scale = parameters.prior_sigma
    share, directions = np.linalg.eigh(covariance / np.outer(scale, scale))
    along = directions.T @ (change / scale)
    determined = share <= 0.5
    if not determined.any():
        return 0.0, 0
    # the prior shrinks an estimate towards the calibration; its variance shrinks likewise
    spread = share[determined] * (1.0 - np.minimum(share[determined], 0.5))
    return float(np.sum(along[determined] ** 2 / spread)), int(determined.sum())
