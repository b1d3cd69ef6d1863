"""The compiled loops over the factors of a window that do not depend on camera models.

Rows of a frame begin at 15 frame: position, orientation, velocity, biases of gyroscope and
accelerometer. Only the lower triangle of the system's matrix is filled in.
"""

import numpy as np

from maplab_py.array_types import F64, I64, Mask
from maplab_py.compilation import compiled
from maplab_py.estimation.kernels import so3
from maplab_py.estimation.kernels.window_arguments import DenseSystem

_FAST = {"fastmath": {"contract", "nsz"}}
_LEAST_DETERMINANT = 1e-11
"""Two rays 4e-6 rad apart have this determinant."""


@compiled(**_FAST)
def add_factors(residual: F64, jacobian: F64, first_row: I64, system: DenseSystem) -> float:
    """Add whitened factors whose columns are consecutive rows of the system; return their cost.

    Args:
        residual: (N, m).
        jacobian: (N, m, D).
        first_row: Row (N,) of the system where the columns of a factor begin.
        system: Normal equations.
    """
    matrix, _, gradient, diagonal = system
    count, size, width = jacobian.shape
    total = 0.0
    for n in range(count):
        row = first_row[n]
        for m in range(size):
            r = residual[n, m]
            total += r * r
            for i in range(width):
                x = jacobian[n, m, i]
                if x == 0.0:
                    continue
                gradient[row + i] += x * r
                diagonal[row + i] += x * x
                for j in range(i + 1):
                    matrix[row + i, row + j] += x * jacobian[n, m, j]
    return 0.5 * total


@compiled(**_FAST)
def add_walks(motion: F64, weight: F64, system: DenseSystem) -> float:
    """Add the walk of both biases along every edge of the chain; return the cost.

    Args:
        motion: (F, 9) velocity and biases of the frames.
        weight: (F - 1, 2) inverse standard deviations of a component's change, gyroscope first.
        system: Normal equations, or no rows at all to get the cost only.
    """
    matrix, _, gradient, diagonal = system
    total = 0.0
    for edge in range(len(weight)):
        for i in range(6):
            w = weight[edge, i // 3]
            r = w * (motion[edge + 1, 3 + i] - motion[edge, 3 + i])
            total += r * r
            if len(gradient) == 0:
                continue
            a, b = 15 * edge + 9 + i, 15 * edge + 24 + i
            gradient[a] -= w * r
            gradient[b] += w * r
            diagonal[a] += w * w
            diagonal[b] += w * w
            matrix[a, a] += w * w
            matrix[b, b] += w * w
            matrix[b, a] -= w * w
    return 0.5 * total


@compiled()
def offsets(T_M_I: F64, motion: F64, from_T_M_I: F64, from_motion: F64, out: F64) -> None:
    """Compute the tangent vectors (15 F,) from some states of the frames to others."""
    q = np.empty(4)
    for k in range(len(T_M_I)):
        row = 15 * k
        q[0], q[1], q[2], q[3] = so3.conjugate_multiply(from_T_M_I[k], T_M_I[k])
        so3.log(q, out[row + 3 : row + 6])
        for i in range(3):
            out[row + i] = T_M_I[k, 4 + i] - from_T_M_I[k, 4 + i]
        for i in range(9):
            out[row + 6 + i] = motion[k, i] - from_motion[k, i]


@compiled()
def retract(T_M_I: F64, motion: F64, step: F64, new_T_M_I: F64, new_motion: F64) -> None:
    """Apply tangent vectors (15 F,) to the states of the frames: R exp(dtheta), everything else + d."""
    q = np.empty(4)
    for k in range(len(T_M_I)):
        row = 15 * k
        x, y, z = step[row + 3], step[row + 4], step[row + 5]
        angle2 = x * x + y * y + z * z
        if angle2 < 1e-8:  # Taylor, relative error < 1e-17
            half = 0.5 - angle2 / 48.0
            w = 1.0 - angle2 / 8.0 + angle2 * angle2 / 384.0
        else:
            angle = np.sqrt(angle2)
            half = np.sin(0.5 * angle) / angle
            w = np.cos(0.5 * angle)
        q[0], q[1], q[2], q[3] = so3.multiply(T_M_I[k], (half * x, half * y, half * z, w))
        norm = np.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
        for i in range(4):
            new_T_M_I[k, i] = q[i] / norm
        for i in range(3):
            new_T_M_I[k, 4 + i] = T_M_I[k, 4 + i] + step[row + i]
        for i in range(9):
            new_motion[k, i] = motion[k, i] + step[row + 6 + i]


@compiled()
def group(track: I64, rows: I64, tracks: int, order: I64, start: I64) -> None:
    """Find the observations of some tracks (R,), those of each in a row.

    Args:
        track: Track (O,) of every observation.
        rows: Tracks (R,).
        tracks: Number of all tracks.
        order: Result (O,) of which the last offset says how many are filled in.
        start: Result (R + 1,), offsets by track.
    """
    place = np.full(tracks, -1, dtype=np.int64)
    for n in range(len(rows)):
        place[rows[n]] = n
    start[:] = 0
    for n in track:
        if place[n] >= 0:
            start[place[n] + 1] += 1
    for n in range(len(rows)):
        start[n + 1] += start[n]
    filled = start[:-1].copy()
    for n in range(len(track)):
        at = place[track[n]]
        if at >= 0:
            order[filled[at]] = n
            filled[at] += 1


@compiled()
def camera_poses(T_M_I: F64, T_I_C: F64, R_M_C: F64, p_M_C: F64) -> None:
    """Compute rotations (F, C, 3, 3) and positions (F, C, 3) of all cameras in all frames."""
    q, R = np.empty(4), np.empty((3, 3))
    for k in range(len(T_M_I)):
        so3.to_matrix(T_M_I[k, :4], R)
        for c in range(len(T_I_C)):
            q[0], q[1], q[2], q[3] = so3.multiply(T_M_I[k], T_I_C[c])
            so3.to_matrix(q, R_M_C[k, c])
            for i in range(3):
                p_M_C[k, c, i] = T_M_I[k, 4 + i]
                for j in range(3):
                    p_M_C[k, c, i] += R[i, j] * T_I_C[c, 4 + j]


@compiled(**_FAST)
def triangulate(origin: F64, ray: F64, start: I64, p_M: F64, is_determined: Mask) -> None:
    """Find the points (L, 3) nearest to the lines of their rays; see `geometry.triangulation`.

    Args:
        origin: (O, 3) of the rays, those of one point in a row.
        ray: (O, 3) unit vectors.
        start: (L + 1,) offsets by point.
        p_M: Result (L, 3).
        is_determined: Result (L,): the rays are not parallel.
    """
    A, b = np.empty((3, 3)), np.empty(3)
    for n in range(len(start) - 1):
        first = start[n]
        A[:], b[:] = 0.0, 0.0
        for o in range(first, start[n + 1]):
            along = 0.0
            for i in range(3):  # about the first origin, so that nothing cancels
                along += ray[o, i] * (origin[o, i] - origin[first, i])
            for i in range(3):
                b[i] += origin[o, i] - origin[first, i] - along * ray[o, i]
                A[i, i] += 1.0
                for j in range(3):
                    A[i, j] -= ray[o, i] * ray[o, j]
        c0 = A[1, 1] * A[2, 2] - A[1, 2] * A[1, 2]
        c1 = A[0, 2] * A[1, 2] - A[0, 1] * A[2, 2]
        c2 = A[0, 1] * A[1, 2] - A[0, 2] * A[1, 1]
        c3 = A[0, 0] * A[2, 2] - A[0, 2] * A[0, 2]
        c4 = A[0, 1] * A[0, 2] - A[0, 0] * A[1, 2]
        c5 = A[0, 0] * A[1, 1] - A[0, 1] * A[0, 1]
        determinant = A[0, 0] * c0 + A[0, 1] * c1 + A[0, 2] * c2
        is_determined[n] = determinant > _LEAST_DETERMINANT
        p_M[n, 0] = origin[first, 0] + (c0 * b[0] + c1 * b[1] + c2 * b[2]) / determinant
        p_M[n, 1] = origin[first, 1] + (c1 * b[0] + c3 * b[1] + c4 * b[2]) / determinant
        p_M[n, 2] = origin[first, 2] + (c2 * b[0] + c4 * b[1] + c5 * b[2]) / determinant
