"""The compiled loops over inertial samples.

One rule serves preintegration and prediction. Between two samples, dt apart, with corrected angular
velocities w and specific forces f:

    E = Exp((w_0 + w_1) / 2 dt),   R_1 = R_0 E
    a = (R_0 f_0 + R_1 f_1) / 2,     v_1 = v_0 + a dt
    b = (2 R_0 f_0 + R_1 f_1) / 3,   p_1 = p_0 + v_0 dt + b dt^2 / 2

which is exact where the acceleration changes evenly. It is of second order: half the step, a
quarter of the error. With a in place of b, positions would err by another jerk dt^2 / 12 per
second. (Forster et al., On-Manifold Preintegration, TRO 2017, eq. (31) holds w and f constant
instead, which is of first order.)
"""

from functools import partial
from typing import NamedTuple

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.compilation import compiled, prange
from maplab_py.estimation.codegen.straight_line import straight_line
from maplab_py.estimation.kernels import so3


class EdgeSamples(NamedTuple):
    """Samples of E edges by K IMUs, N in all, and the biases that are taken off."""

    start: I64  # (E + 1,) offsets
    timestamp_ns: I64  # (N,)
    accel_gyro: F64  # (N, 6) [ax ay az gx gy gz] as measured
    gyro_bias: F64  # (E, 3) [rad/s]
    accel_bias: F64  # (E, 3) [m/s^2]
    imu_of_edge: I64  # (E,)
    C_g: F64  # (K, 3, 3) T_g^-1
    C_a: F64  # (K, 3, 3) (T_a R_A_I)^-1


class EdgeMotion(NamedTuple):
    """Results of preintegration, zeros before."""

    R_A_B: F64  # (E, 3, 3)
    dv: F64  # (E, 3)
    dp: F64  # (E, 3)
    covariance: F64  # (E, 9, 9), order p, theta, v
    jacobian: F64  # (E, 9, 6) by the biases of gyroscope and accelerometer; or (E, 9, 21) with
    # those by the intrinsics after them (see `_add_intrinsics`)


class _Edge(NamedTuple):
    """One edge of `EdgeSamples`, with the corrections of its IMU."""

    stamps: I64
    samples: F64
    gyro_bias: F64
    accel_bias: F64
    C_g: F64
    C_a: F64


@compiled(forceinline=True)
def _edge(data: EdgeSamples, edge: int) -> _Edge:
    first, end, imu = data.start[edge], data.start[edge + 1], data.imu_of_edge[edge]
    return _Edge(
        data.timestamp_ns[first:end],
        data.accel_gyro[first:end],
        data.gyro_bias[edge],
        data.accel_bias[edge],
        data.C_g[imu],
        data.C_a[imu],
    )


@compiled(forceinline=True)
def _multiply(a: F64, b: F64, out: F64) -> None:
    """Compute out = a b for 3x3 matrices."""
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]


@compiled(forceinline=True)
def _rotation(phi: F64, E: F64, J: F64) -> None:
    """Compute E = Exp(phi) and the right Jacobian J of phi (Forster eq. (3) and (8))."""
    x, y, z = phi[0], phi[1], phi[2]
    angle2 = x * x + y * y + z * z
    if angle2 < 1e-8:  # Taylor, relative error < 1e-17
        sine = 1.0 - angle2 / 6.0  # sin(a) / a
        cosine = 0.5 - angle2 / 24.0  # (1 - cos(a)) / a^2
        cubic = 1.0 / 6.0 - angle2 / 120.0  # (a - sin(a)) / a^3
    else:
        angle = np.sqrt(angle2)
        sine = np.sin(angle) / angle
        cosine = (1.0 - np.cos(angle)) / angle2
        cubic = (1.0 - sine) / angle2
    for i in range(3):
        for j in range(3):
            square = phi[i] * phi[j]  # of skew(phi)^2 = phi phi^T - a^2 I
            E[i, j] = cosine * square
            J[i, j] = cubic * square
        E[i, i] += 1.0 - cosine * angle2
        J[i, i] += 1.0 - cubic * angle2
    _add_skew(E, x, y, z, sine)
    _add_skew(J, x, y, z, -cosine)


@compiled(forceinline=True)
def _add_skew(matrix: F64, x: float, y: float, z: float, factor: float) -> None:
    matrix[0, 1] -= factor * z
    matrix[0, 2] += factor * y
    matrix[1, 0] += factor * z
    matrix[1, 2] -= factor * x
    matrix[2, 0] -= factor * y
    matrix[2, 1] += factor * x


@compiled(forceinline=True)
def _times_skew(a: F64, v: F64, out: F64) -> None:
    """Compute out = a skew(v)."""
    for i in range(3):
        out[i, 0] = a[i, 1] * v[2] - a[i, 2] * v[1]
        out[i, 1] = a[i, 2] * v[0] - a[i, 0] * v[2]
        out[i, 2] = a[i, 0] * v[1] - a[i, 1] * v[0]


@compiled(forceinline=True)
def _correct(C_a: F64, samples: F64, row: int, bias: F64, force: F64) -> None:
    """Compute the specific force of a sample, C_a (measured - bias)."""
    for i in range(3):
        force[i] = 0.0
        for j in range(3):
            force[i] += C_a[i, j] * (samples[row, j] - bias[j])


@compiled(forceinline=True)
def _transpose(matrix: F64) -> None:
    for i in range(matrix.shape[0]):
        for j in range(i):
            matrix[i, j], matrix[j, i] = matrix[j, i], matrix[i, j]


@compiled(forceinline=True)
def _mean_rotation(C_g: F64, samples: F64, row: int, bias: F64, dt: float, phi: F64) -> None:
    """Compute the rotation vector phi of the mean angular velocity of two samples during dt."""
    for i in range(3):
        phi[i] = 0.0
        for j in range(3):
            mean = 0.5 * (samples[row, 3 + j] + samples[row + 1, 3 + j])
            phi[i] += dt * C_g[i, j] * (mean - bias[j])


@compiled(forceinline=True)
def _advance(R_0: F64, R_1: F64, f_0: F64, f_1: F64, dt: float, v: F64, p: F64) -> None:
    """Add the motion under an evenly changing acceleration R_0 f_0 .. R_1 f_1 to p and v."""
    for i in range(3):
        first, last = 0.0, 0.0
        for j in range(3):
            first += R_0[i, j] * f_0[j]
            last += R_1[i, j] * f_1[j]
        p[i] += dt * (v[i] + dt * (2.0 * first + last) / 6.0)
        v[i] += 0.5 * dt * (first + last)


@compiled(forceinline=True)
def _acceleration_derivatives(
    R_0: F64,
    R_1: F64,
    f_0: F64,
    f_1: F64,
    E: F64,
    J: F64,
    dt: float,
    by_theta: F64,
    by_gyro: F64,
    by_accel: F64,
) -> None:
    """Compute the derivatives (2, 3, 3) of the accelerations a and b, which move v and p.

    With w the weight of the second sample, 1/2 in a and 1/3 in b: by the orientation at the
    beginning, -(1 - w) R_0 [f_0]x - w R_1 [f_1]x E^T; by the mean angular velocity,
    -w R_1 [f_1]x J dt; by the mean specific force, (1 - w) R_0 + w R_1.
    """
    for k in range(2):
        w = 1.0 / (2.0 + k)
        _times_skew(R_0, f_0, by_theta[k])
        _times_skew(R_1, f_1, by_accel[k])  # only kept here until it is used
        _multiply(by_accel[k], J, by_gyro[k])
        for i in range(3):
            x, y, z = by_accel[k, i, 0], by_accel[k, i, 1], by_accel[k, i, 2]
            for j in range(3):
                turned = x * E[j, 0] + y * E[j, 1] + z * E[j, 2]
                by_theta[k, i, j] = -(1.0 - w) * by_theta[k, i, j] - w * turned
                by_gyro[k, i, j] *= -w * dt
                by_accel[k, i, j] = (1.0 - w) * R_0[i, j] + w * R_1[i, j]


def _transition(state: F64, E: F64, M: F64, dt: float) -> None:
    """Multiply the rows of state (9, n), ordered p, theta, v, by the error transition F.

    F = [[I, M_b dt^2 / 2, I dt], [0, E^T, 0], [0, M_a dt, I]]; after Forster, appendix A, with the
    accelerations a and b, whose derivatives by theta are M (2, 3, 3).
    """
    x = state[3]
    y = state[4]
    z = state[5]
    for i in range(3):
        a = M[0, i, 0] * x + M[0, i, 1] * y + M[0, i, 2] * z
        b = M[1, i, 0] * x + M[1, i, 1] * y + M[1, i, 2] * z
        state[i] = state[i] + dt * (state[6 + i] + 0.5 * dt * b)
        state[6 + i] = state[6 + i] + dt * a
    turned_x = E[0, 0] * x + E[1, 0] * y + E[2, 0] * z
    turned_y = E[0, 1] * x + E[1, 1] * y + E[2, 1] * z
    turned_z = E[0, 2] * x + E[1, 2] * y + E[2, 2] * z
    state[3] = turned_x
    state[4] = turned_y
    state[5] = turned_z


_move_covariance = straight_line(_transition, width=12, contracts=False)
_move_jacobian = straight_line(_transition, width=6, contracts=False)
_move_whole_jacobian = straight_line(_transition, width=21, contracts=False)


@compiled(forceinline=True)
def _noise_gain(by_accel: F64, by_theta: F64, correction: F64, dt: float, gain: F64) -> None:
    """Compute gain (3, 12): change of [p, theta, v] per unit of measured value during dt, and padding.

    Args:
        by_accel: Derivatives (2, 3, 3) of the accelerations a and b by the corrected value.
        by_theta: Derivative (3, 3) of the rotation vector per dt by the corrected value.
        correction: Corrected value = correction (measured - bias).
        dt: Interval [s].
        gain: Result.
    """
    for i in range(3):
        for j in range(3):
            a, b, theta = 0.0, 0.0, 0.0
            for k in range(3):
                a += by_accel[0, i, k] * correction[k, j]
                b += by_accel[1, i, k] * correction[k, j]
                theta += by_theta[i, k] * correction[k, j]
            gain[j, i] = 0.5 * dt * dt * b
            gain[j, 3 + i] = dt * theta
            gain[j, 6 + i] = dt * a


@partial(straight_line, width=12, contracts=False)
def _add_noise(covariance: F64, gain: F64, variance: float) -> None:
    """Compute covariance += variance gain^T gain; rows of 12, of which 9 are used."""
    p = gain[0]
    q = gain[1]
    r = gain[2]
    for i in range(9):
        covariance[i] = covariance[i] + variance * (
            gain[0, i] * p + gain[1, i] * q + gain[2, i] * r
        )


@compiled()
def _add_intrinsics(
    edge: _Edge,
    row: int,
    R_A_I: F64,
    ends: tuple[F64, F64, F64, F64],
    gyro_gain: F64,
    dt: float,
    D: F64,
) -> None:
    """Add one interval's effect of the intrinsics to the columns 6 to 20 of D (9, 21).

    Raising T_g[i, j] acts like a measured angular velocity that is lower by w_j in component i;
    raising T_a[i, j] likewise, with the force R_A_I f at both ends; and R_A_I Exp(phi) turns f by
    f x phi. Columns: T_g, then T_a, each by diagonal and 01, 02, 12; then phi. `ends` are rotation at
    both ends of the interval and specific force there.
    """
    R_0, R_1, f_0, f_1 = ends
    _, samples, gyro_bias, _, C_g, C_a = edge
    w, u_0, u_1 = np.zeros(3), np.zeros(3), np.zeros(3)
    A_0, A_1 = np.empty((3, 3)), np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            mean = 0.5 * (samples[row, 3 + j] + samples[row + 1, 3 + j])
            w[i] += C_g[i, j] * (mean - gyro_bias[j])
            u_0[i] += R_A_I[i, j] * f_0[j]
            u_1[i] += R_A_I[i, j] * f_1[j]
    _multiply(R_0, C_a, A_0)
    _multiply(R_1, C_a, A_1)
    for k in range(6):
        i = k if k < 3 else (0 if k < 5 else 1)
        j = k if k < 3 else (1 if k == 3 else 2)
        for n in range(9):
            D[n, 6 + k] -= gyro_gain[i, n] * w[j]
        for n in range(3):
            first, last = A_0[n, i] * u_0[j], A_1[n, i] * u_1[j]
            D[n, 12 + k] -= dt * dt * (2.0 * first + last) / 6.0
            D[6 + n, 12 + k] -= 0.5 * dt * (first + last)
    _times_skew(R_0, f_0, A_0)
    _times_skew(R_1, f_1, A_1)
    for n in range(3):
        for k in range(3):
            D[n, 18 + k] += dt * dt * (2.0 * A_0[n, k] + A_1[n, k]) / 6.0
            D[6 + n, 18 + k] += 0.5 * dt * (A_0[n, k] + A_1[n, k])


@compiled()
def _preintegrate_edge(
    edge: _Edge, R_A_I: F64, noise: F64, R: F64, v: F64, p: F64, P: F64, D: F64
) -> None:
    """Integrate one edge; see `preintegrate`. R, v, p, P, D are results, given as zeros."""
    stamps, samples, gyro_bias, accel_bias, C_g, C_a = edge
    E, J, next_R = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    by_theta, by_gyro, by_accel = np.empty((2, 3, 3)), np.empty((2, 3, 3)), np.empty((2, 3, 3))
    zero = np.zeros((3, 3))
    gyro_gain, accel_gain, S = np.zeros((3, 12)), np.zeros((3, 12)), np.zeros((9, 12))
    phi, f_0, f_1 = np.empty(3), np.empty(3), np.empty(3)
    for i in range(3):
        R[i, i] = 1.0
    for row in range(len(stamps) - 1):
        dt = (stamps[row + 1] - stamps[row]) * 1e-9
        if dt <= 0.0:
            continue
        _mean_rotation(C_g, samples, row, gyro_bias, dt, phi)
        _correct(C_a, samples, row, accel_bias, f_0)
        _correct(C_a, samples, row + 1, accel_bias, f_1)
        _rotation(phi, E, J)
        _multiply(R, E, next_R)
        _acceleration_derivatives(R, next_R, f_0, f_1, E, J, dt, by_theta, by_gyro, by_accel)
        _noise_gain(by_gyro, J, C_g, dt, gyro_gain)
        _noise_gain(by_accel, zero, C_a, dt, accel_gain)
        _move_covariance(S, E, by_theta, dt)  # F P
        _transpose(S)
        _move_covariance(S, E, by_theta, dt)  # F (F P)^T
        _add_noise(S, gyro_gain, noise[0] / dt)
        _add_noise(S, accel_gain, noise[1] / dt)
        if D.shape[1] > 6:
            _move_whole_jacobian(D, E, by_theta, dt)
        else:
            _move_jacobian(D, E, by_theta, dt)
        for i in range(9):
            for j in range(3):
                D[i, j] -= gyro_gain[j, i]
                D[i, 3 + j] -= accel_gain[j, i]
        if D.shape[1] > 6:
            _add_intrinsics(edge, row, R_A_I, (R, next_R, f_0, f_1), gyro_gain, dt, D)
        _advance(R, next_R, f_0, f_1, dt, v, p)
        for i in range(3):
            for j in range(3):
                R[i, j] = next_R[i, j]
    for i in range(9):
        for j in range(i):
            P[i, j] = 0.5 * (S[i, j] + S[j, i])
            P[j, i] = P[i, j]
        P[i, i] = S[i, i]


@compiled()
def _propagate_edge(edge: _Edge, gravity: F64, rotation: F64, velocity: F64, position: F64) -> None:
    """Predict the states at the samples of one edge from the first row; see `propagate`."""
    stamps, samples, gyro_bias, accel_bias, C_g, C_a = edge
    E, J = np.empty((3, 3)), np.empty((3, 3))
    phi, f_0, f_1 = np.empty(3), np.empty(3), np.empty(3)
    for row in range(len(stamps) - 1):
        dt = (stamps[row + 1] - stamps[row]) * 1e-9
        _mean_rotation(C_g, samples, row, gyro_bias, dt, phi)
        _correct(C_a, samples, row, accel_bias, f_0)
        _correct(C_a, samples, row + 1, accel_bias, f_1)
        _rotation(phi, E, J)
        _multiply(rotation[row], E, rotation[row + 1])
        v, p = velocity[row + 1], position[row + 1]
        for i in range(3):
            v[i] = velocity[row, i]
            p[i] = position[row, i]
        _advance(rotation[row], rotation[row + 1], f_0, f_1, dt, v, p)
        for i in range(3):
            p[i] += 0.5 * dt * dt * gravity[i]
            v[i] += dt * gravity[i]


# -- all edges: each is summed in order by one thread, so the thread count changes no bit ----------


@compiled(parallel=True)
def preintegrate(data: EdgeSamples, R_A_I: F64, noise: F64, result: EdgeMotion) -> None:
    """Integrate all edges.

    Args:
        data: Samples and linearisation points.
        R_A_I: Internal rotations (K, 3, 3).
        noise: Squared densities (K, 2) of gyroscope and accelerometer.
        result: Filled in.
    """
    for edge in prange(len(data.start) - 1):
        imu = data.imu_of_edge[edge]
        _preintegrate_edge(
            _edge(data, edge),
            R_A_I[imu],
            noise[imu],
            result.R_A_B[edge],
            result.dv[edge],
            result.dp[edge],
            result.covariance[edge],
            result.jacobian[edge],
        )


@compiled()
def integrate_for_residuals(data, R_A_I, noise, g_G, floor, arguments, covariance):  # type: ignore[no-untyped-def]
    """Integrate some edges, for residuals.

    Args:
        data: EdgeSamples.
        R_A_I: Internal rotations (K, 3, 3).
        noise: Squared densities (K, 2) of gyroscope and accelerometer.
        g_G: Gravity (3,).
        floor: (9, 9), added to covariances.
        arguments: Filled in (E, 74): see `terms.inertial.measured_arguments`.
        covariance: Filled in (E, 9, 9).
    """
    R, jacobian = np.empty((3, 3)), np.empty((9, 6))
    for edge in range(len(data.start) - 1):
        imu, x, P = data.imu_of_edge[edge], arguments[edge], covariance[edge]
        R[:], P[:], x[:], jacobian[:] = 0.0, 0.0, 0.0, 0.0
        _preintegrate_edge(
            _edge(data, edge), R_A_I[imu], noise[imu], R, x[7:10], x[4:7], P, jacobian
        )
        so3.from_matrix(R, x[:4])
        for column in range(6):
            for row in range(9):
                x[10 + 9 * column + row] = jacobian[row, column]
        x[64:67], x[67:70], x[71:74] = data.gyro_bias[edge], data.accel_bias[edge], g_G
        first, end = data.start[edge], data.start[edge + 1]
        if end > first:
            x[70] = (data.timestamp_ns[end - 1] - data.timestamp_ns[first]) * 1e-9
        for row in range(9):
            for column in range(9):
                P[row, column] += floor[row, column]


@compiled(parallel=True)
def propagate(data: EdgeSamples, gravity: F64, rotation: F64, velocity: F64, position: F64) -> None:
    """Predict the state at every sample from the one at the first sample of its edge.

    Args:
        data: Samples and biases.
        gravity: Acceleration (3,) [m/s^2] in the frame of the states.
        rotation: (N, 3, 3); the row of an edge's first sample is given, the others are results.
        velocity: (N, 3), likewise.
        position: (N, 3), likewise.
    """
    for edge in prange(len(data.start) - 1):
        first, end = data.start[edge], data.start[edge + 1]
        _propagate_edge(
            _edge(data, edge),
            gravity,
            rotation[first:end],
            velocity[first:end],
            position[first:end],
        )
