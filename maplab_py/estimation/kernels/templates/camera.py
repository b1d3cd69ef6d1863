"""Reprojection of a point by any camera.

The camera model is a branch: `denominator` and `distort`, and their derivatives by the parameters, are
generated, a few lines for each projection and each distortion (`symbolic.cameras`). Everything around
them, the chain over poses and landmarks, is the same for all models and written by hand here: rows of a
Jacobian by p_C become rows by poses with cross products. A row of `parameters` begins with the code of
its model, 8 * projection + distortion; the model's parameters follow.

`axes` (C, 12) has R_I_C by rows, then p_I_C.
"""


# ruff: noqa: F821
# mypy: ignore-errors
# --- kernels ---
@compiled(fastmath={"contract", "nsz"}, forceinline=True)
def rotation(poses, k):
    """Return the entries of the rotation of pose k by rows."""
    x, y, z, w = poses[k, 0], poses[k, 1], poses[k, 2], poses[k, 3]
    xx, yy, zz = 2.0 * x * x, 2.0 * y * y, 2.0 * z * z
    xy, xz, yz = 2.0 * x * y, 2.0 * x * z, 2.0 * y * z
    xw, yw, zw = 2.0 * x * w, 2.0 * y * w, 2.0 * z * w
    return (
        1.0 - yy - zz, xy - zw, xz + yw,
        xy + zw, 1.0 - xx - zz, yz - xw,
        xz - yw, yz + xw, 1.0 - xx - yy,
    )  # fmt: skip


@compiled(fastmath={"contract", "nsz"})
def camera_axes(extrinsics):
    """Return the axes (C, 12) of poses T_I_C (C, 7)."""
    axes = np.empty((len(extrinsics), 12))
    for c in range(len(extrinsics)):
        R = rotation(extrinsics, c)
        for i in range(9):
            axes[c, i] = R[i]
        for i in range(3):
            axes[c, 9 + i] = extrinsics[c, 4 + i]
    return axes


@compiled(fastmath={"contract", "nsz"}, forceinline=True)
def from_axes(axes, c, x, y, z):
    """Return R_I_C^T (x, y, z)."""
    return (
        axes[c, 0] * x + axes[c, 3] * y + axes[c, 6] * z,
        axes[c, 1] * x + axes[c, 4] * y + axes[c, 7] * z,
        axes[c, 2] * x + axes[c, 5] * y + axes[c, 8] * z,
    )


@compiled(fastmath={"contract", "nsz"}, forceinline=True)
def to_axes(axes, c, x, y, z):
    """Return R_I_C (x, y, z)."""
    return (
        axes[c, 0] * x + axes[c, 1] * y + axes[c, 2] * z,
        axes[c, 3] * x + axes[c, 4] * y + axes[c, 5] * z,
        axes[c, 6] * x + axes[c, 7] * y + axes[c, 8] * z,
    )


@compiled(fastmath={"contract", "nsz"}, forceinline=True)
def project(parameters, c, x, y, z):
    """Return the pixel u, v of a point in camera c, and the rows d u / d p_C and d v / d p_C."""
    model = np.int64(parameters[c, 0])
    D, Dx, Dy, Dz, f = denominator(model >> 3, parameters, c, x, y, z)
    inverse = 1.0 / D
    a, b = x * inverse, y * inverse
    p, q, pa, qa, pb, qb = distort(model & 7, parameters, c, f + 4, a, b)
    fu, fv = parameters[c, f], parameters[c, f + 1]
    ua, ub, va, vb = fu * inverse * pa, fu * inverse * pb, fv * inverse * qa, fv * inverse * qb
    s, t = ua * a + ub * b, va * a + vb * b
    return (
        fu * p + parameters[c, f + 2], fv * q + parameters[c, f + 3],
        ua - s * Dx, ub - s * Dy, -s * Dz, va - t * Dx, vb - t * Dy, -t * Dz,
    )  # fmt: skip


@compiled(fastmath={"contract", "nsz"})
def project_by_parameters(parameters, c, x, y, z, out, first):
    """Write d (u, v) / d parameters to `out` from `first` on, two entries a column; zero the rest."""
    model = np.int64(parameters[c, 0])
    D, _, _, _, f = denominator(model >> 3, parameters, c, x, y, z)
    a, b = x / D, y / D
    p, q, pa, qa, pb, qb = distort(model & 7, parameters, c, f + 4, a, b)
    fu, fv = parameters[c, f], parameters[c, f + 1]
    by_mirror = denominator_by_mirror(model >> 3, parameters, c, x, y, z)
    s, t = -fu * (pa * a + pb * b) / D, -fv * (qa * a + qb * b) / D
    for i in range(f - 1):
        out[first + 2 * i], out[first + 2 * i + 1] = s * by_mirror[i], t * by_mirror[i]
    k = first + 2 * (f - 1)
    out[k], out[k + 2], out[k + 4], out[k + 6] = p, 0.0, 1.0, 0.0
    out[k + 1], out[k + 3], out[k + 5], out[k + 7] = 0.0, q, 0.0, 1.0
    end = distort_by_parameters(model & 7, parameters, c, f + 4, a, b, out, k + 8)
    for i in range(k + 8, end, 2):
        out[i] *= fu
        out[i + 1] *= fv
    for i in range(end, len(out)):
        out[i] = 0.0


@compiled(fastmath={"contract", "nsz"}, forceinline=True)
def cross(a0, a1, a2, b0, b1, b2):
    """Return a x b."""
    return a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0


@compiled(fastmath={"contract", "nsz"}, forceinline=True)
def write_row(out, first, a, b, c):
    """Write one row of three columns of two entries to `out` from `first` on."""
    out[first], out[first + 2], out[first + 4] = a, b, c
