"""Yaw and position: the four degrees of freedom that gravity leaves unobserved.

An element is a row [px py pz yaw] of T_A_B with both frames' z axes along gravity:
``p_A = Rz(yaw) p_B + p``. The group is SE(2) x R; any number of leading batch axes.
"""

import numpy as np
from numpy.typing import ArrayLike

from maplab_py.array_types import F64


def wrap(angle: ArrayLike) -> F64:
    """Bring angles [rad] into [-pi, pi]."""
    angle = np.asarray(angle, dtype=np.float64)
    return np.asarray(np.arctan2(np.sin(angle), np.cos(angle)))


def rotate(yaw: ArrayLike, v: ArrayLike) -> F64:
    """Rotate vectors (..., 3) about z by angles (...,) [rad]."""
    yaw, v = np.asarray(yaw, dtype=np.float64), np.asarray(v, dtype=np.float64)
    c, s = np.cos(yaw), np.sin(yaw)
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    x, y, z = np.broadcast_arrays(c * x - s * y, s * x + c * y, z)
    return np.stack([x, y, z], axis=-1)


def compose(T_A_B: ArrayLike, T_B_C: ArrayLike) -> F64:
    """Return T_A_C, shapes (..., 4) that broadcast."""
    a, b = np.asarray(T_A_B, dtype=np.float64), np.asarray(T_B_C, dtype=np.float64)
    p = rotate(a[..., 3], b[..., :3]) + a[..., :3]
    return np.concatenate([p, wrap(a[..., 3:] + b[..., 3:])], axis=-1)


def inverse(T_A_B: ArrayLike) -> F64:
    """Return T_B_A, shape (..., 4)."""
    T = np.asarray(T_A_B, dtype=np.float64)
    return np.concatenate([-rotate(-T[..., 3], T[..., :3]), wrap(-T[..., 3:])], axis=-1)


def transform(T_A_B: ArrayLike, p_B: ArrayLike) -> F64:
    """Take points (..., 3) from B to A."""
    T = np.asarray(T_A_B, dtype=np.float64)
    return np.asarray(rotate(T[..., 3], p_B) + T[..., :3])


def yaw_of(q_A_B: ArrayLike) -> F64:
    """Return the yaw (...,) [rad] of the rotation about z nearest to quaternions (..., 4).

    Nearest in the Frobenius norm, which is the twist of the swing-twist split; a rotation that
    turns z upside down has no nearest one and gives an arbitrary angle.
    """
    q = np.asarray(q_A_B, dtype=np.float64)
    return wrap(2.0 * np.arctan2(q[..., 2], q[..., 3]))


def quaternion(yaw: ArrayLike) -> F64:
    """Return the quaternions (..., 4) of rotations about z by angles (...,) [rad]."""
    half = 0.5 * np.asarray(yaw, dtype=np.float64)
    zero = np.zeros_like(half)
    return np.stack([zero, zero, np.sin(half), np.cos(half)], axis=-1)


def from_pose(T_A_B: ArrayLike) -> F64:
    """Return the elements (..., 4) of poses (..., 7); roll and pitch are dropped."""
    T = np.asarray(T_A_B, dtype=np.float64)
    return np.concatenate([T[..., 4:], yaw_of(T[..., :4])[..., None]], axis=-1)


def to_pose(T_A_B: ArrayLike) -> F64:
    """Return the poses (..., 7) of elements (..., 4)."""
    T = np.asarray(T_A_B, dtype=np.float64)
    return np.concatenate([quaternion(T[..., 3]), T[..., :3]], axis=-1)
