"""Rigid motions as rows [qx qy qz qw px py pz], with any number of leading batch axes."""

import numpy as np
from numpy.typing import ArrayLike

from maplab_py.array_types import F64
from maplab_py.geometry import so3


def identity(*batch: int) -> F64:
    """Return identity poses (*batch, 7)."""
    T = np.zeros((*batch, 7))
    T[..., 3] = 1.0
    return T


def make(q_A_B: ArrayLike, p_A_B: ArrayLike) -> F64:
    """Join quaternions (..., 4) and positions (..., 3) to poses (..., 7)."""
    return np.concatenate([np.asarray(q_A_B, dtype=np.float64), np.asarray(p_A_B)], axis=-1)


def compose(T_A_B: ArrayLike, T_B_C: ArrayLike) -> F64:
    """Return T_A_C = T_A_B T_B_C, shapes (..., 7) that broadcast."""
    a, b = np.asarray(T_A_B, dtype=np.float64), np.asarray(T_B_C, dtype=np.float64)
    q = so3.normalize(so3.multiply(a[..., :4], b[..., :4]))
    return np.concatenate([q, so3.rotate(a[..., :4], b[..., 4:]) + a[..., 4:]], axis=-1)


def inverse(T_A_B: ArrayLike) -> F64:
    """Return T_B_A, shape (..., 7)."""
    T = np.asarray(T_A_B, dtype=np.float64)
    q_B_A = so3.inverse(T[..., :4])
    return np.concatenate([q_B_A, -so3.rotate(q_B_A, T[..., 4:])], axis=-1)


def relative(T_G_A: ArrayLike, T_G_B: ArrayLike) -> F64:
    """Return T_A_B = T_G_A^-1 T_G_B, shapes (..., 7) that broadcast."""
    return compose(inverse(T_G_A), T_G_B)


def transform(T_A_B: ArrayLike, p_B: ArrayLike) -> F64:
    """Take points (..., 3) from B to A."""
    T = np.asarray(T_A_B, dtype=np.float64)
    return np.asarray(so3.rotate(T[..., :4], p_B) + T[..., 4:])


def to_matrix(T_A_B: ArrayLike) -> F64:
    """Return homogeneous matrices (..., 4, 4)."""
    T = np.asarray(T_A_B, dtype=np.float64)
    m = np.zeros((*T.shape[:-1], 4, 4))
    m[..., :3, :3] = so3.to_matrix(T[..., :4])
    m[..., :3, 3] = T[..., 4:]
    m[..., 3, 3] = 1.0
    return m


def from_matrix(matrix_A_B: ArrayLike) -> F64:
    """Return poses (..., 7) of homogeneous matrices (..., 4, 4)."""
    m = np.asarray(matrix_A_B, dtype=np.float64)
    return np.concatenate([so3.from_matrix(m[..., :3, :3]), m[..., :3, 3]], axis=-1)


def retract(T_A_B: ArrayLike, delta: ArrayLike) -> F64:
    """Apply tangent vectors (..., 6) = [dp, dtheta]: p <- p + dp, R <- R exp(dtheta)."""
    T, d = np.asarray(T_A_B, dtype=np.float64), np.asarray(delta, dtype=np.float64)
    q = so3.normalize(so3.multiply(T[..., :4], so3.exp(d[..., 3:])))
    return np.concatenate([q, T[..., 4:] + d[..., :3]], axis=-1)


def local(T_A_B: ArrayLike, T_A_C: ArrayLike) -> F64:
    """Return the tangent vectors (..., 6) with retract(T_A_B, delta) = T_A_C."""
    a, b = np.asarray(T_A_B, dtype=np.float64), np.asarray(T_A_C, dtype=np.float64)
    dtheta = so3.log(so3.multiply(so3.inverse(a[..., :4]), b[..., :4]))
    return np.concatenate([b[..., 4:] - a[..., 4:], dtheta], axis=-1)


def exp(tangent: ArrayLike) -> F64:
    """Map group tangent vectors (..., 6) = [rho, phi] to poses (..., 7): p = V(phi) rho.

    This is the group's exponential (a screw motion), not `retract`, which moves the position
    by itself. Source: Barfoot, State Estimation for Robotics, 2017, eq. (7.86).
    """
    d = np.asarray(tangent, dtype=np.float64)
    # V is the left Jacobian of SO(3): J_l(phi) = J_r(-phi)
    V = so3.right_jacobian(-d[..., 3:])
    p = (V @ d[..., :3, None])[..., 0]
    return np.concatenate([so3.exp(d[..., 3:]), p], axis=-1)


def log(T_A_B: ArrayLike) -> F64:
    """Map poses (..., 7) to group tangent vectors (..., 6) = [rho, phi], |phi| <= pi."""
    T = np.asarray(T_A_B, dtype=np.float64)
    phi = so3.log(T[..., :4])
    rho = (so3.right_jacobian_inverse(-phi) @ T[..., 4:, None])[..., 0]
    return np.concatenate([rho, phi], axis=-1)
