"""Prediction: poses and velocities at every inertial sample, from the state at the edge's start."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from maplab_py.array_types import F64
from maplab_py.estimation.imu.inertial_data import InertialData
from maplab_py.estimation.kernels import imu as kernels
from maplab_py.geometry import se3, so3


def propagate(
    data: InertialData,
    T_M_I: ArrayLike,
    v_M: ArrayLike,
    gyro_bias: ArrayLike,
    accel_bias: ArrayLike,
    gravity_M: ArrayLike,
) -> tuple[F64, F64]:
    """Integrate the samples of every edge from its first sample on, biases held constant.

    Args:
        data: Samples of E edges, N in all.
        T_M_I: Poses (E, 7) at the edges' first samples; any gravity-aligned frame will do for M.
        v_M: Velocities (E, 3) there [m/s].
        gyro_bias: (E, 3) or (3,) [rad/s].
        accel_bias: (E, 3) or (3,) [m/s^2].
        gravity_M: Acceleration of gravity (3,) in M, e.g. [0, 0, -9.81].

    Returns:
        Poses T_M_I (N, 7) and velocities (N, 3) at the samples.
    """
    samples = len(data.timestamp_ns)
    start = np.asarray(T_M_I, dtype=np.float64)
    full = np.diff(data.sample_start) > 0
    first = data.sample_start[:-1][full]
    rotation, velocity, position = (
        np.zeros((samples, 3, 3)),
        np.zeros((samples, 3)),
        np.zeros((samples, 3)),
    )
    rotation[first] = so3.to_matrix(start[full, :4])
    position[first] = start[full, 4:]
    velocity[first] = np.asarray(v_M, dtype=np.float64)[full]
    gravity = np.asarray(gravity_M, dtype=np.float64)
    edge_samples = data.with_biases(gyro_bias, accel_bias)
    kernels.propagate(edge_samples, gravity, rotation, velocity, position)
    return se3.make(so3.from_matrix(rotation), position), velocity
