"""The bias of the gyroscope from epipolar geometry: turns and images must agree.

For every pair of frames of a camera the rays of common tracks, turned by the gyroscope, and the direction of
translation lie in planes. Biases and directions minimise the distances of the rays to their planes;
scale, gravity and depths are not needed. Source: L. Kneip, S. Lynen, Direct Optimization of
Frame-to-Frame Rotation, ICCV 2013, with the bias in place of the rotation as in Y. He et al., A
Rotation-Translation-Decoupled Solution for Robust and Efficient Visual-Inertial Initialization, CVPR 2023.
"""

import dataclasses
from functools import cached_property

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.estimation.imu.inertial_data import InertialData
from maplab_py.estimation.imu.preintegration import integrate
from maplab_py.frontend.initialization import gyro_bias_kernels
from maplab_py.frontend.initialization.rays import SegmentRays, angular_velocity
from maplab_py.geometry import so3
from maplab_py.vimap.table import starts_of_counts

_STEPS_APART = (1, 2, 4)
"""Pairs of frames are so many frames apart."""
_MIN_TRACKS = 12
_ITERATIONS = 10
_CONVERGED_RADPS = 1e-6
_PRIOR_RADPS = 0.2
_PRIOR_DELAY_S = 0.05
_DELAY_ITERATIONS = 15
_CONVERGED_S = 2e-5
_SIGMA_FACTOR = 3.0
"""Standard deviations are so many times those of independent rays: pairs share frames and tracks."""


@dataclasses.dataclass(frozen=True, eq=False)
class Turns:
    """Attitudes of F frames in A, the IMU's frame at the first of them."""

    q_A_I: F64  # (F, 4)
    jacobian: F64  # (F, 3, 3) of a right perturbation of q_A_I by the gyroscope bias


def integrate_turns(inertial: InertialData, gyro_bias: F64) -> Turns:
    """Integrate the gyroscope over consecutive edges."""
    edges = integrate(inertial, gyro_bias, np.zeros(3))
    turns = Turns(so3.identity(len(inertial) + 1), np.zeros((len(inertial) + 1, 3, 3)))
    gyro_bias_kernels.accumulate_turns(
        edges.q_A_B, edges.jacobian_gyro_bias, turns.q_A_I, turns.jacobian
    )
    return turns


@dataclasses.dataclass(frozen=True, eq=False)
class RayPairs:
    """Rays (M, 3), in the IMU's frame, of the same tracks in pairs of frames."""

    first_frame: I64  # (P,)
    second_frame: I64  # (P,)
    pair: I64  # (M,) ascending
    first: F64  # (M, 3)
    second: F64  # (M, 3)
    sigma: F64  # (M,) [rad]

    @cached_property
    def start(self) -> I64:
        """Offsets (P + 1,) of the pairs."""
        counts = np.bincount(self.pair, minlength=len(self.first_frame))
        return np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)


def ray_pairs(rays: SegmentRays) -> RayPairs:
    """Pair the observations of the same track by the same camera in different frames."""
    frames, cameras = (int(column.max(initial=0)) + 1 for column in (rays.frame, rays.camera))
    # ascending, as rays are in the order of track, frame and camera
    key = (rays.track * frames + rays.frame) * cameras + rays.camera
    first, second, group = [], [], []
    for number, step in enumerate(_STEPS_APART):
        wanted = key + step * cameras
        partner = np.minimum(np.searchsorted(key, wanted), len(key) - 1)
        rows = np.flatnonzero((key[partner] == wanted) & (rays.frame + step < frames))
        first.append(rows)
        second.append(partner[rows])
        group.append((number * frames + rays.frame[rows].astype(np.int64)) * cameras)
        group[-1] += rays.camera[rows]
    i, j, of = (np.concatenate(columns) for columns in (first, second, group))
    rows = np.flatnonzero(np.bincount(of, minlength=1)[of] >= _MIN_TRACKS)
    rows = rows[np.argsort(of[rows], kind="stable")]
    groups, pair = np.unique(of[rows], return_inverse=True)
    i, j, first_frame = i[rows], j[rows], groups // cameras % frames
    return RayPairs(
        first_frame,
        first_frame + np.array(_STEPS_APART)[groups // (frames * cameras)],
        np.asarray(pair, dtype=np.int64).reshape(-1),
        rays.ray_I[i],
        rays.ray_I[j],
        np.hypot(rays.sigma[i], rays.sigma[j]),
    )


@dataclasses.dataclass(frozen=True, eq=False)
class TurnFit:
    """Unknowns with which turns and images agree best."""

    gyro_bias: F64  # (3,) [rad/s]
    delay_s: float  # images were taken so much after their times
    delay_sigma_s: float


def estimate_gyro_bias(inertial: InertialData, pairs: RayPairs) -> F64:
    """Return the bias (3,) [rad/s] with which turns and images agree best; zero without pairs.

    Gauss-Newton with Cauchy's loss; the directions are eliminated in every step.
    """
    bias = np.zeros(3)
    if not len(pairs.first_frame):
        return bias
    weight = np.ones(len(pairs.pair))
    for _ in range(_ITERATIONS):
        turns = integrate_turns(inertial, bias)
        step, weight, _ = gauss_newton_step(pairs, turns, weight, bias)
        bias = bias + step
        if np.abs(step).max() < _CONVERGED_RADPS:
            break
    return bias


def fit_turns(inertial: InertialData, pairs: RayPairs) -> TurnFit:
    """Estimate the bias of the gyroscope together with the delay of the images.

    A delay turns both frames of a pair by their angular velocities, so that the motion must change its
    angular velocity for it to be told from the bias; otherwise its standard deviation stays large.
    """
    unknowns, sigma = np.zeros(4), _PRIOR_DELAY_S
    if not len(pairs.first_frame):
        return TurnFit(unknowns[:3], 0.0, sigma)
    weight = np.ones(len(pairs.pair))
    for _ in range(_DELAY_ITERATIONS):
        moved = delayed(inertial, unknowns[3])
        turns = integrate_turns(moved, unknowns[:3])
        rate = angular_velocity(moved, unknowns[:3])
        step, weight, covariance = gauss_newton_step(pairs, turns, weight, unknowns, rate)
        unknowns = unknowns + step
        sigma = float(np.sqrt(covariance[3, 3]))
        if abs(step[3]) < _CONVERGED_S:
            break
    return TurnFit(unknowns[:3], float(unknowns[3]), _SIGMA_FACTOR * sigma)


def delayed(inertial: InertialData, delay_s: float) -> InertialData:
    """Return the samples of consecutive edges between frames that are all later by a delay.

    Before the first and after the last sample, the nearest of them counts.
    """
    times_ns, ends = inertial.timestamp_ns, inertial.sample_start[1:] - 1
    is_kept = np.diff(times_ns, prepend=times_ns[0] - 1) > 0  # edges repeat the sample between them
    known_ns, known = times_ns[is_kept], inertial.accel_gyro[is_kept]
    frames_ns = np.concatenate([times_ns[:1], times_ns[ends]]) + round(delay_s * 1e9)
    inside = (known_ns > frames_ns[0]) & (known_ns < frames_ns[-1])
    every_ns = np.union1d(known_ns[inside], frames_ns)
    values = np.stack([np.interp(every_ns, known_ns, column) for column in known.T], axis=1)
    at = np.searchsorted(every_ns, frames_ns)
    start = starts_of_counts(np.diff(at) + 1)
    rows = np.arange(start[-1]) - np.repeat(np.arange(len(at) - 1), np.diff(start))
    return dataclasses.replace(
        inertial, sample_start=start, timestamp_ns=every_ns[rows], accel_gyro=values[rows]
    )


def gauss_newton_step(
    pairs: RayPairs, turns: Turns, weight: F64, unknowns: F64, rate: F64 | None = None
) -> tuple[F64, F64, F64]:
    """Return the step of the unknowns, new weights (M,), and the unknowns' covariance.

    Args:
        pairs: Rays.
        turns: At the present unknowns.
        weight: Robust weights (M,).
        unknowns: Bias (3,), or bias and delay (4,).
        rate: Angular velocities (F, 3) of the frames, if the delay is an unknown.
    """
    i, j, count = pairs.first_frame, pairs.second_frame, len(pairs.first_frame)
    R_i_j = so3.to_matrix(so3.multiply(so3.inverse(turns.q_A_I[i]), turns.q_A_I[j]))
    R_j_i = np.swapaxes(R_i_j, 1, 2)
    # right perturbation of R_i_j by the bias
    slope = turns.jacobian[j] - R_j_i @ turns.jacobian[i]
    sigma = np.full(3, _PRIOR_RADPS)
    if rate is not None:
        by_delay = rate[j][:, :, None] - R_j_i @ rate[i][:, :, None]
        slope = np.ascontiguousarray(np.concatenate([slope, by_delay], axis=2))
        sigma = np.append(sigma, _PRIOR_DELAY_S)
    rays = gyro_bias_kernels.PairedRays(pairs.first, pairs.second, pairs.sigma, pairs.start)
    normal, scatter = np.empty_like(pairs.first), np.zeros((count, 3, 3))
    gyro_bias_kernels.add_scatter(rays, R_i_j, weight, normal, scatter)
    direction = np.linalg.eigh(scatter)[1]  # ascending: the first is that of translation
    weight, sums = np.empty_like(weight), gyro_bias_kernels.BiasSums.zeros(count, len(sigma))
    gyro_bias_kernels.add_equations(rays, R_i_j, slope, direction, normal, weight, sums)
    eliminated = sums.H_bt @ np.linalg.inv(sums.H_tt + 1e-9 * np.eye(2))
    H = sums.H_bb - np.einsum("pij,pkj->ik", eliminated, sums.H_bt)
    g = sums.g_b - np.einsum("pij,pj->i", eliminated, sums.g_t)
    H += np.diag(1.0 / sigma**2)
    g += unknowns / sigma**2
    return -np.linalg.solve(H, g), weight, np.linalg.inv(H)


def compile_kernels() -> None:
    """Compile the loops on two rays in a pair of frames."""
    rays = np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8]])
    first, second, pair = np.array([0]), np.array([1]), np.zeros(2, dtype=np.int64)
    pairs = RayPairs(first, second, pair, rays, rays[::-1].copy(), np.full(2, 1e-3))
    turns = Turns(so3.identity(2), np.zeros((2, 3, 3)))
    gyro_bias_kernels.accumulate_turns(
        turns.q_A_I[:1], np.zeros((1, 9, 3)), turns.q_A_I, turns.jacobian
    )
    gauss_newton_step(pairs, turns, np.ones(2), np.zeros(3))
