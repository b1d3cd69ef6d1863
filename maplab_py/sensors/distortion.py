"""Lens distortion on the z = 1 plane, and undistortion.

All radial models are written x_d = s(r) x with r = |x|, where s is smooth at r = 0.
"""

import functools

import numpy as np

from maplab_py.array_types import F64, Mask
from maplab_py.sensors.camera import Distortion

_SMALL_RADIUS = 1e-3
"""Below this radius series replace quotients by r with an error below 1e-12."""
_SMALL_FOV_RAD = 1e-4
"""Below this field-of-view parameter the FOV model is replaced by its series in w."""
_MAX_ITERATIONS = 50
_CONVERGED = 1e-12
"""Largest change of an undistorted point in the last Newton step."""
_BLOCK = 4096
"""Points that are undistorted together."""


def distort(kind: Distortion, parameters: F64, x: F64) -> F64:
    """Distort points (..., 2) of the z = 1 plane."""
    if kind is Distortion.NONE:
        return x
    if kind is Distortion.EQUIDISTANT:
        return _equidistant(parameters, x)
    if kind is Distortion.FOV:
        return _fov(parameters, x)
    return _brown(parameters, x)


def undistort(kind: Distortion, parameters: F64, x_d: F64) -> tuple[F64, Mask]:
    """Return undistorted points (..., 2) and whether they are valid (...,).

    Points beyond the image of the model (for Brown's models and equidistant: beyond the radius
    up to which the distortion grows) are invalid; their value is finite but has no meaning.
    """
    if kind is Distortion.NONE:
        return x_d, np.ones(x_d.shape[:-1], dtype=np.bool_)
    if kind is Distortion.FOV:
        return _undistort_fov(parameters, x_d)
    if kind is Distortion.EQUIDISTANT:
        return _undistort_equidistant(parameters, x_d)
    return _undistort_brown(parameters, x_d)


def largest_radius(kind: Distortion, parameters: F64) -> float:
    """Return the radius on the z = 1 plane up to which the distorted radius grows.

    Beyond this radius the polynomial models are not injective.
    """
    if kind in (Distortion.RADTAN, Distortion.RADTAN5, Distortion.RATIONAL):
        return _largest_brown_radius(tuple(float(k) for k in parameters))
    if kind is Distortion.EQUIDISTANT:
        theta = _largest_theta(parameters)
        return float(np.tan(theta)) if theta < 0.5 * np.pi else float(np.inf)
    return float(np.inf)


def _largest_brown_radius(k: tuple[float, ...]) -> float:
    """Return where r N / D, N and D polynomials of t = r^2, stops growing or has a pole."""
    k1, k2, _, _, *more = k
    radial = [k1, k2, *more[:1]]
    slope = (1.0, *((2 * i + 3) * value for i, value in enumerate(radial)))
    if len(more) < 2:
        return float(np.sqrt(_first_root(slope)))
    below = np.array([1.0, *more[1:]])
    product = np.polynomial.polynomial.polymul
    falling = 2.0 * product(
        [1.0, *radial], np.concatenate([[0.0], np.polynomial.polynomial.polyder(below)])
    )
    rising = product(slope, below)
    first = _first_root(tuple((rising - falling).tolist())), _first_root(tuple(below.tolist()))
    return float(np.sqrt(min(first)))


def _largest_theta(k: F64) -> float:
    return float(np.sqrt(_first_root((1.0, 3 * k[0], 5 * k[1], 7 * k[2], 9 * k[3]))))


@functools.lru_cache(maxsize=256)  # a camera asks for the same root at each projection
def _first_root(ascending: tuple[float, ...]) -> float:
    """Return the smallest positive real root of a polynomial, infinity when there is none."""
    roots = np.polynomial.polynomial.polyroots(np.trim_zeros(np.array(ascending), "b"))
    real = roots.real[np.abs(roots.imag) <= 1e-12 * np.maximum(np.abs(roots.real), 1e-300)]
    positive = real[real > 0.0]
    return float(positive.min()) if len(positive) else float(np.inf)


def _radial_factor(k: tuple[float, ...], r2: F64) -> tuple[F64, F64, F64 | float]:
    """Return Brown's s, 2 ds/dr^2, and the denominator of s; parameters as `_brown` has them."""
    k1, k2 = k[:2]
    if len(k) == 4:
        return 1.0 + r2 * (k1 + k2 * r2), 2.0 * k1 + 4.0 * k2 * r2, 1.0
    above = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k[4]))
    slope = 2.0 * k1 + r2 * (4.0 * k2 + 6.0 * k[4] * r2)
    if len(k) == 5:
        return above, slope, 1.0
    k4, k5, k6 = k[5:]
    below = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
    s = above / below
    return s, (slope - s * (2.0 * k4 + r2 * (4.0 * k5 + 6.0 * k6 * r2))) / below, below


def _brown(parameters: F64, x: F64) -> F64:
    """Brown's model, k1 k2 p1 p2 and perhaps k3 or k3 k4 k5 k6, as OpenCV orders them."""
    k = tuple(float(value) for value in parameters)
    p1, p2 = k[2:4]
    u, v = x[..., 0], x[..., 1]
    r2, uv = u * u + v * v, u * v
    along_u = 2.0 * p1 * uv + p2 * (r2 + 2.0 * u * u)
    tangential = np.stack([along_u, p1 * (r2 + 2.0 * v * v) + 2.0 * p2 * uv], axis=-1)
    return np.asarray(_radial_factor(k, r2)[0][..., None] * x + tangential)


def _equidistant(parameters: F64, x: F64) -> F64:
    """Kannala and Brandt, PAMI 2006: r_d = theta (1 + k1 theta^2 + ... + k4 theta^8)."""
    k = parameters
    r = np.linalg.norm(x, axis=-1)
    small = r < _SMALL_RADIUS
    safe = np.where(small, 1.0, r)
    theta = np.arctan(r)
    ratio = np.where(small, 1.0 - r**2 / 3.0 + r**4 / 5.0, theta / safe)
    powers = theta[..., None] ** np.array([2, 4, 6, 8])
    return np.asarray((ratio * (1.0 + powers @ k))[..., None] * x)


def _fov(parameters: F64, x: F64) -> F64:
    """Devernay and Faugeras, MVA 2001: r_d = atan(2 r tan(w/2)) / w, as maplab's fisheye."""
    w = float(parameters[0])
    r = np.linalg.norm(x, axis=-1)
    if abs(w) < _SMALL_FOV_RAD:
        # r_d = r (1 + w^2 (1/12 - r^2/3)) + O(w^4)
        return np.asarray((1.0 + w**2 * (1.0 / 12.0 - r**2 / 3.0))[..., None] * x)
    m = 2.0 * np.tan(0.5 * w)
    small = r < _SMALL_RADIUS
    safe = np.where(small, 1.0, r)
    u = m * r
    s = np.where(small, m / w * (1.0 - u**2 / 3.0 + u**4 / 5.0), np.arctan(u) / (w * safe))
    return np.asarray(s[..., None] * x)


def _undistort_fov(parameters: F64, x_d: F64) -> tuple[F64, Mask]:
    """Closed form: r = tan(w r_d) / (2 tan(w/2)), for w r_d < pi/2."""
    w = float(parameters[0])
    r_d = np.linalg.norm(x_d, axis=-1)
    if abs(w) < _SMALL_FOV_RAD:
        scale = 1.0 - w**2 * (1.0 / 12.0 - r_d**2 / 3.0)
        return scale[..., None] * x_d, np.ones(r_d.shape, dtype=np.bool_)
    m = 2.0 * np.tan(0.5 * w)
    angle = abs(w) * r_d
    valid = angle < 0.5 * np.pi
    angle = np.where(valid, angle, 0.0)
    small = r_d < _SMALL_RADIUS
    safe = np.where(small, 1.0, r_d)
    series = w / m * (1.0 + angle**2 / 3.0 + 2.0 * angle**4 / 15.0)
    scale = np.where(small, series, np.tan(angle) / (abs(m) * safe))
    return scale[..., None] * x_d, valid


def _undistort_equidistant(parameters: F64, x_d: F64) -> tuple[F64, Mask]:
    """Newton's method on theta, which is one-dimensional and monotone up to the largest theta."""
    k = parameters
    r_d = np.linalg.norm(x_d, axis=-1)
    limit = min(_largest_theta(k), 0.5 * np.pi)
    theta = np.minimum(r_d, 0.9 * limit)
    step = np.full_like(theta, np.inf)
    for _ in range(_MAX_ITERATIONS):
        powers = theta[..., None] ** np.array([2, 4, 6, 8])
        value = theta * (1.0 + powers @ k) - r_d
        slope = 1.0 + powers @ (k * np.array([3.0, 5.0, 7.0, 9.0]))
        step = value / np.maximum(slope, 1e-6)
        theta = np.clip(theta - step, 0.0, limit)
        if np.all(np.abs(step) < _CONVERGED):
            break
    valid = (np.abs(step) < _CONVERGED) & (theta < limit)
    theta = np.where(valid, theta, 0.0)
    small = r_d < _SMALL_RADIUS
    safe = np.where(small, 1.0, r_d)
    # theta = r_d - k1 r_d^3, tan(theta) = theta + theta^3 / 3, to O(r_d^5)
    series = 1.0 + (1.0 / 3.0 - k[0]) * r_d**2
    return np.where(small, series, np.tan(theta) / safe)[..., None] * x_d, valid


def _undistort_brown(parameters: F64, x_d: F64) -> tuple[F64, Mask]:
    """Newton's method on the plane, kept inside the radius where the model grows.

    Points are taken in blocks that fit into the processor's cache, which is several times faster.
    """
    k = tuple(float(value) for value in parameters)
    limit = _largest_brown_radius(k)
    columns = np.ascontiguousarray(x_d.reshape(-1, 2).T)
    x, valid = np.empty_like(columns), np.empty(columns.shape[1], dtype=np.bool_)
    for begin in range(0, columns.shape[1], _BLOCK):
        block = slice(begin, begin + _BLOCK)
        x[:, block], valid[block] = _newton_brown(k, columns[:, block], limit)
    return np.ascontiguousarray(x.T).reshape(x_d.shape), valid.reshape(x_d.shape[:-1])


def _newton_brown(k: tuple[float, ...], x_d: F64, limit: float) -> tuple[F64, Mask]:
    """Return undistorted points (2, N) of x_d (2, N), and which are valid."""
    p1, p2 = k[2:4]
    x = _shorten(x_d, 0.9 * limit)
    for _ in range(_MAX_ITERATIONS):
        u, v = x
        r2 = u * u + v * v
        s, slope, _ = _radial_factor(k, r2)
        mixed = slope * u * v + 2.0 * (p1 * u + p2 * v)
        of_u = s + slope * u * u + (2.0 * p1 * v + 6.0 * p2 * u)
        of_v = s + slope * v * v + (6.0 * p1 * v + 2.0 * p2 * u)
        error_u, error_v = _brown_values(k, x) - x_d
        determinant = of_u * of_v - mixed * mixed
        determinant[np.abs(determinant) < 1e-9] = 1e-9
        step_u = (of_v * error_u - mixed * error_v) / determinant
        step_v = (of_u * error_v - mixed * error_u) / determinant
        moved = _shorten(np.stack([u - step_u, v - step_v]), limit)
        change = _length(moved - x)
        x = moved
        radius = _length(x)
        if np.all(change <= _CONVERGED * (1.0 + radius)):
            break
    residual = _length(_brown_values(k, x) - x_d)
    near = residual <= 100.0 * _CONVERGED * (1.0 + radius)
    return x, near & (change <= _CONVERGED * (1.0 + radius)) & (radius < limit)


def _brown_values(k: tuple[float, ...], x: F64) -> F64:
    """Return distorted points (2, N) of x (2, N), without derivatives."""
    p1, p2 = k[2:4]
    u, v = x
    r2, uv = u * u + v * v, u * v
    s = _radial_factor(k, r2)[0]
    return np.stack(
        [
            s * u + 2.0 * p1 * uv + p2 * (r2 + 2.0 * u * u),
            s * v + p1 * (r2 + 2.0 * v * v) + 2.0 * p2 * uv,
        ]
    )


def _shorten(x: F64, limit: float) -> F64:
    """Scale points (2, N) down to at most `limit` in length."""
    if np.isinf(limit):
        return x
    return np.asarray(x * np.minimum(1.0, limit / np.maximum(_length(x), 1e-300)))


def _length(x: F64) -> F64:
    """Return the lengths (N,) of points (2, N); `np.hypot` is slower."""
    return np.asarray(np.sqrt(x[0] * x[0] + x[1] * x[1]))
