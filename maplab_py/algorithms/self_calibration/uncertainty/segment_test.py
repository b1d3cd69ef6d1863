"""Chi-square test of a calibration on one segment (docs/studies/segment_test.md)."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.algorithms.self_calibration.estimation.imu_interpolation import (
    correct_interpolation_bias,
)
from maplab_py.algorithms.self_calibration.estimation.parameters import Parameters
from maplab_py.algorithms.self_calibration.estimation.problem import build_segment_problem
from maplab_py.algorithms.self_calibration.estimation.solution import (
    chi_square_per_freedom,
    solve_rejecting_outliers,
)
from maplab_py.algorithms.self_calibration.options import SelfCalibrationOptions
from maplab_py.algorithms.self_calibration.uncertainty.cluster_robust import (
    cluster_robust_covariance,
)
from maplab_py.algorithms.self_calibration.uncertainty.information import (
    posterior_covariance,
    spectrum,
)
from maplab_py.algorithms.self_calibration.uncertainty.model import MAX_PRIOR_SHARE, Uncertainty
from maplab_py.array_types import F64
from maplab_py.vimap import VIMap


@dataclasses.dataclass(frozen=True)
class SegmentTest:
    """Agreement of a segment with a calibration."""

    distance: float  # squared Mahalanobis distance of the segment's own estimate
    limit: float  # of the distance, at the chosen probability
    chi_square_per_freedom: float
    is_outdated: bool  # the distance is beyond the limit


def test_segment(
    segment: VIMap, options: SelfCalibrationOptions, probability: float
) -> SegmentTest:
    """Test the measurements of a segment against the calibration in its sensors.

    The segment is calibrated alone, from that calibration, with the same treatment of outliers as in a
    joint calibration. Under the hypothesis that the calibration is right, the change has a chi-square
    distributed Mahalanobis distance. Its covariance is as large as the formal one, scaled by the fit,
    and the cluster-robust one. Directions that the segment does not determine are held by the prior
    and are not tested.

    Args:
        segment: Map of a segment; its sensors have the calibration to test.
        options: What was estimated.
        probability: Of accepting a segment if the calibration is right.
    """
    from scipy.stats import chi2

    if options.imu_curvature:
        segment = correct_interpolation_bias(segment)
    problem = build_segment_problem(segment, options)
    states = solve_rejecting_outliers(problem, options).states
    parameters = problem.parameters
    change = parameters.difference(states.blocks, problem.states.blocks)
    fit = chi_square_per_freedom(problem, states)
    formal = posterior_covariance(problem, states)
    robust = cluster_robust_covariance(problem, states)
    uncertainty = Uncertainty(parameters.prior_sigma, formal, robust)
    actual = uncertainty.covariance(formal_scale=max(fit, 1.0))
    distance, freedom = squared_distance(change, formal, actual, parameters)
    limit = float(chi2.ppf(probability, max(freedom, 1)))
    return SegmentTest(distance, limit, fit, bool(freedom and distance > limit))


def squared_distance(
    change: F64, formal: F64, actual: F64, parameters: Parameters
) -> tuple[float, int]:
    """Return the squared distance along the directions that the data determine, and their number.

    Args:
        change: (k,) of the segment's estimate from the calibration.
        formal: Covariance (k, k) by which the prior is weighted against the data.
        actual: Covariance (k, k) of the errors of the data.
        parameters: What was estimated, with the prior deviations.
    """
    scale, eigen = parameters.prior_sigma, spectrum(formal, parameters)
    determined = eigen.prior_share <= MAX_PRIOR_SHARE
    if not determined.any():
        return 0.0, 0
    basis = eigen.directions[:, determined]
    # the prior shrinks an estimate towards the calibration; its variance shrinks likewise
    root = np.sqrt(1.0 - eigen.prior_share[determined])
    variance = root[:, None] * (basis.T @ (actual / np.outer(scale, scale)) @ basis) * root
    along = basis.T @ (change / scale)
    return float(along @ np.linalg.solve(variance, along)), int(determined.sum())
