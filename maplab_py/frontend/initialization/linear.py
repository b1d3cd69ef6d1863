"""Velocity, gravity and accelerometer bias from tracks and known turns, in closed form.

With attitudes known, the IMU makes the position of every frame linear in the first velocity, gravity and the
accelerometer's bias; a ray says that its point lies on a line through that position. Points are
eliminated, what remains are nine unknowns. It holds for a single camera as for a rig, whose
baselines only add knowledge of the scale.
Source: T.-C. Dong-Si, A. I. Mourikis, Estimator Initialization in Vision-Aided Inertial Navigation with
Unknown Camera-IMU Calibration, IROS 2012; A. Martinelli, Closed-Form Solution of Visual-Inertial
Structure from Motion, IJCV 106(2), 2014.
"""

import dataclasses

import numpy as np

from maplab_py.array_types import F64, Mask
from maplab_py.estimation.imu.inertial_data import InertialData
from maplab_py.estimation.imu.preintegration import integrate
from maplab_py.frontend.initialization.gyro_bias import Turns
from maplab_py.frontend.initialization.rays import SegmentRays
from maplab_py.geometry import so3

_ROUNDS = 5
_NEAREST_M, _FARTHEST_M = 0.2, 100.0
_MIN_PARALLAX_RAD = 0.01
_IMU_ERROR_FACTOR = 5.0
_NEWTON_STEPS = 10


@dataclasses.dataclass(frozen=True, eq=False)
class LinearMotion:
    """Motion of F frames in A, the IMU's frame at the first of them."""

    p_A: F64  # (F, 3)
    v_A: F64  # (F, 3)
    g_A: F64  # (3,) acceleration of gravity
    accel_bias: F64  # (3,)
    share_in_front: float  # of the points


@dataclasses.dataclass(frozen=True, eq=False)
class _Affine:
    """Vectors constant + slope [v, g, b_a], one of every frame."""

    constant: F64  # (F, 3)
    slope: F64  # (F, 3, 9)

    def at(self, unknowns: F64) -> F64:
        return np.asarray(self.constant + self.slope @ unknowns)


def solve_motion(
    inertial: InertialData,
    turns: Turns,
    gyro_bias: F64,
    rays: SegmentRays,
    accel_bias_sigma: float,
) -> LinearMotion | None:
    """Solve for the motion; None when too few tracks have parallax.

    Args:
        inertial: Samples of the edges between the frames.
        turns: Attitudes of the frames.
        gyro_bias: With which they were integrated.
        rays: Observations.
        accel_bias_sigma: Standard deviation of a component of the accelerometer's bias [m/s^2].
    """
    p, v = _trajectory(inertial, turns, gyro_bias)
    magnitude = inertial.imus[0].gravity_magnitude_mps2
    # over a second or more the mean acceleration is small against gravity
    mean_force = v.constant[-1] / np.linalg.norm(v.constant[-1])
    unknowns = np.concatenate([np.zeros(3), -magnitude * mean_force, np.zeros(3)])
    direction = so3.rotate(turns.q_A_I[rays.frame], rays.ray_I)
    lever = so3.rotate(turns.q_A_I[rays.frame], rays.p_I_C)
    rows = _with_parallax(rays, direction)
    if np.count_nonzero(rows) < 2 * 9:
        return None
    lines = _Lines(rays, direction, lever, p, rows)
    # the error of integrated samples is not in the noise of the rays, but moves them, too
    sigma = _IMU_ERROR_FACTOR * rays.sigma
    distance, weight = np.ones(len(rays.frame)), np.ones(len(rays.frame))
    prior = np.zeros((9, 9))
    prior[6:, 6:] = np.eye(3) / accel_bias_sigma**2
    for _ in range(_ROUNDS):
        points = lines.points(weight / (sigma * distance) ** 2)
        H, g = lines.normal_equations(points)
        unknowns = _with_gravity(H + prior, g, unknowns, magnitude)
        distance, off = lines.distances(unknowns, points)
        weight = 1.0 / (1.0 + (off / sigma) ** 2 / 9.0)
        in_front = float(np.mean(distance[rows] > 0.0))
        distance = np.clip(np.abs(distance), _NEAREST_M, _FARTHEST_M)
    return LinearMotion(p.at(unknowns), v.at(unknowns), unknowns[3:6], unknowns[6:], in_front)


def _trajectory(inertial: InertialData, turns: Turns, gyro_bias: F64) -> tuple[_Affine, _Affine]:
    """Return positions and velocities of the frames, affine in the unknowns."""
    edges = integrate(inertial, gyro_bias, np.zeros(3))
    R = so3.to_matrix(turns.q_A_I)
    frames, eye = len(R), np.eye(3)
    p, v = (_Affine(np.zeros((frames, 3)), np.zeros((frames, 3, 9))) for _ in range(2))
    v.slope[0, :, :3] = eye
    for e, dt in enumerate(edges.duration_s.tolist()):
        p.constant[e + 1] = p.constant[e] + dt * v.constant[e] + R[e] @ edges.dp[e]
        v.constant[e + 1] = v.constant[e] + R[e] @ edges.dv[e]
        p.slope[e + 1] = p.slope[e] + dt * v.slope[e]
        v.slope[e + 1] = v.slope[e]
        p.slope[e + 1, :, 3:6] += 0.5 * dt * dt * eye
        v.slope[e + 1, :, 3:6] += dt * eye
        p.slope[e + 1, :, 6:] += R[e] @ edges.jacobian_accel_bias[e, :3]
        v.slope[e + 1, :, 6:] += R[e] @ edges.jacobian_accel_bias[e, 6:]
    return p, v


def _with_parallax(rays: SegmentRays, direction: F64) -> Mask:
    """Tell which rays (N,) belong to tracks with parallax."""
    start = rays.start
    first = direction[start[:-1]][rays.track]
    chord = np.linalg.norm(direction - first, axis=1)
    widest = np.maximum.reduceat(chord, start[:-1]) if len(chord) else np.zeros(0)
    return np.asarray(widest[rays.track] >= _MIN_PARALLAX_RAD)


_Points = tuple[F64, F64, F64, F64, F64]
"""By track: A (T, 3, 3), sums of slopes (T, 3, 9) and of constants (T, 3); by ray: (N, 3, 9), (N, 3)."""


class _Lines:
    """Lines through the points of tracks: origins affine in the unknowns, directions known."""

    def __init__(
        self, rays: SegmentRays, direction: F64, lever: F64, p: _Affine, rows: Mask
    ) -> None:
        self._rows, self._count = np.flatnonzero(rows), len(rows)
        track = rays.track[rows]
        self._first = np.flatnonzero(np.diff(track, prepend=-1))
        self._of = np.cumsum(np.diff(track, prepend=-1) > 0) - 1
        self._direction = direction[rows]
        self._constant = p.constant[rays.frame[rows]] + lever[rows]
        self._slope = p.slope[rays.frame[rows]]
        self._projector = np.eye(3) - self._direction[:, :, None] * self._direction[:, None]

    def points(self, weight: F64) -> _Points:
        """Return the sums, weighted (N,), with which points are eliminated."""
        P = weight[self._rows, None, None] * self._projector
        A = np.add.reduceat(P, self._first, axis=0)
        A += 1e-9 * np.trace(A, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        PC, Pe = P @ self._slope, (P @ self._constant[:, :, None])[:, :, 0]
        sum_C = np.add.reduceat(PC, self._first, axis=0)
        sum_e = np.add.reduceat(Pe, self._first, axis=0)
        return A, sum_C, sum_e, PC, Pe

    def normal_equations(self, points: _Points) -> tuple[F64, F64]:
        """Return H (9, 9) and g (9,) of the cost y^T H y + 2 g^T y + constant, points eliminated."""
        A, sum_C, sum_e, PC, Pe = points
        X_C, X_e = np.linalg.solve(A, sum_C), np.linalg.solve(A, sum_e[:, :, None])[:, :, 0]
        # sums over all rays, then over all points, as products of tall matrices
        C, sums = self._slope.reshape(-1, 9).T, sum_C.reshape(-1, 9).T
        H = C @ PC.reshape(-1, 9) - sums @ X_C.reshape(-1, 9)
        g = C @ Pe.ravel() - sums @ X_e.ravel()
        return 0.5 * (H + H.T), g

    def distances(self, unknowns: F64, points: _Points) -> tuple[F64, F64]:
        """Return along every ray (N,) the distance of its point, and the angle off; 1 and 0 elsewhere."""
        A, sum_C, sum_e, _, _ = points
        point = np.linalg.solve(A, (sum_C @ unknowns + sum_e)[:, :, None])[:, :, 0]
        offset = point[self._of] - (self._constant + self._slope @ unknowns)
        along = np.sum(offset * self._direction, axis=1)
        beside = np.linalg.norm(offset - along[:, None] * self._direction, axis=1)
        distance, off = np.ones(self._count), np.zeros(self._count)
        distance[self._rows] = along
        off[self._rows] = beside / np.maximum(np.abs(along), _NEAREST_M)
        return distance, off


def _with_gravity(H: F64, g: F64, start: F64, magnitude: float) -> F64:
    """Minimise y^T H y + 2 g^T y where y[3:6] has a given length, from where y starts."""
    y = start.copy()
    for _ in range(_NEWTON_STEPS):
        axis = y[3:6] / np.linalg.norm(y[3:6])
        tangent = np.linalg.svd(axis[None])[2][1:].T  # (3, 2)
        basis = np.zeros((9, 8))
        basis[:3, :3], basis[6:, 5:] = np.eye(3), np.eye(3)
        basis[3:6, 3:5] = tangent
        reduced = basis.T @ H @ basis
        scale = 1.0 / np.sqrt(np.maximum(np.diagonal(reduced), 1e-300))
        right = scale * (basis.T @ (H @ y + g))
        step = -scale * np.linalg.lstsq(scale[:, None] * reduced * scale, right, rcond=1e-12)[0]
        y = y + basis @ step
        y[3:6] *= magnitude / np.linalg.norm(y[3:6])
        if np.abs(basis @ step).max() < 1e-9:
            break
    return y
