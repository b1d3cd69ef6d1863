"""Rotations as unit quaternions [x y z w] (Hamilton), with any number of leading batch axes."""

import numpy as np
from numpy.typing import ArrayLike

from maplab_py.array_types import F64

_SMALL_ANGLE_RAD = 1e-4
"""Below this angle the Taylor series (error < 1e-17 relative) replace the closed forms."""


def identity(*batch: int) -> F64:
    """Return identity quaternions (*batch, 4)."""
    q = np.zeros((*batch, 4))
    q[..., 3] = 1.0
    return q


def normalize(q: ArrayLike) -> F64:
    """Scale quaternions (..., 4) to unit length."""
    q = np.asarray(q, dtype=np.float64)
    return np.asarray(q / np.linalg.norm(q, axis=-1, keepdims=True))


def multiply(q_A_B: ArrayLike, q_B_C: ArrayLike) -> F64:
    """Compose rotations: q_A_C = q_A_B * q_B_C, shapes (..., 4) that broadcast."""
    a, b = np.asarray(q_A_B, dtype=np.float64), np.asarray(q_B_C, dtype=np.float64)
    ax, ay, az, aw = a[..., 0], a[..., 1], a[..., 2], a[..., 3]
    bx, by, bz, bw = b[..., 0], b[..., 1], b[..., 2], b[..., 3]
    return np.stack(
        [
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        ],
        axis=-1,
    )


def inverse(q_A_B: ArrayLike) -> F64:
    """Return q_B_A, shape (..., 4)."""
    return np.asarray(np.asarray(q_A_B, dtype=np.float64) * np.array([-1.0, -1.0, -1.0, 1.0]))


def rotate(q_A_B: ArrayLike, v_B: ArrayLike) -> F64:
    """Rotate vectors (..., 3) from B to A."""
    q, v = np.asarray(q_A_B, dtype=np.float64), np.asarray(v_B, dtype=np.float64)
    axis, w = q[..., :3], q[..., 3:]
    t = 2.0 * _cross(axis, v)
    return np.asarray(v + w * t + _cross(axis, t))


def _cross(a: F64, b: F64) -> F64:
    """Return a x b (..., 3), the numbers of `np.cross` in a third of its time."""
    result = np.empty(np.broadcast_shapes(a.shape, b.shape))
    a0, a1, a2 = a[..., 0], a[..., 1], a[..., 2]
    b0, b1, b2 = b[..., 0], b[..., 1], b[..., 2]
    result[..., 0] = a1 * b2 - a2 * b1
    result[..., 1] = a2 * b0 - a0 * b2
    result[..., 2] = a0 * b1 - a1 * b0
    return result


def skew(v: ArrayLike) -> F64:
    """Return the matrices (..., 3, 3) with skew(v) @ u = v x u."""
    v = np.asarray(v, dtype=np.float64)
    m = np.zeros((*v.shape[:-1], 3, 3))
    m[..., 0, 1], m[..., 0, 2], m[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    m[..., 1, 0], m[..., 2, 0], m[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return m


def exp(phi: ArrayLike) -> F64:
    """Map rotation vectors (..., 3) [rad] to quaternions (..., 4)."""
    phi = np.asarray(phi, dtype=np.float64)
    angle = np.linalg.norm(phi, axis=-1, keepdims=True)
    small = angle < _SMALL_ANGLE_RAD
    safe = np.where(small, 1.0, angle)
    # sin(a/2)/a = 1/2 - a^2/48 + O(a^4)
    scale = np.where(small, 0.5 - angle**2 / 48.0, np.sin(0.5 * safe) / safe)
    return normalize(np.concatenate([scale * phi, np.cos(0.5 * angle)], axis=-1))


def log(q: ArrayLike) -> F64:
    """Map quaternions (..., 4) to rotation vectors (..., 3) of length <= pi."""
    q = np.asarray(q, dtype=np.float64)
    q = np.where(q[..., 3:] < 0.0, -q, q)
    vector, w = q[..., :3], q[..., 3:]
    sine = np.linalg.norm(vector, axis=-1, keepdims=True)
    small = sine < _SMALL_ANGLE_RAD
    safe = np.where(small, 1.0, sine)
    # 2 atan(s/w)/s = 2/w (1 - (s/w)^2 / 3) + O(s^4)
    w_safe = np.where(small, w, 1.0)
    series = 2.0 / w_safe * (1.0 - (sine / w_safe) ** 2 / 3.0)
    return np.asarray(np.where(small, series, 2.0 * np.arctan2(safe, w) / safe) * vector)


def to_matrix(q_A_B: ArrayLike) -> F64:
    """Return rotation matrices (..., 3, 3) of quaternions (..., 4)."""
    q = np.asarray(q_A_B, dtype=np.float64)
    x, y, z, w = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    m = np.empty((*q.shape[:-1], 3, 3))
    m[..., 0, 0] = 1.0 - 2.0 * (y * y + z * z)
    m[..., 0, 1] = 2.0 * (x * y - z * w)
    m[..., 0, 2] = 2.0 * (x * z + y * w)
    m[..., 1, 0] = 2.0 * (x * y + z * w)
    m[..., 1, 1] = 1.0 - 2.0 * (x * x + z * z)
    m[..., 1, 2] = 2.0 * (y * z - x * w)
    m[..., 2, 0] = 2.0 * (x * z - y * w)
    m[..., 2, 1] = 2.0 * (y * z + x * w)
    m[..., 2, 2] = 1.0 - 2.0 * (x * x + y * y)
    return m


def from_matrix(R_A_B: ArrayLike) -> F64:
    """Return quaternions (..., 4) with w >= 0 of rotation matrices (..., 3, 3).

    Every candidate (largest of the four squared components) is formed and the best conditioned
    one is taken per matrix, so no rotation is near a singularity.
    """
    R = np.asarray(R_A_B, dtype=np.float64)
    m00, m11, m22 = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    sum01, sum02, sum12 = (
        R[..., 0, 1] + R[..., 1, 0],
        R[..., 0, 2] + R[..., 2, 0],
        R[..., 1, 2] + R[..., 2, 1],
    )
    d21, d02, d10 = (
        R[..., 2, 1] - R[..., 1, 2],
        R[..., 0, 2] - R[..., 2, 0],
        R[..., 1, 0] - R[..., 0, 1],
    )
    # 4 q q^T, row by row: each row is the quaternion times 4 times one of its components
    outer = np.empty((*R.shape[:-2], 4, 4))
    outer[..., 0, 0], outer[..., 1, 1] = 1 + m00 - m11 - m22, 1 - m00 + m11 - m22
    outer[..., 2, 2], outer[..., 3, 3] = 1 - m00 - m11 + m22, 1 + m00 + m11 + m22
    outer[..., 0, 1] = outer[..., 1, 0] = sum01
    outer[..., 0, 2] = outer[..., 2, 0] = sum02
    outer[..., 1, 2] = outer[..., 2, 1] = sum12
    outer[..., 0, 3] = outer[..., 3, 0] = d21
    outer[..., 1, 3] = outer[..., 3, 1] = d02
    outer[..., 2, 3] = outer[..., 3, 2] = d10
    best = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    q = normalize(np.take_along_axis(outer, best[..., None, None], axis=-2)[..., 0, :])
    return np.asarray(np.where(q[..., 3:] < 0.0, -q, q))


def right_jacobian(phi: ArrayLike) -> F64:
    """Return J_r (..., 3, 3) with exp(phi + d) = exp(phi) exp(J_r d) to first order.

    Source: Forster 2017, eq. (8).
    """
    phi = np.asarray(phi, dtype=np.float64)
    K = skew(phi)
    angle = np.linalg.norm(phi, axis=-1)[..., None, None]
    small = angle < _SMALL_ANGLE_RAD
    safe = np.where(small, 1.0, angle)
    # 1 - cos(a) = 2 sin(a/2)^2 does not cancel
    a = np.where(small, 0.5 - angle**2 / 24.0, 2.0 * np.sin(0.5 * safe) ** 2 / safe**2)
    b = np.where(small, 1.0 / 6.0 - angle**2 / 120.0, (safe - np.sin(safe)) / safe**3)
    return np.asarray(np.eye(3) - a * K + b * (K @ K))


def right_jacobian_inverse(phi: ArrayLike) -> F64:
    """Return the inverse of `right_jacobian` (..., 3, 3) for |phi| < 2 pi."""
    phi = np.asarray(phi, dtype=np.float64)
    K = skew(phi)
    angle = np.linalg.norm(phi, axis=-1)[..., None, None]
    small = angle < _SMALL_ANGLE_RAD
    safe = np.where(small, 1.0, angle)
    # (1 + cos(a)) / sin(a) = cot(a/2) is exact at pi
    closed = 1.0 / safe**2 - 1.0 / (2.0 * safe * np.tan(0.5 * safe))
    b = np.where(small, 1.0 / 12.0 + angle**2 / 720.0, closed)
    return np.asarray(np.eye(3) + 0.5 * K + b * (K @ K))
