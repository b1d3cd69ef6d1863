"""Compiled minimal solvers of the absolute pose: two points and gravity, or three points.

W is the query's body frame turned so that its z axis points up; M is the gravity-aligned frame of
the points. Points are X in M; rays begin at o with direction f, both in W.
"""

from __future__ import annotations

import numpy as np

from maplab_py.compilation import compiled

MIN_DEPTH_M = 0.05
_FIRST, _SECOND = (0, 0, 1), (1, 2, 2)  # points of the pairs 01, 02, 12


@compiled()
def two_point(o1, f1, X1, o2, f2, X2, yaw, position):  # type: ignore[no-untyped-def]
    """Fill in up to two solutions of Rz(yaw) (o_i + depth_i f_i) + position = X_i; return how many.

    The z components make the depths a line, depth(s) = base + s u; the horizontal distance of
    the two points then is a quadratic in s.
    """
    n = np.sqrt(f1[2] * f1[2] + f2[2] * f2[2])
    if n < 1e-3:
        return 0
    c = (X1[2] - X2[2] - o1[2] + o2[2]) / (n * n)
    base1, base2 = c * f1[2], -c * f2[2]
    u1, u2 = f2[2] / n, f1[2] / n
    ax = o1[0] - o2[0] + base1 * f1[0] - base2 * f2[0]
    ay = o1[1] - o2[1] + base1 * f1[1] - base2 * f2[1]
    bx, by = u1 * f1[0] - u2 * f2[0], u1 * f1[1] - u2 * f2[1]
    dx, dy = X1[0] - X2[0], X1[1] - X2[1]
    qa = bx * bx + by * by
    qb = ax * bx + ay * by
    qc = ax * ax + ay * ay - dx * dx - dy * dy
    discriminant = qb * qb - qa * qc
    if qa < 1e-12 or discriminant < 0.0:
        return 0
    root = np.sqrt(discriminant)
    count = 0
    for sign in (-1.0, 1.0):
        s = (-qb + sign * root) / qa
        depth1, depth2 = base1 + s * u1, base2 + s * u2
        if depth1 < MIN_DEPTH_M or depth2 < MIN_DEPTH_M:
            continue
        vx, vy = ax + s * bx, ay + s * by
        phi = np.arctan2(dy, dx) - np.arctan2(vy, vx)
        cos, sin = np.cos(phi), np.sin(phi)
        px, py = o1[0] + depth1 * f1[0], o1[1] + depth1 * f1[1]
        yaw[count] = phi
        position[count, 0] = X1[0] - (cos * px - sin * py)
        position[count, 1] = X1[1] - (sin * px + cos * py)
        position[count, 2] = X1[2] - (o1[2] + depth1 * f1[2])
        count += 1
    return count


@compiled()
def _pair_equations(o, f, X, scale, cosine, near, far, offset):  # type: ignore[no-untyped-def]
    """Fill in, for the pairs 01, 02, 12, what says that two points keep their distance.

    With depths d it is d_i^2 + d_j^2 - 2 cosine d_i d_j + 2 near d_i - 2 far d_j + offset = 0,
    lengths in units of `scale`.
    """
    for pair in range(3):
        i, j = _FIRST[pair], _SECOND[pair]
        w, D = (o[i] - o[j]) / scale, (X[i] - X[j]) / scale
        cosine[pair] = f[i] @ f[j]
        near[pair], far[pair] = w @ f[i], w @ f[j]
        offset[pair] = w @ w - D @ D


@compiled(forceinline=True)
def _pair_error(pair, a, b, cosine, near, far, offset):  # type: ignore[no-untyped-def]
    lever = 2.0 * (near[pair] * a - far[pair] * b)
    return a * a + b * b - 2.0 * cosine[pair] * a * b + lever + offset[pair]


@compiled()
def _eliminant(d, cosine, near, far, offset):  # type: ignore[no-untyped-def]
    """Return the product of the third equation over the branches that depth d of point 0 leaves.

    The first two equations give two depths of points 1 and 2 each; the product over the four
    combinations is a polynomial of degree 8 in d (its roots are the solutions).
    """
    product = 1.0 + 0.0j
    m1, m2 = cosine[0] * d + far[0], cosine[1] * d + far[1]
    root1 = np.sqrt(m1 * m1 - (d * d + 2.0 * near[0] * d + offset[0]))
    root2 = np.sqrt(m2 * m2 - (d * d + 2.0 * near[1] * d + offset[1]))
    for a in (m1 - root1, m1 + root1):
        for b in (m2 - root2, m2 + root2):
            product *= _pair_error(2, a, b, cosine, near, far, offset)
    return product


@compiled()
def _polish_depths(d, cosine, near, far, offset):  # type: ignore[no-untyped-def]
    """Newton on the three equations, in place; return whether they hold afterwards."""
    e, J = np.empty(3), np.zeros((3, 3))
    for step in range(8):
        for pair in range(3):
            i, j = _FIRST[pair], _SECOND[pair]
            e[pair] = _pair_error(pair, d[i], d[j], cosine, near, far, offset)
            J[pair] = 0.0
            J[pair, i] = 2.0 * (d[i] - cosine[pair] * d[j] + near[pair])
            J[pair, j] = 2.0 * (d[j] - cosine[pair] * d[i] - far[pair])
        if np.abs(e).max() < 1e-12:
            return True
        if step == 7 or abs(np.linalg.det(J)) < 1e-14:
            break
        d -= np.linalg.solve(J, e)
    return np.abs(e).max() < 1e-8


@compiled(forceinline=True)
def _triad(p, axes):  # type: ignore[no-untyped-def]
    """Fill in the orthonormal axes (columns) that three points span; return whether they do."""
    u, v = p[1] - p[0], p[2] - p[0]
    w = np.array([u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]])
    length, area = np.sqrt(u @ u), np.sqrt(w @ w)
    if length < 1e-9 or area < 1e-4 * length * np.sqrt(v @ v):
        return False
    u, w = u / length, w / area
    axes[:, 0], axes[:, 2] = u, w
    axes[0, 1] = w[1] * u[2] - w[2] * u[1]
    axes[1, 1] = w[2] * u[0] - w[0] * u[2]
    axes[2, 1] = w[0] * u[1] - w[1] * u[0]
    return True


@compiled()
def three_point(o, f, X, R, t):  # type: ignore[no-untyped-def]
    """Fill in up to eight poses R (8, 3, 3), t (8, 3) with R (o_i + depth_i f_i) + t = X_i.

    P3P for rays from one centre, generalised P3P for rays from several. Depths follow from the
    distances between the points: two of them are eliminated (Nister and Stewenius, JMIV 2007), the
    polynomial of the third is interpolated from its values on the unit circle. With one centre
    only even powers occur, and half the degree does.

    Returns:
        How many there are.
    """
    axes_X, axes_W, p = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    if not _triad(X, axes_X):
        return 0
    reach = np.empty(3)  # depths at which rays are as far apart as points
    for pair in range(3):
        i, j = _FIRST[pair], _SECOND[pair]
        D, g = X[i] - X[j], f[i] - f[j]
        reach[pair] = np.sqrt(D @ D) / max(np.sqrt(g @ g), 1e-6)
    scale = np.median(reach)
    cosine, near, far, offset = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    _pair_equations(o, f, X, scale, cosine, near, far, offset)
    is_central = max(np.abs(near).max(), np.abs(far).max()) < 1e-12
    degree = 4 if is_central else 8
    values = np.empty(degree + 1, dtype=np.complex128)
    turns = np.exp(2j * np.pi * np.arange(degree + 1) / (degree + 1))
    for k in range(degree + 1):
        d = np.sqrt(turns[k]) if is_central else turns[k]
        values[k] = _eliminant(d, cosine, near, far, offset)
    coefficient = np.empty(degree + 1)
    for c in range(degree + 1):
        coefficient[c] = np.mean(values * np.conj(turns) ** c).real
    if abs(coefficient[degree]) <= 1e-13 * np.abs(coefficient).max():
        return 0
    depth = np.empty(3)
    count = 0
    for root in np.roots(coefficient[::-1].astype(np.complex128)):
        z = np.sqrt(root) if is_central else root
        if z.real <= 0.0 or abs(z.imag) > 1e-2 * z.real:
            continue
        _other_depths(z.real, cosine, near, far, offset, depth)
        if not _polish_depths(depth, cosine, near, far, offset):
            continue
        if depth.min() * scale < MIN_DEPTH_M:
            continue
        for i in range(3):
            p[i] = o[i] + scale * depth[i] * f[i]
        if not _triad(p, axes_W):
            continue
        R[count] = axes_X @ np.ascontiguousarray(axes_W.T)
        t[count] = X[0] - R[count] @ p[0]
        count += 1
    return count


@compiled()
def _other_depths(d, cosine, near, far, offset, depth):  # type: ignore[no-untyped-def]
    """Fill in the branch of the other two depths that fulfils the third equation best."""
    m1, m2 = cosine[0] * d + far[0], cosine[1] * d + far[1]
    root1 = np.sqrt(max(m1 * m1 - (d * d + 2.0 * near[0] * d + offset[0]), 0.0))
    root2 = np.sqrt(max(m2 * m2 - (d * d + 2.0 * near[1] * d + offset[1]), 0.0))
    best = np.inf
    for a in (m1 - root1, m1 + root1):
        for b in (m2 - root2, m2 + root2):
            error = abs(_pair_error(2, a, b, cosine, near, far, offset))
            if error < best:
                best = error
                depth[0], depth[1], depth[2] = d, a, b
