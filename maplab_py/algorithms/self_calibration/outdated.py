"""Does a segment still fit the calibration? A device that was dropped is not what it was."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.self_calibration.calibration import (
    calibrate,
    chi_square_per_freedom,
    settled,
)
from maplab_py.algorithms.self_calibration.curvature import with_curvature
from maplab_py.algorithms.self_calibration.database import SegmentDatabase
from maplab_py.algorithms.self_calibration.information import posterior_covariance
from maplab_py.algorithms.self_calibration.options import SelfCalibrationOptions
from maplab_py.algorithms.self_calibration.parameters import Parameters
from maplab_py.algorithms.self_calibration.problem import pose
from maplab_py.algorithms.self_calibration.track_deviations import (
    covariance_by_tracks,
    larger_covariance,
)
from maplab_py.algorithms.self_calibration.workflow import applied
from maplab_py.errors import EstimationError
from maplab_py.progress import SILENT, Progress
from maplab_py.sensors import SensorSet

F64 = NDArray[np.float64]

_DETERMINED = 0.5
"""Share of the prior's variance that is left in a direction, at most, for the data to have a say."""


@dataclasses.dataclass(frozen=True)
class SegmentFit:
    """How well a segment agrees with a calibration."""

    mission: str
    first_vertex: str
    distance: float  # squared, of the segment's own estimate from the calibration, in its sigmas
    limit: float  # of the distance, at the chosen probability
    chi_square_per_freedom: float
    is_outdated: bool


def fits_together(
    database: SegmentDatabase,
    options: SelfCalibrationOptions,
    probability: float = 0.999,
    progress: Progress = SILENT,
) -> list[SegmentFit]:
    """Test every segment against the calibration that all of them make together.

    Raises:
        EstimationError: Half of them contradict it, so that nobody can tell which of them are outdated.
    """
    if len(database) == 0:
        return []
    lenient = dataclasses.replace(options, keep_unobservable_at_prior=True)
    result, _ = calibrate(database.vi_map, lenient, segments=len(database), progress=progress)
    tested = fits(database, result.sensors, options, probability, progress)
    against = sum(one.is_outdated for one in tested)
    if 2 * against >= len(tested):
        raise EstimationError(
            f"{against} of {len(tested)} segments contradict what all say together, so the device may have "
            "changed between sessions: name the calibration that holds now by --calibration"
        )
    return tested


def fits(
    database: SegmentDatabase,
    sensors: SensorSet,
    options: SelfCalibrationOptions,
    probability: float = 0.999,
    progress: Progress = SILENT,
) -> list[SegmentFit]:
    """Test every segment's measurements against a calibration.

    Each segment is calibrated by itself, beginning at the given calibration, with outliers treated as
    when all are calibrated together. Under the hypothesis that it still holds, the change is a
    chi-square distance in the covariance of the estimate: the formal one, or that by tracks where
    it is larger (decision 130). Directions that the segment says nothing about are held by the
    prior and add nothing.

    Args:
        database: Segments.
        sensors: The calibration to test; of other ids, when it has one IMU and one rig.
        options: What was estimated.
        probability: Of calling a good segment good.
        progress: Shown while segments are tested.

    Raises:
        UserError: The calibration is of other cameras, or it is not clear of which.
    """
    from scipy.stats import chi2

    result = []
    for number, record in enumerate(database.records):
        progress.step(number, len(database), "test segments")
        own = applied(database.map_of(record), sensors)
        problem = pose(with_curvature(own) if options.imu_curvature else own, options)
        states, _, _ = settled(problem, options, SILENT)
        change = problem.parameters.difference(states.blocks, problem.posed.states.blocks)
        covariance = posterior_covariance(problem, states)
        fit = chi_square_per_freedom(problem, states)
        actual = larger_covariance(
            covariance * max(fit, 1.0), covariance_by_tracks(problem, states)
        )
        distance, freedom = _distance(change, covariance, actual, problem.parameters)
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


def _distance(change: F64, formal: F64, actual: F64, parameters: Parameters) -> tuple[float, int]:
    """Return the squared distance along the directions that the data determine, and their number.

    Args:
        change: (k,) of the segment's estimate from the calibration.
        formal: Covariance (k, k) by which the prior weighs the data.
        actual: Covariance (k, k) of the data's errors.
        parameters: What was estimated, with the deviations of the prior.
    """
    scale = parameters.prior_sigma
    share, directions = np.linalg.eigh(formal / np.outer(scale, scale))
    determined = share <= _DETERMINED
    if not determined.any():
        return 0.0, 0
    basis = directions[:, determined]
    # the prior shrinks an estimate towards the calibration; its variance shrinks likewise
    root = np.sqrt(1.0 - share[determined])
    spread = root[:, None] * (basis.T @ (actual / np.outer(scale, scale)) @ basis) * root
    along = basis.T @ (change / scale)
    return float(along @ np.linalg.solve(spread, along)), int(determined.sum())
