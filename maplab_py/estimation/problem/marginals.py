"""Uncertainty of an optimum: blocks of the inverse of the normal equations.

The gauge is that of the problem: fixed states have no variance, and covariances are relative to them.
With robust losses the weights at the optimum are used, so down-weighted measurements contribute little.
"""

import dataclasses

import numpy as np
from numpy.typing import ArrayLike

from maplab_py.array_types import F64, I64
from maplab_py.errors import EstimationError
from maplab_py.estimation.kernels.loss import loss_and_weight
from maplab_py.estimation.linear import protocol, threads
from maplab_py.estimation.problem.problem import Problem
from maplab_py.estimation.states import States
from maplab_py.estimation.terms.visual import VisualTerms

_LANDMARK_DAMPING = 1e-12
"""Relative damping of landmarks' own 3 x 3 systems: those without parallax stay solvable."""


_STRETCHES = 20
"""Stretches of time whose errors are taken for independent."""


class Marginals:
    """Covariances of any states of a problem, from one factorisation."""

    def __init__(self, problem: Problem, states: States) -> None:
        """Factorise the normal equations at the states.

        Raises:
            EstimationError: They are singular; the message names where.
        """
        self._problem, self._states = problem, states
        with threads.single_blas_thread():
            problem.relinearize(states)
            linear = problem.linearize(states, _LANDMARK_DAMPING)
            try:
                problem.factorise(linear, 0.0)
            except protocol.NotPositiveDefinite as error:
                raise EstimationError(
                    "no covariance: the measurements do not determine "
                    f"{problem.name_of_node(states, error.node)}; fix it or add a prior"
                ) from None

    def nodes(self, nodes: ArrayLike) -> F64:
        """Return the joint covariance (3 k, 3 k) of nodes (k,), in the given order."""
        chosen = np.asarray(nodes, dtype=np.int64).reshape(-1)
        with threads.single_blas_thread():
            return self._problem.marginal_covariance(chosen)

    def block(self, name: str) -> F64:
        """Return the joint covariance (N d, N d) of a block's N parameters, without padding."""
        block, nodes = self._states.blocks[name], self._states.nodes(name)
        full = self.nodes(nodes)
        width = 3 * block.nodes_each
        kept = np.arange(len(block) * width).reshape(len(block), width)[:, : block.dimension]
        return np.asarray(full[np.ix_(kept.reshape(-1), kept.reshape(-1))])

    def robust_sigma(self, name: str) -> F64:
        """Return standard deviations (N, d) of a block's parameters, honest with correlated errors.

        They are the largest of the formal ones and of those with tracks, and with stretches of time, as
        independent clusters.
        """
        problem, states = self._problem, self._states
        block, nodes = states.blocks[name], states.nodes(name)
        sigma = np.sqrt(np.maximum(np.diag(self.block(name)), 0.0)).reshape(len(block), -1)
        row, column = np.nonzero(sigma)
        node, direction = nodes[row, column // 3], column % 3
        largest = sigma[row, column]
        for cluster in (None, self._stretches()):
            robust = cluster_robust_covariance(
                problem, states, node, direction, _LANDMARK_DAMPING, cluster
            )
            largest = np.maximum(largest, np.sqrt(np.maximum(np.diag(robust), 0.0)))
        sigma[row, column] = largest
        return sigma

    def _stretches(self) -> I64:
        """Return the stretch of time (L,) in which each landmark was first seen."""
        assert self._problem.visual is not None
        data = self._problem.visual.observations
        first = np.minimum(data.start[:-1], len(data) - 1)
        count = len(self._states.T_G_I)
        return np.asarray(data.vertex[first].astype(np.int64) * _STRETCHES // max(count, 1))


# Cluster-robust covariance: errors may be correlated within a track, or for some time (decision 18).
#
# The formal covariance takes all observations of a landmark for independent. Where a tracker drifts, or
# the model is wrong, errors in neighbouring images are correlated, and the same number of observations
# contains less information. Clusters are still independent of each other, so the scatter of their
# contributions to the result shows how uncertain it is, whatever the correlations within one.

_STEP = 1e-3
"""Step of the numeric derivatives, in formal deviations; landmarks close to a camera allow no more."""


def cluster_robust_covariance(
    problem: Problem,
    states: States,
    node: I64,
    direction: I64,
    landmark_damping: float,
    cluster: I64 | None = None,
) -> F64:
    """Return the covariance (k, k) of directions of nodes, with landmarks as independent clusters.

    It is C (sum of g g^T + H) C, with C the formal covariance, g the gradients of the costs of single
    clusters, and H the information of everything else, whose covariances are trusted (K.-Y. Liang
    and S. L. Zeger, Longitudinal data analysis using generalized linear models, Biometrika 1986).
    Where landmarks are at their optimum their elimination does not change g, so products of C and g
    are derivatives of a landmark's cost along columns of C.

    Args:
        problem: Factorised at the states without damping.
        states: The optimum.
        node: Nodes (k,).
        direction: Their directions (k,).
        landmark_damping: Of the landmarks' elimination.
        cluster: Cluster (L,) of each landmark, from 0; None = each is one.
    """
    columns = problem.covariance_columns(node, direction)
    size = columns.shape[-1]
    covariance = np.zeros((size, size))
    for term in problem.factors:
        _, jacobian = term.evaluate(states)
        moved = columns[term.nodes].reshape(*jacobian.shape[::2], -1)
        change = (jacobian @ moved).reshape(-1, size)
        covariance += change.T @ change
    if problem.visual is None:
        return covariance
    no_step = np.zeros((problem.num_nodes, 3))
    p_G, _, _ = problem.visual.take_step(states, no_step, states, landmark_damping)
    optimum = dataclasses.replace(states, p_G=p_G)
    formal_sigma = np.sqrt(columns[node, direction, np.arange(len(node))])
    change = np.empty((len(p_G), size))
    for k, sigma in enumerate(formal_sigma):
        step = columns[:, :, k] * (_STEP / max(sigma, 1e-300))
        difference = _costs(problem.visual, optimum, step)
        difference -= _costs(problem.visual, optimum, -step)
        change[:, k] = difference * (sigma / (2.0 * _STEP))
    if cluster is not None:
        of_landmark = change
        change = np.zeros((int(cluster.max(initial=-1)) + 1, size))
        np.add.at(change, cluster, of_landmark)
    covariance += change.T @ change
    return covariance


def _costs(visual: VisualTerms, states: States, step: F64) -> F64:
    """Return the cost (L,) of every landmark after all but the landmarks make a step (nodes, 3)."""
    data = visual.observations
    error_px = np.nan_to_num(visual.errors(states.moved(step, states.p_G))[0])
    cost = loss_and_weight(visual.loss, data.scale2, np.square(error_px * data.inverse_sigma))[0]
    return np.asarray(0.5 * np.bincount(data.landmark, cost, minlength=len(data.start) - 1))
