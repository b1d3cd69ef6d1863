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
from numpy.typing import NDArray

from maplab_py.estimation.imu import kernels
from maplab_py.estimation.imu.inertial_data import InertialData
from maplab_py.geometry import so3

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


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
    edges = len(data)
    b_g = np.array(np.broadcast_to(gyro_bias, (edges, 3)), dtype=np.float64)
    b_a = np.array(np.broadcast_to(accel_bias, (edges, 3)), dtype=np.float64)
    rotation, dv, dp = np.zeros((edges, 3, 3)), np.zeros((edges, 3)), np.zeros((edges, 3))
    covariance, bias_jacobian = (
        np.zeros((edges, 9, 9)),
        np.zeros((edges, 9, 21 if with_intrinsics else 6)),
    )
    kernels.preintegrate(
        data.sample_start,
        data.timestamp_ns,
        data.accel_gyro,
        b_g,
        b_a,
        data.imu_of_edge,
        *data.corrections,
        data.internal_rotation,
        data.noise_variance_density,
        rotation,
        dv,
        dp,
        covariance,
        bias_jacobian,
    )
    walk = data.walk_variance_density[data.imu_of_edge] * data.duration_s[:, None]
    return Preintegrated(
        duration_s=data.duration_s,
        q_A_B=so3.from_matrix(rotation),
        dv=dv,
        dp=dp,
        covariance=covariance,
        jacobian_gyro_bias=np.ascontiguousarray(bias_jacobian[:, :, :3]),
        jacobian_accel_bias=np.ascontiguousarray(bias_jacobian[:, :, 3:6]),
        gyro_bias=b_g,
        accel_bias=b_a,
        gyro_walk_variance=walk[:, 0],
        accel_walk_variance=walk[:, 1],
        jacobian_intrinsics=bias_jacobian[:, :, 6:].copy() if with_intrinsics else None,
    )
