"""Removal of segments from a database: of missions, beyond a capacity, or of a device that changed."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from maplab_py.algorithms.self_calibration import device, reports
from maplab_py.algorithms.self_calibration.calibration import calibrate
from maplab_py.algorithms.self_calibration.estimation import imu_interpolation
from maplab_py.algorithms.self_calibration.estimation.parameters import Parameters
from maplab_py.algorithms.self_calibration.estimation.problem import build_segment_problem
from maplab_py.algorithms.self_calibration.estimation.solution import (
    chi_square_per_freedom,
    solve_rejecting_outliers,
)
from maplab_py.algorithms.self_calibration.options import SelfCalibrationOptions
from maplab_py.algorithms.self_calibration.segments.database import SegmentDatabase
from maplab_py.algorithms.self_calibration.uncertainty import (
    LANDMARK_DAMPING,
    MAX_PRIOR_SHARE,
    Uncertainty,
    posterior_covariance,
    spectrum,
)
from maplab_py.array_types import F64
from maplab_py.errors import EstimationError, UserError
from maplab_py.estimation.problem.marginals import cluster_robust_covariance
from maplab_py.progress import SILENT, Progress
from maplab_py.sensors import SensorSet
from maplab_py.vimap import VIMap

PROBABILITY = 0.999
"""Of accepting a segment if the calibration is right."""


def prune(
    database: SegmentDatabase,
    options: SelfCalibrationOptions,
    *,
    missions: Sequence[str] = (),
    outdated: bool = False,
    calibration: SensorSet | None = None,
    probability: float = PROBABILITY,
    capacity: int = 0,
    progress: Progress = SILENT,
) -> tuple[SegmentDatabase, reports.PruneReport]:
    """Remove segments of some missions, then outdated ones, then those beyond a capacity.

    Args:
        missions: Beginnings of ids of missions.
        outdated: Test the segments and remove those that contradict the calibration.
        calibration: To test against; None = the joint calibration of all segments.
        probability: Of accepting a segment if the calibration is right.
        capacity: Segments per table; 0 = as many as it has.

    Raises:
        EstimationError: Half of the segments contradict their joint calibration.
        UserError: A mission is unknown, or the calibration is of other cameras.
    """
    result, tests = database, list[reports.PrunedSegment]()
    if missions:
        prefixes = tuple(missions)
        removed = {r.mission for r in database.records if r.mission.startswith(prefixes)}
        if not removed:
            raise UserError(f"--missions: the database has no segment of {','.join(missions)}")
        result = result.without_missions(removed)
    if outdated:
        if calibration is None:
            tests = test_mutual_consistency(result, options, probability, progress)
        else:
            tests = test_segments(result, calibration, options, probability, progress)
        pairs = zip(result.records, tests, strict=True)
        result = result.with_only([record.key for record, test in pairs if not test.outdated])
    if capacity:
        result = result.pruned(capacity)
    return result, reports.PruneReport(len(database), len(result), tuple(tests))


def test_mutual_consistency(
    database: SegmentDatabase,
    options: SelfCalibrationOptions,
    probability: float,
    progress: Progress,
) -> list[reports.PrunedSegment]:
    """Test every segment against the joint calibration of all segments.

    Raises:
        EstimationError: Half of the segments contradict it, so that it is unknown which of them are
            outdated.
    """
    if not len(database):
        return []
    lenient = dataclasses.replace(options, keep_unobservable_at_prior=True)
    result, _ = calibrate(database.vi_map, lenient, segments=len(database), progress=progress)
    tests = test_segments(database, result.sensors, options, probability, progress)
    against = sum(test.outdated for test in tests)
    if 2 * against >= len(tests):
        raise EstimationError(
            f"{against} of {len(tests)} segments contradict what all say together, so the device may "
            "have changed between sessions: name the calibration that holds now by --calibration"
        )
    return tests


def test_segments(
    database: SegmentDatabase,
    sensors: SensorSet,
    options: SelfCalibrationOptions,
    probability: float,
    progress: Progress,
) -> list[reports.PrunedSegment]:
    """Test the measurements of every segment against a calibration.

    A segment is calibrated alone, from that calibration, with the same treatment of outliers as in a
    joint calibration. Under the hypothesis that the calibration is right, the change has a chi-square
    distributed Mahalanobis distance. Its covariance is as large as the formal one, scaled by the fit,
    and the cluster-robust one. Directions that the segment does not determine are held by the prior
    and are not tested.

    Args:
        sensors: The calibration; of other ids, when it has one IMU and one rig.
        probability: Of accepting a segment if the calibration is right.

    Raises:
        UserError: The calibration is of other cameras, or it is not clear of which.
    """
    from scipy.stats import chi2

    tests = []
    for number, record in enumerate(database.records):
        progress.step(number, len(database), "test segments")
        segment = device.transfer_calibration(database.map_of(record), sensors)
        estimate = estimate_segment(segment, options)
        distance, freedom = estimate.squared_distance()
        limit = float(chi2.ppf(probability, max(freedom, 1)))
        tests.append(
            reports.PrunedSegment(
                mission=record.mission[:8],
                first_vertex=record.first_vertex[:8],
                distance=distance,
                limit=limit,
                chi_square_per_freedom=estimate.fit,
                outdated=bool(freedom and distance > limit),
            )
        )
    return tests


@dataclasses.dataclass(frozen=True, eq=False)
class SegmentEstimate:
    """Calibration of a segment alone, from the calibration in its sensors."""

    parameters: Parameters
    change: F64  # (k,)
    formal: F64  # (k, k) posterior covariance, by which the prior is weighted against the data
    actual: F64  # (k, k) as large as the formal one, scaled by the fit, and the cluster-robust one
    fit: float  # chi-square per degree of freedom

    def squared_distance(self) -> tuple[float, int]:
        """Return the squared distance along the directions that the data determine, and their number."""
        scale, eigen = self.parameters.prior_sigma, spectrum(self.formal, self.parameters)
        determined = eigen.prior_share <= MAX_PRIOR_SHARE
        if not determined.any():
            return 0.0, 0
        basis = eigen.directions[:, determined]
        # the prior shrinks an estimate towards the calibration; its variance shrinks likewise
        root = np.sqrt(1.0 - eigen.prior_share[determined])
        actual = self.actual / np.outer(scale, scale)
        variance = root[:, None] * (basis.T @ actual @ basis) * root
        along = basis.T @ (self.change / scale)
        return float(along @ np.linalg.solve(variance, along)), int(determined.sum())


def estimate_segment(segment: VIMap, options: SelfCalibrationOptions) -> SegmentEstimate:
    """Calibrate a segment alone.

    Raises:
        EstimationError: It has no information.
    """
    if options.imu_curvature:
        segment = imu_interpolation.correct_interpolation_bias(segment)
    problem = build_segment_problem(segment, options)
    states = solve_rejecting_outliers(problem, options).states
    parameters = problem.parameters
    change = parameters.difference(states.blocks, problem.states.blocks)
    fit = chi_square_per_freedom(problem, states)
    formal = posterior_covariance(problem, states)
    robust = cluster_robust_covariance(
        problem.problem, states, *parameters.nodes(states), LANDMARK_DAMPING
    )
    uncertainty = Uncertainty(parameters.prior_sigma, formal, robust)
    actual = uncertainty.covariance(formal_scale=max(fit, 1.0))
    if not all(np.isfinite(values).all() for values in (change, formal, actual)):
        raise EstimationError("a segment has no more measurements than unknowns: was it at rest?")
    return SegmentEstimate(parameters, change, formal, actual, fit)
