"""Navigation states: pose, velocity and biases at several times."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from maplab_py.array_types import F64, I64, Rows


class NavState(Rows):
    """States of the IMU at N times, in the mission frame M."""

    time_ns: I64  # (N,)
    T_M_I: F64  # (N, 7)
    v_M: F64  # (N, 3) [m/s]
    gyro_bias: F64  # (N, 3) [rad/s]
    accel_bias: F64  # (N, 3) [m/s^2]

    @classmethod
    def single(
        cls, time_ns: int, T_M_I: F64, v_M: F64, gyro_bias: F64, accel_bias: F64
    ) -> NavState:
        """Return the state at one time, from columns without a first axis."""
        time = np.array([time_ns], dtype=np.int64)
        return NavState(time, T_M_I[None], v_M[None], gyro_bias[None], accel_bias[None])

    @classmethod
    def of_motion(cls, time_ns: I64, T_M_I: F64, motion: F64) -> NavState:
        """Return states whose velocities and biases are columns (N, 9) [v, b_g, b_a]."""
        return NavState(time_ns, T_M_I, motion[:, :3], motion[:, 3:6], motion[:, 6:])

    @classmethod
    def stack(cls, parts: Sequence[NavState]) -> NavState:
        """Return the states of all parts, one after another."""
        none = NavState.of_motion(np.zeros(0, np.int64), np.zeros((0, 7)), np.zeros((0, 9)))
        return NavState.concatenate([none, *parts])

    @property
    def motion(self) -> F64:
        """Velocities and biases (N, 9) [v, b_g, b_a]."""
        return np.concatenate([self.v_M, self.gyro_bias, self.accel_bias], axis=1)

    def row(self, index: int) -> NavState:
        """Return the state of one time."""
        return self.take(slice(index, index + 1))
