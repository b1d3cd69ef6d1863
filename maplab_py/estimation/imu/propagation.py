"""Prediction: poses and velocities at every inertial sample, from the state at the edge's start."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from maplab_py.estimation.imu import kernels
from maplab_py.estimation.imu.inertial_data import InertialData
from maplab_py.geometry import se3, so3

F64 = NDArray[np.float64]


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
    edges, samples = len(data), len(data.timestamp_ns)
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
    kernels.propagate(
        data.sample_start,
        data.timestamp_ns,
        data.accel_gyro,
        np.array(np.broadcast_to(gyro_bias, (edges, 3)), dtype=np.float64),
        np.array(np.broadcast_to(accel_bias, (edges, 3)), dtype=np.float64),
        data.imu_of_edge,
        *data.corrections,
        np.asarray(gravity_M, dtype=np.float64),
        rotation,
        velocity,
        position,
    )
    return se3.make(so3.from_matrix(rotation), position), velocity
