"""The compiled loops over observations of a map by a window, whose base frame T_G_M is a state.

Columns are those of the poses of all frames, six each, and then of the base frame.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from maplab_py.array_types import F64, I32, I64, Mask
from maplab_py.compilation import compiled
from maplab_py.estimation.kernels.loss import rho_and_weight

_FAST = {"fastmath": {"contract", "nsz"}}


class MapView(NamedTuple):
    """The O observations of a camera, and which points it can see."""

    frame: I32  # (O,) of the window
    landmark: I64  # (O,)
    R_I_C: F64  # (3, 3)
    p_I_C: F64  # (3,)
    limits: F64  # (4,) see `sensors.projection.visibility_limits`


@compiled(**_FAST)
def fill_arguments(
    view: MapView,
    T_M_I: F64,
    R_M_I: F64,
    T_G_M: F64,
    p_G: F64,
    p_M: F64,
    arguments: F64,
    visible: Mask,
) -> None:
    """Fill in the states that a residual depends on, and whether the landmark is visible.

    Args:
        view: The observations.
        T_M_I: Poses (F, 7) of the frames.
        R_M_I: Their rotations (F, 3, 3).
        T_G_M: Base frame (7,).
        p_G: Landmarks (A, 3).
        p_M: The same in M (A, 3).
        arguments: Output (O, n): T_M_I, T_G_M, others, p_G, others (2).
        visible: Output (O,).
    """
    end = arguments.shape[1] - 5
    xi, least_z, cone, radius = view.limits
    R, t = view.R_I_C, view.p_I_C
    for n in range(len(view.frame)):
        k, a = view.frame[n], view.landmark[n]
        for i in range(7):
            arguments[n, i] = T_M_I[k, i]
            arguments[n, 7 + i] = T_G_M[i]
        for i in range(3):
            arguments[n, end + i] = p_G[a, i]
        x = p_M[a, 0] - T_M_I[k, 4]
        y = p_M[a, 1] - T_M_I[k, 5]
        z = p_M[a, 2] - T_M_I[k, 6]
        b = R_M_I[k, 0, 0] * x + R_M_I[k, 1, 0] * y + R_M_I[k, 2, 0] * z - t[0]
        c = R_M_I[k, 0, 1] * x + R_M_I[k, 1, 1] * y + R_M_I[k, 2, 1] * z - t[1]
        d = R_M_I[k, 0, 2] * x + R_M_I[k, 1, 2] * y + R_M_I[k, 2, 2] * z - t[2]
        u = R[0, 0] * b + R[1, 0] * c + R[2, 0] * d
        v = R[0, 1] * b + R[1, 1] * c + R[2, 1] * d
        w = R[0, 2] * b + R[1, 2] * c + R[2, 2] * d
        length = math.sqrt(u * u + v * v + w * w)
        depth = w + xi * length
        visible[n] = (
            depth > least_z and w > -cone * length and math.sqrt(u * u + v * v) < radius * depth
        )


@compiled(**_FAST)
def weigh(
    kind: int, residual: F64, visible: Mask, c2: float, behind: float, rho: F64, root: F64
) -> None:
    """Fill in rho (O,) of whitened residuals (O, 2), and the square roots (O,) of robust weights.

    A landmark that is not visible has the squared residual `behind` and no weight.
    """
    for n in range(len(residual)):
        square = behind
        if visible[n]:
            square = residual[n, 0] * residual[n, 0] + residual[n, 1] * residual[n, 1]
        rho[n], weight = rho_and_weight(kind, square, c2)
        root[n] = math.sqrt(weight) if visible[n] else 0.0


@compiled(**_FAST)
def sum_observations(
    frame: I32, residual: F64, jacobian: F64, root: F64, square: F64, gradient: F64
) -> None:
    """Add the normal equations of observations with weights.

    Args:
        frame: Frame (O,) of each.
        residual: (O, 2).
        jacobian: (O, 2, 12 or more) by the frame's pose and by the base frame.
        root: Square root (O,) of the weight.
        square: Lower triangle of (N, N), N = 6 F + 6, summed in place.
        gradient: (N,), summed in place.
    """
    base = len(gradient) - 6
    for n in range(len(frame)):
        weight = root[n] * root[n]
        if weight == 0.0:
            continue
        row = 6 * frame[n]
        for m in range(2):
            r = weight * residual[n, m]
            for i in range(6):
                x, y = jacobian[n, m, i], jacobian[n, m, 6 + i]
                gradient[row + i] += x * r
                gradient[base + i] += y * r
                x, y = weight * x, weight * y
                for j in range(i + 1):
                    square[row + i, row + j] += x * jacobian[n, m, j]
                    square[base + i, base + j] += y * jacobian[n, m, 6 + j]
                for j in range(6):
                    square[base + i, row + j] += y * jacobian[n, m, j]


@compiled(**_FAST)
def add_square(square: F64, columns: I64, matrix: F64) -> None:
    """Add the lower triangle of (N, N) to that of a matrix, at rows and columns (N,), ascending."""
    for i in range(len(columns)):
        row = columns[i]
        for j in range(i + 1):
            matrix[row, columns[j]] += square[i, j]
