"""Align pairs of missions from the closures between them, and all missions jointly."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.algorithms.anchoring.options import AnchoringOptions
from maplab_py.array_types import F64, I64, Mask
from maplab_py.geometry import se3, yaw

_SIGMA_M, _SIGMA_RAD = 0.1, 0.02
"""Noise model of a closure, which includes drift inside the missions."""
_MAX_STEPS = 100
_CONVERGED = 1e-10
"""Largest change [m, rad] of a step after which the fit ends."""


@dataclasses.dataclass(frozen=True, eq=False)
class Sightings:
    """Closures between missions: vertex poses in the query's mission A and in the place's mission B."""

    mission_A: I64  # (N,)
    mission_B: I64  # (N,)
    T_A_I: F64  # (N, 7)
    T_B_I: F64  # (N, 7)
    weight: F64  # (N,) inliers

    def take(self, rows: I64 | Mask) -> Sightings:
        """Return the closures of a mask or rows."""
        return Sightings(
            self.mission_A[rows],
            self.mission_B[rows],
            self.T_A_I[rows],
            self.T_B_I[rows],
            self.weight[rows],
        )


def agreeing(sightings: Sightings, options: AnchoringOptions) -> tuple[F64, Mask]:
    """Align one pair of missions: the hypothesis of the closure that most inliers support.

    Every closure is a hypothesis (yaw and position), so the result depends on nothing but the
    closures; ties go to the first.

    Returns:
        T_B_A as yaw and position (4,), and which closures agree with it (N,).
    """
    E = yaw.from_pose(se3.compose(sightings.T_B_I, se3.inverse(sightings.T_A_I)))
    p = yaw.transform(E[:, None], sightings.T_A_I[None, :, 4:])  # hypothesis, closure
    distance = np.linalg.norm(p - sightings.T_B_I[None, :, 4:], axis=2)
    turn = np.abs(yaw.wrap(E[:, None, 3] - E[None, :, 3]))
    agree = (distance < options.ransac_max_position_error_m) & (
        turn < options.ransac_max_orientation_error_rad
    )
    best = int(np.argmax(agree @ sightings.weight))
    return E[best], np.asarray(agree[best])


def fit_missions(sightings: Sightings, start: F64, fixed: Mask) -> F64:
    """Estimate T_G_M (M, 4: position and yaw) of missions by robust least squares over the closures.

    Gauss-Newton with the weights of the loss 2 (sqrt(1 + r^2) - 1) of each whitened residual r.
    The sum of the normal equations takes time in proportion to the closures.

    Args:
        sightings: Closures that agree, of all pairs of missions.
        start: First guess (M, 4) of T_G_M.
        fixed: Missions (M,) whose pose is fixed.
    """
    free = np.flatnonzero(~fixed)
    if len(free) == 0 or len(sightings.weight) == 0:
        return start
    relative_yaw = yaw.from_pose(se3.compose(sightings.T_B_I, se3.inverse(sightings.T_A_I)))[:, 3]
    weight = sightings.weight / sightings.weight.mean()
    fitted = start.copy()
    unknown = (4 * free[:, None] + np.arange(4)).ravel()
    for _ in range(_MAX_STEPS):
        residual, J_A, J_B = _residuals(sightings, fitted, relative_yaw)
        robust = weight[:, None] / np.sqrt(1.0 + weight[:, None] * residual**2)
        H, g = _normal_equations(sightings, residual, J_A, J_B, robust, len(start))
        # missions without closures keep their pose
        H[np.diag_indices_from(H)] += np.where(H.diagonal() > 0.0, 0.0, 1.0)
        step = np.zeros(4 * len(start))
        step[unknown] = -np.linalg.solve(H[np.ix_(unknown, unknown)], g[unknown])
        fitted = fitted + step.reshape(-1, 4)
        if np.abs(step).max() < _CONVERGED:
            break
    fitted[:, 3] = yaw.wrap(fitted[:, 3])
    fitted[fixed] = start[fixed]
    return fitted


def _residuals(s: Sightings, T_G_M: F64, relative_yaw: F64) -> tuple[F64, F64, F64]:
    """Return whitened residuals (N, 4) and their derivatives (N, 4, 4) by the poses of A and B."""
    A, B = T_G_M[s.mission_A], T_G_M[s.mission_B]
    p_A, p_B = yaw.rotate(A[:, 3], s.T_A_I[:, 4:]), yaw.rotate(B[:, 3], s.T_B_I[:, 4:])
    gap = p_A + A[:, :3] - p_B - B[:, :3]
    turn = yaw.wrap(A[:, 3] - B[:, 3] - relative_yaw)
    residual = np.concatenate([gap / _SIGMA_M, turn[:, None] / _SIGMA_RAD], axis=1)
    derivatives = []
    for p, sign in ((p_A, 1.0), (p_B, -1.0)):
        J = np.zeros((len(gap), 4, 4))
        J[:, :3, :3] = sign * np.eye(3) / _SIGMA_M
        # d (R(yaw) p) / d yaw = z x (R p)
        J[:, 0, 3], J[:, 1, 3] = -sign * p[:, 1] / _SIGMA_M, sign * p[:, 0] / _SIGMA_M
        J[:, 3, 3] = sign / _SIGMA_RAD
        derivatives.append(J)
    return residual, derivatives[0], derivatives[1]


def _normal_equations(
    s: Sightings, residual: F64, J_A: F64, J_B: F64, robust: F64, missions: int
) -> tuple[F64, F64]:
    """Return the matrix (4M, 4M) and the gradient (4M,) of all missions."""
    H = np.zeros((missions, missions, 4, 4))
    g = np.zeros((missions, 4))
    for row, J_row in ((s.mission_A, J_A), (s.mission_B, J_B)):
        np.add.at(g, row, np.einsum("nia,ni,ni->na", J_row, robust, residual))
        for column, J_column in ((s.mission_A, J_A), (s.mission_B, J_B)):
            blocks = np.einsum("nia,ni,nib->nab", J_row, robust, J_column)
            np.add.at(H, (row, column), blocks)
    return H.transpose(0, 2, 1, 3).reshape(4 * missions, 4 * missions), g.ravel()
