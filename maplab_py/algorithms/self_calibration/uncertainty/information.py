"""Formal covariance of the calibration and information of segments (Schneider 2019, section 5.2)."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from maplab_py.algorithms.self_calibration.estimation.parameters import Parameters
from maplab_py.algorithms.self_calibration.estimation.problem import SegmentProblem
from maplab_py.algorithms.self_calibration.uncertainty.model import MAX_PRIOR_SHARE
from maplab_py.array_types import F64, I64
from maplab_py.errors import EstimationError
from maplab_py.estimation.linear.protocol import NotPositiveDefinite
from maplab_py.estimation.linear.threads import single_blas_thread
from maplab_py.estimation.problem.problem import Linearization
from maplab_py.estimation.states import States

LANDMARK_DAMPING = 1e-9
"""Relative damping of the landmarks' own systems: those without parallax stay solvable."""
_DAMPINGS = (0.0, 1e-13, 1e-11, 1e-9)
"""Relative damping of the states, tried in turn where eliminating landmarks leaves rounding errors."""


def posterior_covariance(problem: SegmentProblem, states: States) -> F64:
    """Return the formal covariance (k, k) of the calibration, given the data and the weak priors.

    Landmarks are eliminated, then the vertices' states. The problem stays factorised at the states.

    Raises:
        EstimationError: The normal equations are singular in spite of the priors.
    """
    inner = problem.problem
    with single_blas_thread():
        inner.relinearize(states)
        _factorise(problem, inner.linearize(states, LANDMARK_DAMPING), states)
        node, direction = problem.parameters.nodes(states)
        unique, where = np.unique(node, return_inverse=True)
        covariance = inner.marginal_covariance(unique)
    column = 3 * np.asarray(where).reshape(-1) + direction
    return np.asarray(covariance[np.ix_(column, column)])


def _factorise(problem: SegmentProblem, linear: Linearization, states: States) -> None:
    """Factorise with as little damping as rounding allows."""
    inner, failed = problem.problem, 0
    for damping in _DAMPINGS:
        try:
            inner.factorise(linear, damping)
        except NotPositiveDefinite as error:
            failed = error.node
        else:
            return
    raise EstimationError(f"no covariance: nothing determines {inner.name_of_node(states, failed)}")


@dataclasses.dataclass(frozen=True, eq=False)
class Spectrum:
    """Principal directions of a posterior covariance in units of the prior deviations."""

    directions: F64  # (k, k) columns
    prior_share: F64  # (k,) ascending: posterior over prior variance; 1 = the data add nothing

    def unobservable(self, max_share: float = MAX_PRIOR_SHARE) -> F64:
        """Return the directions (k, n) that keep more of the prior's variance, the largest first."""
        return np.asarray(self.directions[:, self.prior_share > max_share][:, ::-1])


def spectrum(covariance: F64, parameters: Parameters) -> Spectrum:
    """Decompose a posterior covariance (k, k).

    With a unit prior, a direction in which the information of the data is below one keeps more than
    half of the prior's variance. This is the truncation of a rank-revealing decomposition.
    """
    scale = parameters.prior_sigma
    with single_blas_thread():
        share, directions = np.linalg.eigh(covariance / np.outer(scale, scale))
    return Spectrum(directions, np.clip(share, 0.0, 1.0))


def name_directions(directions: F64, parameters: Parameters) -> tuple[str, ...]:
    """Return the parameters that dominate each of some directions (k, n) in units of the prior."""
    names = []
    for weight in directions.T**2:
        order = np.argsort(-weight)
        dominant = [int(k) for k in order if weight[k] >= 0.5 * weight[order[0]]][:4]
        names.append(" with ".join(parameters.names[k] for k in dominant))
    return tuple(names)


def score(covariance: F64, sigma_ref: F64, rows: I64, metric: str) -> float:
    """Return the uncertainty that a segment leaves in a group of parameters: less is more informative.

    Args:
        covariance: (k, k) of the whole calibration.
        sigma_ref: (k,) reference deviations that normalise the parameters (Schneider 2019, eq. 7.28).
        rows: The group's parameters.
        metric: A-optimality (trace), D-optimality (log of the determinant), E-optimality (largest
            eigenvalue), or entropy [nat], all of the normalised marginal covariance.
    """
    if not len(rows):
        return 0.0
    scale = sigma_ref[rows]
    normalised = covariance[np.ix_(rows, rows)] / np.outer(scale, scale)
    if metric == "a_optimality":
        return float(np.trace(normalised))
    eigenvalues = np.maximum(np.linalg.eigvalsh(normalised), 1e-300)
    if metric == "e_optimality":
        return float(eigenvalues[-1])
    log_determinant = float(np.log(eigenvalues).sum())
    if metric == "d_optimality":
        return log_determinant
    return 0.5 * (len(rows) * math.log(2.0 * math.pi * math.e) + log_determinant)
