"""Deviations that hold when the errors of a track hang together (decision 126).

Formal deviations take every observation of a landmark for a measurement of its own. Where a tracker
drifts, the errors of neighbouring images are alike, and the same number of observations says less.
Tracks are independent of each other all the same: the scatter of what each of them does to the result
shows how certain that is, whatever happens within.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.self_calibration.problem import SegmentProblem
from maplab_py.estimation.loss import robust
from maplab_py.estimation.states import States
from maplab_py.estimation.visual_terms import VisualTerms

F64 = NDArray[np.float64]

_STEP = 1e-3
"""Step of the derivatives, in formal deviations; landmarks close to the camera do not allow more."""
_LANDMARK_DAMPING = 1e-9


def covariance_by_tracks(problem: SegmentProblem, states: States) -> F64:
    """Return the covariance (k, k) of the calibration when whole tracks are what is independent.

    It is C (sum of g g^T + H) C, with C the formal covariance, g the gradients of single landmarks'
    costs, and H the information of all that is not a landmark, which is taken at its word
    (K.-Y. Liang and S. L. Zeger, Longitudinal data analysis using generalized linear models,
    Biometrika 1986). Where landmarks are at their optimum their elimination does not change g, so
    products of C and g are derivatives of a landmark's cost along columns of C.

    Args:
        problem: Factorised at the states, as `posterior_covariance` leaves it.
        states: The optimum.
    """
    inner = problem.posed.problem
    columns = inner.covariance_columns(*problem.parameters.nodes(states))
    size = columns.shape[-1]
    covariance = np.zeros((size, size))
    for term in inner.factors:
        _, jacobian = term.evaluate(states)
        moved = columns[term.nodes].reshape(*jacobian.shape[::2], -1)
        change = (jacobian @ moved).reshape(-1, size)
        covariance += change.T @ change
    if inner.visual is None:
        return covariance
    still = np.zeros((inner.num_nodes, 3))
    p_G, _, _ = inner.visual.take_step(states, still, states, _LANDMARK_DAMPING)
    settled = dataclasses.replace(states, p_G=p_G)
    node, direction = problem.parameters.nodes(states)
    formal = np.sqrt(columns[node, direction, np.arange(len(node))])
    change = np.empty((len(settled.p_G), size))
    for k, sigma in enumerate(formal):
        step = columns[:, :, k] * (_STEP / max(sigma, 1e-300))
        difference = _costs(inner.visual, settled, step) - _costs(inner.visual, settled, -step)
        change[:, k] = difference * (sigma / (2.0 * _STEP))
    covariance += change.T @ change
    return covariance


def larger_covariance(first: F64, second: F64) -> F64:
    """Return the covariance (k, k) that is as large as both in every direction, and no larger.

    Args:
        first: (k, k), positive definite.
        second: (k, k), of the same quantities.
    """
    L = np.linalg.cholesky(first)
    inverse = np.linalg.inv(L)
    share, turn = np.linalg.eigh(inverse @ second @ inverse.T)
    root = L @ turn
    return np.asarray((root * np.maximum(share, 1.0)) @ root.T)


def _costs(visual: VisualTerms, states: States, step: F64) -> F64:
    """Return the cost (L,) of every landmark when all but the landmarks make a step (nodes, 3)."""
    data = visual.observations
    error_px = np.nan_to_num(visual.errors(states.moved(step, states.p_G))[0])
    cost = robust(visual.loss, data.scale2, np.square(error_px * data.inverse_sigma))[0]
    return np.asarray(0.5 * np.bincount(data.landmark, cost, minlength=len(data.start) - 1))
