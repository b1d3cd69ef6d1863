"""Rotations inside compiled loops: unit quaternions [x y z w], rotation vectors, matrices."""

import numpy as np

from maplab_py.compilation import compiled


@compiled(forceinline=True)
def cross(a, b, out):  # type: ignore[no-untyped-def]
    """Compute a x b (3,)."""
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@compiled(forceinline=True)
def skew(v, out):  # type: ignore[no-untyped-def]
    """Compute the matrix (3, 3) with skew(v) u = v x u."""
    out[0, 0], out[0, 1], out[0, 2] = 0.0, -v[2], v[1]
    out[1, 0], out[1, 1], out[1, 2] = v[2], 0.0, -v[0]
    out[2, 0], out[2, 1], out[2, 2] = -v[1], v[0], 0.0


@compiled(forceinline=True)
def multiply(a, b):  # type: ignore[no-untyped-def]
    """Return the product a b as a tuple."""
    x = a[3] * b[0] + a[0] * b[3] + a[1] * b[2] - a[2] * b[1]
    y = a[3] * b[1] - a[0] * b[2] + a[1] * b[3] + a[2] * b[0]
    z = a[3] * b[2] + a[0] * b[1] - a[1] * b[0] + a[2] * b[3]
    return x, y, z, a[3] * b[3] - a[0] * b[0] - a[1] * b[1] - a[2] * b[2]


@compiled(forceinline=True)
def conjugate_multiply(a, b):  # type: ignore[no-untyped-def]
    """Return the product conj(a) b as a tuple: q_A_B of q_G_A and q_G_B."""
    return multiply((-a[0], -a[1], -a[2], a[3]), b)


@compiled(forceinline=True)
def to_matrix(q, out):  # type: ignore[no-untyped-def]
    """Compute the rotation matrix (3, 3) of a unit quaternion."""
    x, y, z, w = q[0], q[1], q[2], q[3]
    out[0, 0], out[0, 1], out[0, 2] = (
        1 - 2 * (y * y + z * z),
        2 * (x * y - z * w),
        2 * (x * z + y * w),
    )
    out[1, 0], out[1, 1], out[1, 2] = (
        2 * (x * y + z * w),
        1 - 2 * (x * x + z * z),
        2 * (y * z - x * w),
    )
    out[2, 0], out[2, 1], out[2, 2] = (
        2 * (x * z - y * w),
        2 * (y * z + x * w),
        1 - 2 * (x * x + y * y),
    )


@compiled()
def from_matrix(R, out):  # type: ignore[no-untyped-def]
    """Compute the unit quaternion (4,) with w >= 0 of a rotation matrix, from its largest component."""
    m00, m11, m22 = R[0, 0], R[1, 1], R[2, 2]
    squares = (1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22, 1 + m00 + m11 + m22)
    s01, s02, s12 = R[0, 1] + R[1, 0], R[0, 2] + R[2, 0], R[1, 2] + R[2, 1]
    d21, d02, d10 = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    largest = max(squares)
    if squares[0] == largest:
        q = (squares[0], s01, s02, d21)
    elif squares[1] == largest:
        q = (s01, squares[1], s12, d02)
    elif squares[2] == largest:
        q = (s02, s12, squares[2], d10)
    else:
        q = (d21, d02, d10, squares[3])
    norm = np.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    sign = -1.0 if q[3] < 0.0 else 1.0
    for i in range(4):
        out[i] = sign * (q[i] / norm)


@compiled(forceinline=True)
def log(q, out):  # type: ignore[no-untyped-def]
    """Compute the rotation vector (3,), of length <= pi; q and -q give the same."""
    sign = -1.0 if q[3] < 0.0 else 1.0
    n = np.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2])
    w = sign * q[3]
    factor = 2.0 / w * (1.0 - n * n / (3.0 * w * w)) if n < 1e-6 else 2.0 * np.arctan2(n, w) / n
    for i in range(3):
        out[i] = sign * factor * q[i]
