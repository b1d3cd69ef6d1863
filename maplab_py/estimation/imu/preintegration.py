"""Preintegration: the samples of an edge as one relative measurement between its vertices.

For an edge from body frame A at the earlier vertex to B at the later one, gravity g (its
acceleration, e.g. [0, 0, -9.81]) and any gravity-aligned frame G:

    R_G_B = R_G_A dR
    v_G_B = v_G_A + g dt + R_G_A dv
    p_G_B = p_G_A + v_G_A dt + g dt^2 / 2 + R_G_A dp

dR, dv, dp do not depend on the states of A, only on its biases, and that to first order by the
Jacobians given here: dR(b) = dR Exp(J_theta db), dv(b) = dv + J_v db, dp(b) = dp + J_p db.
Source: Forster et al., On-Manifold Preintegration, TRO 2017, eq. (33), (37), (44) and appendix A,
with the second-order integration of `kernels`.

ORDER of covariance rows and Jacobian rows: p, theta, v; theta is a right perturbation, rotation =
dR Exp(theta), as everywhere. Noise of all three is expressed in A (p, v) and in B (theta).
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import ArrayLike

from maplab_py.array_types import F64, I64
from maplab_py.estimation.imu.inertial_data import InertialData
from maplab_py.estimation.kernels import imu as kernels
from maplab_py.geometry import se3, so3
from maplab_py.sensors import Imu


@dataclasses.dataclass(frozen=True, eq=False)
class Preintegrated:
    """Relative inertial measurements of E edges (see the module for the equations)."""

    duration_s: F64  # (E,)
    q_A_B: F64  # (E, 4) dR
    dv: F64  # (E, 3) [m/s] in A
    dp: F64  # (E, 3) [m] in A
    covariance: F64  # (E, 9, 9) order p, theta, v; zero for edges of no duration
    jacobian_gyro_bias: F64  # (E, 9, 3) rows p, theta, v
    jacobian_accel_bias: F64  # (E, 9, 3)
    gyro_bias: F64  # (E, 3) linearisation point [rad/s]
    accel_bias: F64  # (E, 3) [m/s^2]
    gyro_walk_variance: F64  # (E,) variance of each component of the change of the bias
    accel_walk_variance: F64  # (E,)
    jacobian_intrinsics: F64 | None = None  # (E, 9, 15): T_g and T_a (diagonal, 01, 02, 12), R_A_I

    def updated(self, rows: I64, new: Preintegrated) -> Preintegrated:
        """Return the same with some edges (rows) replaced."""
        columns: dict[str, F64] = {}
        for field in dataclasses.fields(self):
            old_column, new_column = getattr(self, field.name), getattr(new, field.name)
            if old_column is not None:
                columns[field.name] = old_column.copy()
                columns[field.name][rows] = new_column
        return Preintegrated(**columns)


def integrate(
    data: InertialData, gyro_bias: F64, accel_bias: F64, *, with_intrinsics: bool = False
) -> Preintegrated:
    """Preintegrate all edges.

    White noise of density s counts as independent noise of variance s^2 / dt in the mean value of
    each interval; the bias walk as a variance of s_b^2 times the edge's duration.

    Args:
        data: Samples.
        gyro_bias: Linearisation points (E, 3) or (3,) [rad/s].
        accel_bias: Linearisation points (E, 3) or (3,) [m/s^2].
        with_intrinsics: Also differentiate by scale, misalignment and R_A_I (a right perturbation).
    """
    edges, width = len(data), 21 if with_intrinsics else 6
    samples = data.with_biases(gyro_bias, accel_bias)
    motion = kernels.EdgeMotion(
        np.zeros((edges, 3, 3)),
        np.zeros((edges, 3)),
        np.zeros((edges, 3)),
        np.zeros((edges, 9, 9)),
        np.zeros((edges, 9, width)),
    )
    kernels.preintegrate(samples, data.internal_rotation, data.noise_variance_density, motion)
    walk = data.walk_variance_density[data.imu_of_edge] * data.duration_s[:, None]
    return Preintegrated(
        duration_s=data.duration_s,
        q_A_B=so3.from_matrix(motion.R_A_B),
        dv=motion.dv,
        dp=motion.dp,
        covariance=motion.covariance,
        jacobian_gyro_bias=np.ascontiguousarray(motion.jacobian[:, :, :3]),
        jacobian_accel_bias=np.ascontiguousarray(motion.jacobian[:, :, 3:6]),
        gyro_bias=samples.gyro_bias,
        accel_bias=samples.accel_bias,
        gyro_walk_variance=walk[:, 0],
        accel_walk_variance=walk[:, 1],
        jacobian_intrinsics=motion.jacobian[:, :, 6:].copy() if with_intrinsics else None,
    )


def compile_kernels() -> None:
    """Compile the integration on one edge of three samples."""
    samples = np.tile([0.0, 0.0, 9.81, 0.0, 0.0, 0.1], (3, 1))
    data = InertialData.of_samples(Imu(id="0" * 32), [(5_000_000 * np.arange(3), samples)])
    for with_intrinsics in (False, True):
        integrate(data, np.zeros(3), np.zeros(3), with_intrinsics=with_intrinsics)


# Prediction: poses and velocities at every inertial sample, from the state at the edge's start.


def propagate(
    data: InertialData,
    T_M_I: ArrayLike,
    v_M: ArrayLike,
    gyro_bias: ArrayLike,
    accel_bias: ArrayLike,
    gravity_M: ArrayLike,
) -> tuple[F64, F64]:
    """Integrate the samples of every edge from its first sample on, with constant biases.

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
