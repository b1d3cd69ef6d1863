"""Products with the reduced system of the visual terms, which is never formed.

With the Jacobians P_o = [-Q_o R_o] (2 x 6, pose) and Q_o (2 x 3, landmark) of the observations o of a
landmark, kept by the template `visual_jacobians`, and V = sum Q_o' Q_o with the landmark's prior and
damping, eliminating the landmarks leaves S = P' (I - Q V^-1 Q') P. Its product with a step x of the
poses walks the landmarks once (Agarwal et al., Bundle Adjustment in the Large, 2010, section 3.3):

    t_o = P_o x_o,   d = V^-1 sum Q_o' t_o,   e_o = t_o - Q_o d,   y_o += P_o' e_o.

No large numbers cancel: e_o is what is left of t_o, not the difference of two sums over all landmarks.
Landmarks come in a fixed number of chunks with sums of their own, so results do not depend on the
number of threads.
"""

import math
from typing import NamedTuple

import numpy as np

from maplab_py.array_types import F32, F64, I32, I64
from maplab_py.compilation import compiled, prange

_SMALLEST_DAMPED, _LARGEST_DAMPED = 1e-6, 1e32
"""As in the template `visual_common`."""
_SMALLEST_PIVOT = 1e-14


class Structure(NamedTuple):
    """Visibility of landmarks from poses, and the division of the landmarks among threads."""

    start: I64  # (L + 1,) offsets of the landmarks' observations
    vertex: I32  # (O,) ascending within a landmark
    chunk_start: I64  # (chunks + 1,) landmarks
    longest: int  # largest number of observations of a landmark


class KeptSystem(NamedTuple):
    """Parts of the visual terms that are kept between evaluation and products."""

    jacobian: F32  # (O, 12) rows u and v, [Q R] each
    landmark_square: F64  # (L, 6) lower triangle of Q'Q by rows, with the prior
    landmark_gradient: F64  # (L, 3) Q'r
    landmark_factor: F64  # (L, 6) Cholesky factor of V with inverted diagonal


class PoseSums(NamedTuple):
    """Sums over observations by chunk of landmarks and by vertex."""

    square: F64  # (chunks, V, 6, 6) P'P
    gradient: F64  # (chunks, V, 6) P'r


@compiled(forceinline=True)
def _damped(h: float, damping: float) -> float:
    return h + damping * min(max(h, _SMALLEST_DAMPED), _LARGEST_DAMPED)


@compiled()
def factor_landmarks(landmark_square: F64, damping: float, factor: F64) -> None:
    """Factorise the damped 3 x 3 matrices of all landmarks, as `factor_3x3` of `visual_common`."""
    for row in range(len(landmark_square)):
        h, f = landmark_square[row], factor[row]
        a0, a1, a2 = _damped(h[0], damping), _damped(h[2], damping), _damped(h[5], damping)
        f[0] = 1.0 / math.sqrt(a0)
        f[1] = h[1] * f[0]
        f[2] = 1.0 / math.sqrt(max(a1 - f[1] * f[1], _SMALLEST_PIVOT * a1))
        f[3] = h[3] * f[0]
        f[4] = (h[4] - f[3] * f[1]) * f[2]
        f[5] = 1.0 / math.sqrt(max(a2 - f[3] * f[3] - f[4] * f[4], _SMALLEST_PIVOT * a2))


@compiled(forceinline=True)
def _solve_3x3(f: F64, row: int, u0: float, u1: float, u2: float) -> tuple[float, float, float]:
    """Return V^-1 u of a landmark."""
    z0 = u0 * f[row, 0]
    z1 = (u1 - f[row, 1] * z0) * f[row, 2]
    z2 = (u2 - f[row, 3] * z0 - f[row, 4] * z1) * f[row, 5]
    d2 = z2 * f[row, 5]
    d1 = (z1 - f[row, 4] * d2) * f[row, 2]
    d0 = (z0 - f[row, 1] * d1 - f[row, 3] * d2) * f[row, 0]
    return d0, d1, d2


@compiled(forceinline=True)
def _subtract_pose(f: F64, row: int, W: F64, chunk: int, k: int, square: F64) -> None:
    """Subtract W' V^-1 W from the square of pose k; W (3, 6) is overwritten."""
    for c in range(6):
        y0 = W[0, c] * f[row, 0]
        y1 = (W[1, c] - f[row, 1] * y0) * f[row, 2]
        W[2, c] = (W[2, c] - f[row, 3] * y0 - f[row, 4] * y1) * f[row, 5]
        W[0, c], W[1, c] = y0, y1
    for c in range(6):
        for e in range(6):
            square[chunk, k, c, e] -= W[0, c] * W[0, e] + W[1, c] * W[1, e] + W[2, c] * W[2, e]


@compiled(parallel=True, fastmath={"contract", "nsz"})
def eliminate_landmarks(structure: Structure, kept: KeptSystem, square: F64, gradient: F64) -> None:
    """Subtract the landmarks' share from the diagonal blocks and from the gradient, by chunk.

    Observations of a landmark by several cameras of one vertex follow each other; their W = sum Q'P
    makes one block. Results are arguments of their own, not in a tuple: numba drops what a parallel
    loop writes by chunk into arrays unpacked from one.
    """
    start, vertex, chunk_start, _ = structure
    J, _, g, f = kept
    for chunk in prange(len(chunk_start) - 1):
        W = np.zeros((3, 6))
        for row in range(chunk_start[chunk], chunk_start[chunk + 1]):
            d0, d1, d2 = _solve_3x3(f, row, g[row, 0], g[row, 1], g[row, 2])
            last = start[row + 1]
            for o in range(start[row], last):
                k = vertex[o]
                e_u = J[o, 0] * d0 + J[o, 1] * d1 + J[o, 2] * d2
                e_v = J[o, 6] * d0 + J[o, 7] * d1 + J[o, 8] * d2
                for c in range(6):
                    u, v = np.float64(J[o, c]), np.float64(J[o, 6 + c])
                    if c < 3:
                        u, v = -u, -v
                    gradient[chunk, k, c] -= u * e_u + v * e_v
                    for i in range(3):
                        W[i, c] += J[o, i] * u + J[o, 6 + i] * v
                if o + 1 == last or vertex[o + 1] != k:
                    _subtract_pose(f, row, W, chunk, k, square)
                    W[:] = 0.0


@compiled(parallel=True, fastmath={"contract", "nsz", "reassoc"})
def multiply(structure: Structure, kept: KeptSystem, x: F64, y: F64) -> None:
    """Add S x by chunk to y (chunks, V, 6) for the steps x (V, 6) of the poses."""
    start, vertex, chunk_start, longest = structure
    J, _, _, f = kept
    for chunk in prange(len(chunk_start) - 1):
        t = np.empty((longest, 2))
        for row in range(chunk_start[chunk], chunk_start[chunk + 1]):
            first, last = start[row], start[row + 1]
            u0, u1, u2 = 0.0, 0.0, 0.0
            for o in range(first, last):
                k = vertex[o]
                p0, p1, p2 = x[k, 0], x[k, 1], x[k, 2]
                w0, w1, w2 = x[k, 3], x[k, 4], x[k, 5]
                a = J[o, 3] * w0 + J[o, 4] * w1 + J[o, 5] * w2
                a -= J[o, 0] * p0 + J[o, 1] * p1 + J[o, 2] * p2
                b = J[o, 9] * w0 + J[o, 10] * w1 + J[o, 11] * w2
                b -= J[o, 6] * p0 + J[o, 7] * p1 + J[o, 8] * p2
                t[o - first, 0], t[o - first, 1] = a, b
                u0 += J[o, 0] * a + J[o, 6] * b
                u1 += J[o, 1] * a + J[o, 7] * b
                u2 += J[o, 2] * a + J[o, 8] * b
            d0, d1, d2 = _solve_3x3(f, row, u0, u1, u2)
            for o in range(first, last):
                k = vertex[o]
                a = t[o - first, 0] - (J[o, 0] * d0 + J[o, 1] * d1 + J[o, 2] * d2)
                b = t[o - first, 1] - (J[o, 6] * d0 + J[o, 7] * d1 + J[o, 8] * d2)
                y[chunk, k, 0] -= J[o, 0] * a + J[o, 6] * b
                y[chunk, k, 1] -= J[o, 1] * a + J[o, 7] * b
                y[chunk, k, 2] -= J[o, 2] * a + J[o, 8] * b
                y[chunk, k, 3] += J[o, 3] * a + J[o, 9] * b
                y[chunk, k, 4] += J[o, 4] * a + J[o, 10] * b
                y[chunk, k, 5] += J[o, 5] * a + J[o, 11] * b


@compiled(fastmath={"contract", "nsz", "reassoc"})
def multiply_factors(nodes: I64, jacobian: F64, x: F64, y: F64) -> None:
    """Add J' (J x) of factors with Jacobians (N, m, 3 n) at nodes (N, n) to y; x, y (nodes, 3)."""
    rows, width = jacobian.shape[1], nodes.shape[1]
    local, back = np.empty(3 * width), np.empty(3 * width)
    for factor in range(len(nodes)):
        for a in range(width):
            for c in range(3):
                local[3 * a + c] = x[nodes[factor, a], c]
        back[:] = 0.0
        for r in range(rows):
            total = 0.0
            for c in range(3 * width):
                total += jacobian[factor, r, c] * local[c]
            for c in range(3 * width):
                back[c] += jacobian[factor, r, c] * total
        for a in range(width):
            for c in range(3):
                y[nodes[factor, a], c] += back[3 * a + c]
