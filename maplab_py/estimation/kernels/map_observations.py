"""The compiled loops over observations of a map by a window, whose base frame T_G_M is a state.

Columns are those of the poses of all frames, six each, and then of the base frame.
"""

import math

from maplab_py.array_types import F64, I32, I64, Mask
from maplab_py.compilation import compiled
from maplab_py.estimation.kernels.loss import rho_and_weight

_FAST = {"fastmath": {"contract", "nsz"}}


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
