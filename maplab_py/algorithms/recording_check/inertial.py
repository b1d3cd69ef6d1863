"""The IMU by itself: magnitudes, noise, and whether accelerometer and gyroscope have the same axes."""

import dataclasses

import numpy as np

from maplab_py.algorithms.recording_check.hand_eye import SIGNED_AXES
from maplab_py.algorithms.recording_check.turns import GyroTurns, ImageTurns, RayPairs
from maplab_py.array_types import F64, I64
from maplab_py.geometry import so3

_STRETCH_S = 1.0
_QUIET_SHARE = 0.1
_AVERAGED = (1, 2, 4, 8, 16)
"""Samples that are averaged for the Allan deviation."""
_REST_ACCEL, _REST_GYRO = 0.15, 0.02
"""Deviations within a second of a device at rest [m/s^2, rad/s]."""
_GRID_S, _GRAVITY_S = 0.2, 5.0
"""Times over which accelerations are averaged, and over which gravity is followed."""
_ALIKE = 1.1
_WINDOW_S = 2.0
_LEAST_PARALLAX_PX = 3.0
_GRAVITY_SIGMA, _AROUND_S = 0.15, 8.0
_LEAST_IN_WINDOW, _LEAST_WINDOWS, _LEAST_SPEED = 8, 4, 0.02


@dataclasses.dataclass(frozen=True, eq=False)
class QuietImu:
    """Figures of the quietest seconds of an IMU."""

    accel_norm: float  # [unit of the recording]
    mean_norm: float  # of all samples
    is_at_rest: bool  # some second is as quiet as only a device at rest is
    accel_density: float  # Allan deviation, as white noise [unit / sqrt(Hz)]
    gyro_density: float


def quiet_figures(times_ns: I64, accel_gyro: F64) -> QuietImu | None:
    """Return the figures of the quietest tenth of all seconds; None for less than a second.

    Magnitudes are of the unit of the recording; rest is judged by shares of the mean acceleration.
    """
    seconds = ((times_ns - times_ns[0]) // round(_STRETCH_S * 1e9)).astype(np.int64)
    starts = np.flatnonzero(np.diff(seconds, prepend=-1))
    counts = np.diff(np.append(starts, len(seconds)))
    usual = int(np.median(counts))
    starts = starts[counts >= max(0.8 * usual, 8)]
    if not len(starts) or usual < 8:
        return None
    size = min(usual, int(counts[counts >= max(0.8 * usual, 8)].min()))
    stretch = accel_gyro[starts[:, None] + np.arange(size)]  # (S, size, 6)
    deviation = stretch.std(axis=1)
    accel, gyro = (np.linalg.norm(deviation[:, part], axis=1) for part in (slice(3), slice(3, 6)))
    quiet = _quietest(accel / max(np.median(accel), 1e-12) + gyro / max(np.median(gyro), 1e-12))
    density = allan_densities(stretch, _STRETCH_S / size)
    mean = float(np.median(np.linalg.norm(accel_gyro[:, :3], axis=1)))
    unit = 9.81 / max(mean, 1e-9)
    at_rest = accel[quiet] * unit < _REST_ACCEL
    return QuietImu(
        float(np.median(np.linalg.norm(stretch[quiet, :, :3].mean(axis=1), axis=1))),
        mean,
        bool(np.any(at_rest & (gyro[quiet] < _REST_GYRO))),
        float(np.median(density[_quietest(density[:, 0]), 0])),
        float(np.median(density[_quietest(density[:, 1]), 1])),
    )


def allan_densities(stretch: F64, interval_s: float) -> F64:
    """Return noise densities (S, 2) of accelerometer and gyroscope in stretches (S, N, 6) of samples.

    White noise of density q has the Allan deviation q / sqrt(tau) (IEEE Std 952-1997). Vibrations add to
    that of short times and motion to that of long ones: the smallest of all counts.
    """
    densities = []
    for averaged in _AVERAGED:
        usable = stretch.shape[1] // averaged * averaged
        parts = stretch[:, :usable].reshape(len(stretch), -1, averaged, 6)
        step = np.diff(parts.mean(axis=2), axis=1)
        variance = 0.5 * np.mean(step**2, axis=1) * interval_s * averaged  # (S, 6)
        axes = (variance[:, :3].mean(axis=1), variance[:, 3:].mean(axis=1))
        densities.append(np.sqrt(np.stack(axes, axis=1)))
    return np.asarray(np.min(densities, axis=0))


def _quietest(noise: F64) -> I64:
    count = max(1, round(_QUIET_SHARE * len(noise)))
    return np.asarray(np.argsort(noise, kind="stable")[:count], dtype=np.int64)


@dataclasses.dataclass(frozen=True, eq=False)
class AxesFit:
    """Agreement of accelerometer and gyroscope about where gravity points."""

    B: F64  # (3, 3) signed axes of the accelerometer with which they agree best; B and -B agree alike
    spread: float  # of gravity's direction over some seconds [rad]
    as_is: float  # with the axes as recorded


def fit_accel_axes(times_ns: I64, accel: F64, gyro: GyroTurns) -> AxesFit | None:
    """Turn the accelerations of some seconds into one frame: there gravity must stay where it is.

    Returns:
        None if the recording is too short.
    """
    grid = np.arange(times_ns[0], times_ns[-1], round(_GRID_S * 1e9))
    count = round(_GRAVITY_S / _GRID_S)
    rows = np.searchsorted(times_ns, grid)
    if len(rows) < 2 * count:
        return None
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(accel, axis=0)])
    mean = (total[rows[1:]] - total[rows[:-1]]) / np.maximum(np.diff(rows), 1)[:, None]
    middle = (grid[:-1] + grid[1:]) // 2
    starts = np.arange(0, len(mean) - count + 1, count // 4)
    q = _chain(so3.exp(gyro.phi(middle[:-1], middle[1:])))
    inside = starts[:, None] + np.arange(count)
    R = so3.to_matrix(so3.multiply(so3.inverse(q[starts])[:, None], q[inside]))  # (W, count, 3, 3)
    spreads = []
    for B in SIGNED_AXES:
        a = np.einsum("wnij,wnj->wni", R, mean[inside] @ B.T)
        off = np.linalg.norm(a - a.mean(axis=1, keepdims=True), axis=2)
        usual = np.maximum(np.linalg.norm(a, axis=2).mean(axis=1), 1e-9)
        spreads.append(float(np.median(np.sqrt(np.mean(off**2, axis=1)) / usual)))
    as_is = next(i for i, B in enumerate(SIGNED_AXES) if np.array_equal(B, np.eye(3)))
    least = min(spreads)
    # axes across gravity make no difference: of those that agree alike, the least changed ones
    alike = [i for i, spread in enumerate(spreads) if spread <= _ALIKE * least]
    best = max(alike, key=lambda i: (np.trace(SIGNED_AXES[i]), -i))
    return AxesFit(SIGNED_AXES[best], spreads[best], spreads[as_is])


def _chain(q: F64) -> F64:
    """Return the products (N + 1, 4) of turns (N, 4), from the identity on."""
    product = np.concatenate([so3.identity(1), q])
    step = 1
    while step < len(product):  # products of twice as many, all at once
        product[step:] = so3.multiply(product[:-step], product[step:])
        step *= 2
    return so3.normalize(product)


@dataclasses.dataclass(frozen=True)
class AccelSign:
    """Agreement of accelerations with the motion that the images show, up to scale."""

    score: float  # from -1, the accelerometer has the opposite sign, to 1
    sigma: float


def fit_accel_sign(
    turns: ImageTurns,
    rays: RayPairs,
    gyro: GyroTurns,
    accel: F64,
    times_ns: I64,
    T: tuple[F64, F64],
) -> AccelSign | None:
    """Solve for the speeds along the images' directions of motion: they must be positive.

    In windows of two seconds s_k R_k t_k - s_j R_j t_j = integral of R a + g dt, linear in speeds s and g.

    Args:
        turns: Directions t of the camera's translation.
        rays: Times of the pairs.
        gyro: Corrected rates.
        accel: Samples (N, 3) [m/s^2].
        times_ns: Their times (N,).
        T: R_I_C (3, 3) and p_I_C (3,).

    Returns:
        None if no window shows enough motion.
    """
    R_I_C, p_I_C = T
    is_seen = turns.parallax_rad * rays.focal_px > _LEAST_PARALLAX_PX
    middle_ns = (rays.first_ns + rays.second_ns) // 2
    q = _chain(so3.exp(gyro.phi(times_ns[:-1], times_ns[1:])))
    a_W = so3.rotate(q, accel)
    sums = np.concatenate([np.zeros((1, 3)), np.cumsum(a_W, axis=0)])
    at = np.clip(np.searchsorted(times_ns, middle_ns), 0, len(times_ns) - 1)
    direction = so3.rotate(q[at], turns.t @ R_I_C.T)
    lever = so3.rotate(q[at], np.cross(gyro.rate_at(middle_ns), p_I_C))
    seconds = (times_ns - times_ns[0]) * 1e-9
    step = np.diff(seconds, append=seconds[-1])[:, None]
    gain = np.cumsum(a_W * step, axis=0)
    scores, weights = [], []
    for begin_s in np.arange(0.0, seconds[-1], _WINDOW_S):
        rows = np.flatnonzero(
            is_seen & (seconds[at] >= begin_s) & (seconds[at] < begin_s + _WINDOW_S)
        )
        if len(rows) < _LEAST_IN_WINDOW:
            continue
        # velocities are bounded: over a long time accelerations are gravity's
        near = np.searchsorted(seconds, [begin_s - _AROUND_S, begin_s + _WINDOW_S + _AROUND_S])
        g = (sums[near[1]] - sums[near[0]]) / max(int(near[1] - near[0]), 1)
        since = seconds[at[rows]] - begin_s
        dv = gain[at[rows]] - since[:, None] * g + lever[rows]
        speed = _speeds(direction[rows], since, dv)
        size = float(np.abs(speed).mean())
        if size > _LEAST_SPEED:
            scores.append(float(speed.sum() / np.abs(speed).sum()))
            weights.append(min(size, 1.0))
    if len(scores) < _LEAST_WINDOWS:
        return None
    score, weight = np.array(scores), np.array(weights)
    mean = float(np.sum(weight * score) / np.sum(weight))
    spread = np.sqrt(np.sum(weight**2 * (score - mean) ** 2)) / np.sum(weight)
    return AccelSign(mean, max(float(spread), 0.05))


def _speeds(direction: F64, since_s: F64, dv: F64) -> F64:
    """Return the speeds (N,) along directions (N, 3) that changes of the velocity (N, 3) say.

    Unknown beside them are the velocity at the beginning and a small deviation of gravity.
    """
    n = len(direction)
    A = np.zeros((n, 3, n + 6))
    A[np.arange(n), :, np.arange(n)] = direction
    A[:, :, n : n + 3] = -np.eye(3)
    A[:, :, n + 3 :] = since_s[:, None, None] * np.eye(3)
    size = np.concatenate([np.full(n + 3, 1e-3), np.full(3, 0.1 / _GRAVITY_SIGMA)])
    stacked = np.concatenate([A.reshape(3 * n, -1), np.diag(size)])
    right = np.concatenate([dv.ravel(), np.zeros(n + 6)])
    return np.asarray(np.linalg.lstsq(stacked, right, rcond=None)[0][:n])
