"""Cumulative cubic B-splines on R3 x SO(3): a smooth motion with exact derivatives.

Source: Sommer 2020, eq. (9) and (16)-(21), for order 4.
"""

import dataclasses

import numpy as np
from numpy.typing import ArrayLike, NDArray

from maplab_py.array_types import F64, Rows
from maplab_py.errors import UserError
from maplab_py.geometry import se3, so3

# Cumulative blending of a uniform cubic B-spline: rows are lambda_1 .. lambda_3, columns powers of u
_BLEND = np.array([[5.0, 3.0, -3.0, 1.0], [1.0, 3.0, 3.0, -2.0], [0.0, 0.0, 0.0, 1.0]]) / 6.0


class MotionState(Rows):
    """Motion of the body I at N times, expressed in the fixed frame G unless said otherwise."""

    T_G_I: F64  # (N, 7)
    v_G: F64  # (N, 3) [m/s]
    a_G: F64  # (N, 3) [m/s^2]
    w_I: F64  # (N, 3) angular velocity in I [rad/s]
    alpha_I: F64  # (N, 3) angular acceleration in I [rad/s^2]


@dataclasses.dataclass(frozen=True, eq=False)
class PoseSpline:
    """A motion through control poses that are `spacing_s` apart; valid in [0, duration_s]."""

    control: F64  # (K, 7) poses T_G_I, K >= 4
    spacing_s: float

    def __post_init__(self) -> None:
        """Check the number of control poses and their spacing."""
        if len(self.control) < 4 or not self.spacing_s > 0.0:
            raise UserError("a spline needs at least four control poses and a positive spacing")

    @property
    def duration_s(self) -> float:
        """Length of the motion [s]."""
        return float((len(self.control) - 3) * self.spacing_s)

    def evaluate(self, time_s: ArrayLike) -> MotionState:
        """Return the motion at times (N,) [s].

        Raises:
            UserError: A time lies outside [0, duration_s].
        """
        time = np.asarray(time_s, dtype=np.float64)
        if np.any((time < 0.0) | (time > self.duration_s * (1.0 + 1e-12))):
            raise UserError(f"the motion lasts from 0 to {self.duration_s:g} s")
        position = time / self.spacing_s
        segment = np.clip(np.floor(position).astype(np.int64), 0, len(self.control) - 4)
        blend, rate, change = self._blending(position - segment)
        p = self.control[:, 4:]
        steps = np.stack([p[segment + j + 1] - p[segment + j] for j in range(3)], axis=1)
        p_G = p[segment] + np.sum(blend[:, :, None] * steps, axis=1)
        v_G = np.sum(rate[:, :, None] * steps, axis=1)
        a_G = np.sum(change[:, :, None] * steps, axis=1)
        q, w_I, alpha_I = self._rotation(segment, blend, rate, change)
        return MotionState(se3.make(q, p_G), v_G, a_G, w_I, alpha_I)

    def poses_of(self, time_s: F64, T_I_S: F64) -> F64:
        """Return the poses T_G_S (N, 7) of a sensor at times (N,) [s], before and after those at the ends."""
        inside = np.clip(time_s, 0.0, self.duration_s)
        return se3.compose(self.evaluate(inside).T_G_I, T_I_S)

    def _blending(self, u: F64) -> tuple[F64, F64, F64]:
        """Return the blending values (N, 3) at fractions u (N,), and their time derivatives."""
        ones, zeros = np.ones_like(u), np.zeros_like(u)
        powers = np.stack([ones, u, u**2, u**3], axis=1)
        first = np.stack([zeros, ones, 2.0 * u, 3.0 * u**2], axis=1) / self.spacing_s
        second = np.stack([zeros, zeros, 2.0 * ones, 6.0 * u], axis=1) / self.spacing_s**2
        return powers @ _BLEND.T, first @ _BLEND.T, second @ _BLEND.T

    def _rotation(
        self, segment: NDArray[np.int64], blend: F64, rate: F64, change: F64
    ) -> tuple[F64, F64, F64]:
        """Return q_G_I (N, 4), angular velocity and acceleration (N, 3) in I."""
        q_control = self.control[:, :4]
        steps = so3.log(so3.multiply(so3.inverse(q_control[:-1]), q_control[1:]))
        q = q_control[segment]
        w = np.zeros((len(segment), 3))
        alpha = np.zeros_like(w)
        for j in range(3):
            d = steps[segment + j]
            turn = so3.exp(blend[:, j, None] * d)
            back = so3.inverse(turn)
            q = so3.multiply(q, turn)
            w = so3.rotate(back, w) + rate[:, j, None] * d
            alpha = (
                so3.rotate(back, alpha) + change[:, j, None] * d + rate[:, j, None] * np.cross(w, d)
            )
        return so3.normalize(q), w, alpha
