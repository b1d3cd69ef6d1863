"""The gyroscope against the images: first a linear map of the rates, then all unknowns together."""

import dataclasses
import itertools

import numpy as np

from maplab_py.algorithms.recording_check.turns import (
    GyroTurns,
    ImageTurns,
    RayPairs,
    epipolar,
    robust_weights,
)
from maplab_py.array_types import F64
from maplab_py.geometry import so3

_NEAR_S, _STEP_S = 0.6, 0.01
"""Delays are sought within, and in steps of; beyond, in steps that are larger."""
_FAR_STEP_S = 0.04
_AGREES = 0.5
"""Share of the images' turns that the gyroscope must explain for a delay to be believed."""
_LEAST_PAIRS, _MOST_PAIRS = 25, 300
_LINEAR_ROUNDS, _ROUNDS, _FIRST_ROUNDS = 4, 12, 5
_UNKNOWNS = 9
_LONGEST_STEP = np.array([0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.02, 0.1, 0.03])
_PRIOR = np.array([0.3, 0.3, 0.3, 0.05, 0.05, 0.05, 0.1, 0.05, 0.03])
"""Standard deviations of what is estimated, which only matter where the motion does not show it."""
_DIRECTION_DAMPING = 4.0
_HELD = 1e-6
TURN, SCALE = slice(0, 3), slice(7, 8)
"""Unknowns that can be held."""
_SIGMA_FACTOR = 3.0
"""Errors of neighbouring pairs are alike, and translation is not the only thing left out."""

SIGNED_AXES = tuple(
    np.array(signs)[:, None] * np.eye(3)[list(order)]
    for order in itertools.permutations(range(3))
    for signs in itertools.product((1.0, -1.0), repeat=3)
)
"""The 48 matrices (3, 3) that exchange axes and change their signs."""


@dataclasses.dataclass(frozen=True, eq=False)
class RateMap:
    """Linear map of the gyroscope's rates to those of the images, in the IMU's frame."""

    A: F64  # (3, 3) image = A gyroscope + c
    c: F64  # (3,) [rad/s]
    scatter: F64  # (3, 3) of the gyroscope's rates: what the map is known from
    delay_s: float  # images were taken so much after their stamps
    explained: float  # share of the variance of the images' turns


@dataclasses.dataclass(frozen=True, eq=False)
class HandEye:
    """Unknowns between camera and gyroscope, with standard deviations."""

    R_I_C: F64  # (3, 3)
    turn_sigma: F64  # (3,) [rad] of R_I_C, in the camera's frame
    gyro_bias: F64  # (3,) [rad/s]
    delay_s: float
    delay_sigma_s: float
    scale: float  # of the gyroscope: it measures so many times the turn
    scale_sigma: float
    readout_s: float  # from the first row of an image to its last
    readout_sigma_s: float
    error_px: float  # median distance to the epipolar planes


def fit_rates(turns: ImageTurns, rays: RayPairs, gyro: GyroTurns, R_I_C: F64) -> RateMap | None:
    """Find the linear map and the delay with which the gyroscope explains the images' turns best.

    Returns:
        None if there are too few pairs.
    """
    image = turns.phi @ R_I_C.T
    if len(image) < _LEAST_PAIRS:
        return None
    near = np.arange(-_NEAR_S, _NEAR_S + 1e-9, _STEP_S)
    shares = _explained(image, rays, gyro, near)
    delay_s, best = float(near[np.argmax(shares)]), float(shares.max())
    if best < _AGREES:
        span_s = float(rays.second_ns[-1] - rays.first_ns[0]) * 1e-9
        far = np.arange(-0.5 * span_s, 0.5 * span_s, _FAR_STEP_S)
        far_shares = _explained(image, rays, gyro, far)
        if far_shares.max() > best + 0.2:
            delay_s = float(far[np.argmax(far_shares)])
    return _linear(image, rays, gyro, delay_s)


def _explained(image: F64, rays: RayPairs, gyro: GyroTurns, delays_s: F64) -> F64:
    """Return the share of the images' turns that the gyroscope explains at each delay."""
    shares = np.zeros(len(delays_s))
    for row, delay_s in enumerate(delays_s.tolist()):
        fitted = _linear(image, rays, gyro, delay_s, rounds=2)
        shares[row] = fitted.explained if fitted is not None else 0.0
    return shares


def _linear(
    image: F64, rays: RayPairs, gyro: GyroTurns, delay_s: float, rounds: int = _LINEAR_ROUNDS
) -> RateMap | None:
    """Regress the images' turns (P, 3) on those of the gyroscope at a delay."""
    inside = gyro.covers(rays.first_ns, rays.second_ns, delay_s)
    if np.count_nonzero(inside) < max(_LEAST_PAIRS, len(image) // 3):
        return None
    dt = rays.duration_s[inside]
    phi = gyro.phi(rays.first_ns[inside], rays.second_ns[inside], delay_s)
    X = np.column_stack([phi, dt]) / dt[:, None]
    Y = image[inside] / dt[:, None]
    weight = np.ones(len(Y))
    solution: F64 = np.zeros((4, 3))
    for _ in range(rounds):
        W = weight[:, None]
        H = X.T @ (W * X) + 1e-9 * np.eye(4)
        solution = np.asarray(np.linalg.solve(H, X.T @ (W * Y)), dtype=np.float64)
        off = np.linalg.norm(Y - X @ solution, axis=1)
        usual = max(1.4826 * float(np.median(off)), 1e-4)
        weight = np.minimum(1.0, usual / np.maximum(off, 1e-12)) ** 2
    W = weight[:, None]
    left = float(np.sum(W * (Y - X @ solution) ** 2))
    mean = np.sum(W * Y, axis=0) / max(float(weight.sum()), 1e-12)
    total = float(np.sum(W * (Y - mean) ** 2))
    off = X[:, :3] - np.sum(W * X[:, :3], axis=0) / max(float(weight.sum()), 1e-12)
    explained = 1.0 - left / max(total, 1e-12)
    return RateMap(solution[:3].T, solution[3], off.T @ (W * off), delay_s, explained)


def fit_hand_eye(
    rays: RayPairs,
    gyro: GyroTurns,
    R_I_C: F64,
    bias: F64,
    delay_s: float,
    *,
    held: slice | None = None,
) -> HandEye | None:
    """Estimate all unknowns together from the rays; Gauss-Newton from given values.

    Directions of translation are eliminated in every step. Unknowns: turn of the camera (right perturbation
    of R_I_C), bias, delay, log of the gyroscope's scale, readout. A wrong focal length looks like a wrong
    scale. Those that are held stay as they are given, the scale at 1.

    Returns:
        None if there are too few pairs.
    """
    is_used = gyro.covers(rays.first_ns, rays.second_ns, delay_s)
    if np.count_nonzero(is_used) < _LEAST_PAIRS:
        return None
    rays = rays.take(np.flatnonzero(is_used)[:: 1 + np.count_nonzero(is_used) // _MOST_PAIRS])
    x = np.zeros(_UNKNOWNS)
    x[3:6], x[6] = bias, delay_s
    prior, prior_sigma = x.copy(), _PRIOR.copy()
    if held is not None:
        prior_sigma[held] = _HELD
    R, weight = R_I_C, rays.is_point.astype(np.float64)
    H = np.eye(_UNKNOWNS)
    variance, error_px = 1.0, np.inf
    for number in range(_ROUNDS):
        sigma = prior_sigma.copy()
        if number < _FIRST_ROUNDS:  # first turn and bias alone: together they reach farther
            sigma[6:] = np.minimum(sigma[6:], _HELD)
        residual, J, weight = _linearise(rays, gyro, R, x, weight)
        size = np.where(rays.is_point, np.abs(residual), np.nan)
        error_px = float(np.nanmedian(size))
        variance = max((1.4826 * error_px) ** 2, 1e-4)
        H, g = _eliminated(residual, J, weight / variance, variance)
        off = x - prior
        off[:3] = so3.log(so3.from_matrix(R_I_C.T @ R))
        H += np.diag(1.0 / sigma**2)
        step = -np.linalg.solve(H, g + off / sigma**2)
        step /= max(1.0, float(np.max(np.abs(step) / _LONGEST_STEP)))
        R = R @ so3.to_matrix(so3.exp(step[:3]))
        x[3:] += step[3:]
    sigma = _SIGMA_FACTOR * np.sqrt(np.diagonal(np.linalg.inv(H)))
    return HandEye(
        R,
        sigma[:3],
        x[3:6],
        float(x[6]),
        float(sigma[6]),
        float(np.exp(x[7])),
        float(sigma[7]),
        float(x[8]),
        float(sigma[8]),
        error_px,
    )


def _linearise(
    rays: RayPairs, gyro: GyroTurns, R_I_C: F64, x: F64, weight: F64
) -> tuple[F64, F64, F64]:
    """Return residuals (P, K), Jacobian (P, K, 11) with two columns of the direction, and weights."""
    bias, delay_s, log_scale, readout_s = x[3:6], x[6], x[7], x[8]
    dt = rays.duration_s
    inverse = np.exp(-log_scale)
    phi_I = inverse * gyro.phi(rays.first_ns, rays.second_ns, delay_s) - bias * dt[:, None]
    rate_1, rate_2 = (
        (inverse * gyro.rate_at(t, delay_s) - bias) @ R_I_C for t in (rays.first_ns, rays.second_ns)
    )
    phi = phi_I @ R_I_C  # in the camera's frame
    R_1_2 = so3.to_matrix(so3.exp(phi))
    first, second = rays.ray[:, :, 0], rays.ray[:, :, 1]
    by_row_1 = np.cross(rate_1[:, None], first) * rays.row_share[..., :1]
    by_row_2 = np.cross(rate_2[:, None], second) * rays.row_share[..., 1:]
    first, second = first + readout_s * by_row_1, second + readout_s * by_row_2
    first /= np.linalg.norm(first, axis=2, keepdims=True)
    second /= np.linalg.norm(second, axis=2, keepdims=True)
    at = epipolar(rays, first, second, R_1_2, weight)
    # phi changes by phi x d with a right perturbation d of R_I_C; the turn's own curvature is neglected
    turn_by = np.concatenate(
        [
            so3.skew(phi),
            -dt[:, None, None] * R_I_C.T,
            (rate_2 - rate_1)[..., None],
            -(inverse * gyro.phi(rays.first_ns, rays.second_ns, delay_s) @ R_I_C)[..., None],
        ],
        axis=2,
    )  # (P, 3, 8)
    by_row = np.einsum("pki,pki->pk", at.by_first, by_row_1)
    by_row += np.einsum("pki,pki->pk", at.by_second, by_row_2)
    J = np.concatenate([at.by_turn @ turn_by, by_row[..., None], at.by_direction], axis=2)
    return at.residual_px, J, robust_weights(at.residual_px, rays.is_point, by_row=False)


def _eliminated(residual: F64, J: F64, weight: F64, variance: float) -> tuple[F64, F64]:
    """Return the normal equations of the common unknowns, without those of each pair's direction."""
    JtW = (weight[..., None] * J).swapaxes(1, 2)
    H, g = JtW @ J, (JtW @ residual[..., None])[..., 0]
    # without parallax, noise alone makes the direction look as if it could explain everything
    noise = variance * weight.sum(axis=1)
    of_direction = H[:, _UNKNOWNS:, _UNKNOWNS:] + _DIRECTION_DAMPING * noise[
        :, None, None
    ] * np.eye(2)
    gain = H[:, :_UNKNOWNS, _UNKNOWNS:] @ np.linalg.inv(of_direction)
    common = H[:, :_UNKNOWNS, :_UNKNOWNS] - gain @ H[:, _UNKNOWNS:, :_UNKNOWNS]
    direction_g = (gain @ g[:, _UNKNOWNS:, None])[..., 0]
    return common.sum(axis=0), (g[:, :_UNKNOWNS] - direction_g).sum(axis=0)
