"""How two missions lie in each other, from closures between them; and all missions together."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.anchoring.options import AnchoringOptions
from maplab_py.geometry import se3, yaw

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Mask = NDArray[np.bool_]

_SIGMA_M, _SIGMA_RAD = 0.1, 0.02
"""What a closure is trusted to, against drift inside the missions."""


@dataclasses.dataclass(frozen=True, eq=False)
class Sightings:
    """Closures between missions: vertex poses as their own mission A has them and as B sees them."""

    mission_A: I64  # (N,)
    mission_B: I64  # (N,)
    T_A_I: F64  # (N, 7)
    T_B_I: F64  # (N, 7)
    weight: F64  # (N,) inliers

    def take(self, rows: I64 | Mask) -> Sightings:
        """Return some of the closures."""
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
    """Place missions in G (M, 4: position and yaw) so that the closures fit best.

    Args:
        sightings: Closures that agree, of all pairs of missions.
        start: First guess (M, 4) of T_G_M.
        fixed: Missions (M,) that stay where they are.
    """
    from scipy.optimize import least_squares

    free = np.flatnonzero(~fixed)
    if len(free) == 0 or len(sightings.weight) == 0:
        return start
    relative_yaw = yaw.from_pose(se3.compose(sightings.T_B_I, se3.inverse(sightings.T_A_I)))[:, 3]
    scale = np.sqrt(sightings.weight / sightings.weight.mean())[:, None]

    def residuals(x: F64) -> F64:
        T = start.copy()
        T[free] = x.reshape(-1, 4)
        A, B = T[sightings.mission_A], T[sightings.mission_B]
        gap = yaw.transform(A, sightings.T_A_I[:, 4:]) - yaw.transform(B, sightings.T_B_I[:, 4:])
        turn = yaw.wrap(A[:, 3] - B[:, 3] - relative_yaw)
        whitened = np.concatenate([gap / _SIGMA_M, turn[:, None] / _SIGMA_RAD], axis=1)
        return np.asarray((scale * whitened).ravel())

    solution = least_squares(residuals, start[free].ravel(), loss="soft_l1", x_scale="jac")
    fitted = start.copy()
    fitted[free] = solution.x.reshape(-1, 4)
    fitted[:, 3] = yaw.wrap(fitted[:, 3])
    return fitted
