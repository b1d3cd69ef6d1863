"""The states that an optimisation moves, as columns."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.geometry import se3

F64 = NDArray[np.float64]

NODES_PER_VERTEX = 5
"""Nodes of three numbers each: position, orientation, velocity, gyroscope and accelerometer bias.

Eliminating nodes of 3 instead of blocks of 15 lets the ordering separate biases and velocities,
which see only their neighbours in time, from poses, which see all that share landmarks.
"""

POSITION, ORIENTATION, VELOCITY, GYRO_BIAS, ACCEL_BIAS = range(NODES_PER_VERTEX)


@dataclasses.dataclass(frozen=True, eq=False)
class States:
    """States of V vertices and L landmarks, everything in G."""

    T_G_I: F64  # (V, 7)
    v_G: F64  # (V, 3)
    gyro_bias: F64  # (V, 3)
    accel_bias: F64  # (V, 3)
    p_G: F64  # (L, 3)

    def moved(self, step: F64, p_G: F64) -> States:
        """Apply a step (V, 5, 3) by node and take new landmarks."""
        pose_step = step[:, [POSITION, ORIENTATION]].reshape(-1, 6)
        return States(
            se3.retract(self.T_G_I, pose_step),
            self.v_G + step[:, VELOCITY],
            self.gyro_bias + step[:, GYRO_BIAS],
            self.accel_bias + step[:, ACCEL_BIAS],
            p_G,
        )

    def size(self) -> float:
        """Return the norm of all values, for the relative size of a step."""
        parts = (self.T_G_I, self.v_G, self.gyro_bias, self.accel_bias, self.p_G)
        return float(np.sqrt(sum(np.sum(part * part) for part in parts)))
