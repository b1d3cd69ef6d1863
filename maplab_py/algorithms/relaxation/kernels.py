"""Compiled loops over vertices: steps along screws, tilt priors, connected parts."""

from __future__ import annotations

import numpy as np

from maplab_py.compilation import compiled


@compiled()
def moved(T, vertices, twist):  # type: ignore[no-untyped-def]
    """Return poses (V, 7), those of some vertices (N,) moved along screws: T exp([v, w]), (N, 6).

    Where half a trajectory turns about a far corner, screws keep its shape and sums stretch it:
    that saves most of the iterations.
    """
    result = T.copy()
    p, x, y = np.empty(3), np.empty(3), np.empty(3)
    for i in range(len(vertices)):
        pose, step = result[vertices[i]], twist[i]
        v, w = step[:3], step[3:]
        square = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
        if square < 1e-8:
            half, b, c = 0.5 - square / 48.0, 0.5 - square / 24.0, 1.0 / 6.0 - square / 120.0
            cosine = 1.0 - square / 8.0
        else:
            angle = np.sqrt(square)
            half, cosine = np.sin(0.5 * angle) / angle, np.cos(0.5 * angle)
            b, c = (1.0 - np.cos(angle)) / square, (angle - np.sin(angle)) / (square * angle)
        _cross(w, v, x)
        _cross(w, x, y)
        for k in range(3):
            p[k] = v[k] + b * x[k] + c * y[k]
        q = pose[:4]
        _cross(q, p, x)
        for k in range(3):
            x[k] = 2.0 * x[k]
        _cross(q, x, y)
        for k in range(3):
            pose[4 + k] += p[k] + q[3] * x[k] + y[k]
        a0, a1, a2, a3 = q[0], q[1], q[2], q[3]
        b0, b1, b2, b3 = half * w[0], half * w[1], half * w[2], cosine
        q[0] = a3 * b0 + a0 * b3 + a1 * b2 - a2 * b1
        q[1] = a3 * b1 - a0 * b2 + a1 * b3 + a2 * b0
        q[2] = a3 * b2 + a0 * b1 - a1 * b0 + a2 * b3
        q[3] = a3 * b3 - a0 * b0 - a1 * b1 - a2 * b2
        norm = np.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
        for k in range(4):
            q[k] /= norm
    return result


@compiled(forceinline=True)
def _cross(a, b, out):  # type: ignore[no-untyped-def]
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@compiled(forceinline=True)
def _tilt(q, measured, e, J):  # type: ignore[no-untyped-def]
    """Fill in (R_m d)_xy (2,) with d = Log(R_m^T R), and its derivative (2, 3) by w of R exp(w)."""
    x, y, z, w = -measured[0], -measured[1], -measured[2], measured[3]
    r0 = w * q[0] + x * q[3] + y * q[2] - z * q[1]
    r1 = w * q[1] + y * q[3] + z * q[0] - x * q[2]
    r2 = w * q[2] + z * q[3] + x * q[1] - y * q[0]
    r3 = w * q[3] - x * q[0] - y * q[1] - z * q[2]
    sign = -1.0 if r3 < 0.0 else 1.0
    n = np.sqrt(r0 * r0 + r1 * r1 + r2 * r2)
    r3 *= sign
    factor = sign * (2.0 / r3 if n < 1e-9 else 2.0 * np.arctan2(n, r3) / n)
    d0, d1, d2 = factor * r0, factor * r1, factor * r2
    square = d0 * d0 + d1 * d1 + d2 * d2
    if square < 1e-4:
        b = 1.0 / 12.0 + square / 720.0
    else:
        angle = np.sqrt(square)
        b = 1.0 / square - np.cos(0.5 * angle) / np.sin(0.5 * angle) / (2.0 * angle)
    # Jr^-1(d) = I + [d] / 2 + b (d d^T - |d|^2 I)
    x, y, z = measured[0], measured[1], measured[2]
    for i in range(2):
        if i == 0:
            a0, a1, a2 = 1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)
        else:
            a0, a1, a2 = 2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)
        along = a0 * d0 + a1 * d1 + a2 * d2
        e[i] = along
        own = 1.0 - b * square
        J[i, 0] = own * a0 + 0.5 * (a1 * d2 - a2 * d1) + b * along * d0
        J[i, 1] = own * a1 + 0.5 * (a2 * d0 - a0 * d2) + b * along * d1
        J[i, 2] = own * a2 + 0.5 * (a0 * d1 - a1 * d0) + b * along * d2


@compiled()
def tilt_errors(T, vertices, q_measured, e, J):  # type: ignore[no-untyped-def]
    """Fill in tilts (N, 2) away from measured attitudes (N, 4), and derivatives (N, 2, 3)."""
    for i in range(len(vertices)):
        _tilt(T[vertices[i], :4], q_measured[i], e[i], J[i])


@compiled()
def tilt_cost(T, vertices, q_measured, sigma):  # type: ignore[no-untyped-def]
    """Return the sum of squares of tilts / sigma."""
    e, J = np.empty(2), np.empty((2, 3))
    cost = 0.0
    for i in range(len(vertices)):
        _tilt(T[vertices[i], :4], q_measured[i], e, J)
        cost += e[0] * e[0] + e[1] * e[1]
    return cost / (sigma * sigma)


@compiled()
def add_tilt(T, vertices, q_measured, sigma, node, blocks, gradient, diagonal):  # type: ignore[no-untyped-def]
    """Add tilt priors to blocks (nodes, 6, 6), gradient and diagonal (nodes, 6); return their cost.

    `node` (N,) is -1 where the vertex does not move.
    """
    e, J = np.empty(2), np.empty((2, 3))
    cost, weight = 0.0, 1.0 / (sigma * sigma)
    for i in range(len(vertices)):
        _tilt(T[vertices[i], :4], q_measured[i], e, J)
        cost += weight * (e[0] * e[0] + e[1] * e[1])
        n = node[i]
        if n < 0:
            continue
        for r in range(3):
            gradient[n, 3 + r] += weight * (J[0, r] * e[0] + J[1, r] * e[1])
            diagonal[n, 3 + r] += weight * (J[0, r] * J[0, r] + J[1, r] * J[1, r])
            for c in range(3):
                blocks[n, 3 + r, 3 + c] += weight * (J[0, r] * J[0, c] + J[1, r] * J[1, c])
    return cost


@compiled()
def connected_parts(count, first, second):  # type: ignore[no-untyped-def]
    """Return the smallest node (count,) of each node's part, links being first (E,) to second."""
    root = np.arange(count)
    for link in range(len(first)):
        a, b = first[link], second[link]
        while root[a] != a:
            root[a] = root[root[a]]
            a = root[a]
        while root[b] != b:
            root[b] = root[root[b]]
            b = root[b]
        if a < b:
            root[b] = a
        else:
            root[a] = b
    for node in range(count):
        root[node] = root[root[node]]
    return root
