"""How much a segment says about the calibration (thesis section 5.2, eq. 7.24-7.31)."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.self_calibration.parameters import Parameters
from maplab_py.algorithms.self_calibration.problem import SegmentProblem
from maplab_py.errors import EstimationError
from maplab_py.estimation.inertial_terms import InertialTerm
from maplab_py.estimation.linear.protocol import NotPositiveDefinite
from maplab_py.estimation.linear.threads import single_blas_thread
from maplab_py.estimation.problem import Linearization
from maplab_py.estimation.states import States

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

_DAMPINGS = (0.0, 1e-13, 1e-11, 1e-9)
"""Relative damping of the states, tried in turn where eliminated landmarks leave rounding errors."""
_LANDMARK_DAMPING = 1e-9
"""Relative damping of landmarks' own systems: distances beyond what parallax shows stay finite."""


def posterior_covariance(problem: SegmentProblem, states: States) -> F64:
    """Return the covariance (k, k) of the calibration given the data and the weak priors.

    Landmarks are eliminated, then the vertices' states; the gauge is fixed before.

    Raises:
        EstimationError: The normal equations are singular in spite of the priors.
    """
    inner = problem.posed.problem
    with single_blas_thread():
        for term in inner.factors:
            if isinstance(term, InertialTerm):
                term.integrate(states)
        linear = inner.linearize(states, _LANDMARK_DAMPING)
        _factorise(problem, linear, states)
        node, direction = problem.parameters.nodes(states)
        unique, where = np.unique(node, return_inverse=True)
        full = inner.marginal_covariance(unique)
    column = 3 * np.asarray(where).reshape(-1) + direction
    return np.asarray(full[np.ix_(column, column)])


def _factorise(problem: SegmentProblem, linear: Linearization, states: States) -> None:
    """Factorise with as little damping as rounding allows."""
    inner, failed = problem.posed.problem, 0
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
    """Directions of the calibration, in units of the prior, and what data alone say about them."""

    directions: F64  # (k, k) columns
    share: F64  # (k,) posterior over prior variance: 1 = the data say nothing

    def unobservable(self, threshold: float = 0.5) -> F64:
        """Return the directions (k, n) of which more of the prior is left, the most first."""
        return np.asarray(self.directions[:, self.share > threshold][:, ::-1])


def spectrum(covariance: F64, parameters: Parameters) -> Spectrum:
    """Decompose a posterior covariance (k, k): rank is judged in units of the prior.

    With a unit prior, data whose information in a direction is below one leave more than half of
    the prior's variance. This is the truncation of a rank-revealing decomposition.
    """
    scale = parameters.prior_sigma
    with single_blas_thread():
        share, directions = np.linalg.eigh(covariance / np.outer(scale, scale))
    return Spectrum(directions, np.clip(share, 0.0, 1.0))


def name_direction(direction: F64, parameters: Parameters) -> str:
    """Say in words which parameters make up a direction (k,) in units of the prior."""
    weight = direction**2
    order = np.argsort(-weight)
    named = [int(k) for k in order if weight[k] >= 0.5 * weight[order[0]]][:4]
    return " with ".join(parameters.names[k] for k in named)


def score(covariance: F64, sigma_ref: F64, rows: I64, metric: str) -> float:
    """Return the information of one group: less is more.

    Args:
        covariance: (k, k) of the whole calibration.
        sigma_ref: (k,) usual deviations that make parameters comparable (eq. 7.28).
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
    return 0.5 * (len(rows) * float(np.log(2.0 * np.pi * np.e)) + log_determinant)


def reference_sigma(covariances: list[F64]) -> F64:
    """Return the median (k,) of the segments' standard deviations, parameter by parameter."""
    deviations = np.sqrt(np.maximum([np.diag(one) for one in covariances], 0.0))
    return np.asarray(np.median(deviations, axis=0))
