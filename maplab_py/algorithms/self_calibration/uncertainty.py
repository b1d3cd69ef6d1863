"""Uncertainty of calibrations."""

import dataclasses
import math
from enum import Enum

import numpy as np

from maplab_py.algorithms.self_calibration.estimation.parameters import Parameters
from maplab_py.algorithms.self_calibration.estimation.problem import SegmentProblem
from maplab_py.array_types import F64, I64
from maplab_py.errors import EstimationError
from maplab_py.estimation.linear import protocol, threads
from maplab_py.estimation.problem.problem import Linearization
from maplab_py.estimation.states import States

MAX_PRIOR_SHARE = 0.5
"""Parameters that keep more of the prior's variance are left at the prior: the data say less."""

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
    with threads.single_blas_thread():
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
        except protocol.NotPositiveDefinite as error:
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
    with threads.single_blas_thread():
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


_WELL_DETERMINED_SHARE = 0.01
_MAX_SPREAD = 2.0
"""Parts of the data disagree where their spread is more than this many deviations."""


class Verdict(Enum):
    """Meaning of a parameter's deviation; values are the texts of reports."""

    WELL_DETERMINED = "well determined"
    WEAKLY_DETERMINED = "weakly determined"
    PARTS_DISAGREE = "weakly determined: parts of the data disagree by {:.1f} sigma"
    NOT_EXCITED = "not excited, left at its prior"
    KEPT = "kept: the data would move the camera by {:.0f} mm"
    UNCONFIRMED = "not confirmed: {:.1f} sigma on {:.0f} s of data"

    def text(self, *values: float) -> str:
        """Return the text of reports."""
        return self.value.format(*values)


@dataclasses.dataclass(frozen=True, eq=False)
class Uncertainty:
    """The uncertainty of k parameters.

    Every part allows for errors that those before it exclude. The reported deviation of a parameter
    is the largest of all parts.
    """

    prior_sigma: F64  # (k,)
    formal: F64  # (k, k): all measurements are independent, with the noise that was measured
    cluster_robust: F64 | None = None  # (k, k): errors may be correlated within a track
    spread: F64 | None = None  # (k,): standard error of the mean of results on parts of the data
    noise_factor: float = 1.0  # measured keypoint noise over the map's; `formal` contains it

    @property
    def formal_sigma(self) -> F64:
        """Formal deviations (k,)."""
        return np.sqrt(np.maximum(np.diag(self.formal), 1e-300))

    @property
    def cluster_robust_sigma(self) -> F64:
        """Deviations (k,) with tracks as clusters; the formal ones where they are not known."""
        if self.cluster_robust is None:
            return self.formal_sigma
        return np.sqrt(np.diag(self.cluster_robust))

    @property
    def model_sigma(self) -> F64:
        """Deviations (k,) that follow from the noise of the measurements."""
        return np.maximum(self.formal_sigma, self.cluster_robust_sigma)

    @property
    def sigma(self) -> F64:
        """Reported deviations (k,)."""
        return (
            self.model_sigma if self.spread is None else np.maximum(self.model_sigma, self.spread)
        )

    @property
    def track_factor(self) -> float:
        """Median ratio of cluster-robust to formal deviations."""
        return float(np.median(self.cluster_robust_sigma / self.formal_sigma))

    @property
    def prior_share(self) -> F64:
        """Share (k,) of the prior's variance that the data leave."""
        return np.asarray((self.formal_sigma / self.prior_sigma) ** 2)

    def covariance(self, formal_scale: float = 1.0) -> F64:
        """Return the smallest covariance (k, k) that is as large as both parts in every direction."""
        formal = self.formal * formal_scale
        if self.cluster_robust is None:
            return np.asarray(formal)
        return larger_covariance(formal, self.cluster_robust)

    def verdicts(self) -> tuple[str, ...]:
        """Return the text of the verdict on every parameter."""
        texts = []
        for share in self.prior_share:
            verdict = Verdict.WEAKLY_DETERMINED
            if share > MAX_PRIOR_SHARE:
                verdict = Verdict.NOT_EXCITED
            elif share < _WELL_DETERMINED_SHARE:
                verdict = Verdict.WELL_DETERMINED
            texts.append(verdict.text())
        if self.spread is not None:
            ratio = self.spread / self.model_sigma
            for k in np.flatnonzero(ratio > _MAX_SPREAD).tolist():
                texts[k] = Verdict.PARTS_DISAGREE.text(ratio[k])
        return tuple(texts)


def larger_covariance(first: F64, second: F64) -> F64:
    """Return the smallest covariance (k, k) that is as large as two others in every direction.

    Args:
        first: (k, k), positive definite.
        second: (k, k), of the same quantities.
    """
    L = np.linalg.cholesky(first)
    inverse = np.linalg.inv(L)
    share, turn = np.linalg.eigh(inverse @ second @ inverse.T)
    root = L @ turn
    return np.asarray((root * np.maximum(share, 1.0)) @ root.T)
