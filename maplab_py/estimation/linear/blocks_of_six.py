"""Panels of nodes of six numbers, by vector instructions on blocks of 6 x 6: BLAS takes longer to be called.

A panel (R, 6) has its columns one after another, each of them `leading` rows of six numbers. A block is
named by the first row of its first column. What is above the diagonal is written, too; nobody reads it.
"""

import math

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.compilation import compiled
from maplab_py.estimation.codegen.straight_line import row, rows_of_six
from maplab_py.estimation.linear.dense_kernels import Matrix


@rows_of_six
def _subtract_product(
    result: F64, rows: F64, target: int, step: int, left: int, right: int, leading: int
) -> None:
    """Subtract left right^T, blocks of the same columns, from a block whose columns are `step` apart."""
    x0 = rows[left]
    x1 = rows[left + leading]
    x2 = rows[left + 2 * leading]
    x3 = rows[left + 3 * leading]
    x4 = rows[left + 4 * leading]
    x5 = rows[left + 5 * leading]
    for c in range(6):
        product = x0 * rows[right, c] + x1 * rows[right + leading, c]
        product = product + x2 * rows[right + 2 * leading, c] + x3 * rows[right + 3 * leading, c]
        product = product + x4 * rows[right + 4 * leading, c] + x5 * rows[right + 5 * leading, c]
        result[target + c * step] = result[target + c * step] - product


@rows_of_six
def _factorise_block(rows: F64, at: int, leading: int, inverse: F64) -> None:
    """Overwrite a block by its Cholesky factor; `inverse` (1, 6) becomes one over the diagonal."""
    x0 = rows[at]
    p0 = 1.0 / math.sqrt(x0[0])
    x0 = x0 * p0
    x1 = rows[at + leading] - x0 * x0[1]
    p1 = 1.0 / math.sqrt(x1[1])
    x1 = x1 * p1
    x2 = rows[at + 2 * leading] - x0 * x0[2] - x1 * x1[2]
    p2 = 1.0 / math.sqrt(x2[2])
    x2 = x2 * p2
    x3 = rows[at + 3 * leading] - x0 * x0[3] - x1 * x1[3] - x2 * x2[3]
    p3 = 1.0 / math.sqrt(x3[3])
    x3 = x3 * p3
    x4 = rows[at + 4 * leading] - x0 * x0[4] - x1 * x1[4] - x2 * x2[4] - x3 * x3[4]
    p4 = 1.0 / math.sqrt(x4[4])
    x4 = x4 * p4
    x5 = rows[at + 5 * leading] - x0 * x0[5] - x1 * x1[5] - x2 * x2[5] - x3 * x3[5] - x4 * x4[5]
    p5 = 1.0 / math.sqrt(x5[5])
    rows[at] = x0
    rows[at + leading] = x1
    rows[at + 2 * leading] = x2
    rows[at + 3 * leading] = x3
    rows[at + 4 * leading] = x4
    rows[at + 5 * leading] = x5 * p5
    inverse[0] = row(p0, p1, p2, p3, p4, p5)


@rows_of_six
def _solve_block(rows: F64, at: int, factor: int, leading: int, inverse: F64) -> None:
    """Overwrite a block by itself times the inverse of the transposed factor of its columns."""
    x0 = rows[at] * inverse[0, 0]
    x1 = (rows[at + leading] - x0 * rows[factor, 1]) * inverse[0, 1]
    x2 = rows[at + 2 * leading] - x0 * rows[factor, 2] - x1 * rows[factor + leading, 2]
    x2 = x2 * inverse[0, 2]
    x3 = rows[at + 3 * leading] - x0 * rows[factor, 3] - x1 * rows[factor + leading, 3]
    x3 = (x3 - x2 * rows[factor + 2 * leading, 3]) * inverse[0, 3]
    x4 = rows[at + 4 * leading] - x0 * rows[factor, 4] - x1 * rows[factor + leading, 4]
    x4 = x4 - x2 * rows[factor + 2 * leading, 4] - x3 * rows[factor + 3 * leading, 4]
    x4 = x4 * inverse[0, 4]
    x5 = rows[at + 5 * leading] - x0 * rows[factor, 5] - x1 * rows[factor + leading, 5]
    x5 = x5 - x2 * rows[factor + 2 * leading, 5] - x3 * rows[factor + 3 * leading, 5]
    x5 = (x5 - x4 * rows[factor + 4 * leading, 5]) * inverse[0, 5]
    rows[at] = x0
    rows[at + leading] = x1
    rows[at + 2 * leading] = x2
    rows[at + 3 * leading] = x3
    rows[at + 4 * leading] = x4
    rows[at + 5 * leading] = x5


@compiled()
def factorise_blocks(panel: F64, width: int, inverse: F64) -> int:
    """Overwrite a panel [F11; F21] of `width` nodes by [L11; L21]; return 0 or the bad column plus one.

    Args:
        panel: Rows of six (R, 6).
        width: Nodes of the panel's columns.
        inverse: Room (1, 6).
    """
    leading = len(panel) // (6 * width)
    for j in range(width):
        column = 6 * j * leading
        for k in range(j):
            left = 6 * k * leading
            for i in range(j, leading):
                _subtract_product(panel, panel, column + i, leading, left + i, left + j, leading)
        _factorise_block(panel, column + j, leading, inverse)
        for c in range(6):
            if not 0.0 < panel[column + j + c * leading, c] < np.inf:
                return 6 * j + c + 1
        for i in range(j + 1, leading):
            _solve_block(panel, column + i, column + j, leading, inverse)
    return 0


@compiled()
def subtract_square(L: Matrix, width: int, local: I64, cols: int, target: Matrix) -> None:
    """Subtract the part of L21 L21^T that belongs to the panel of an ancestor.

    Args:
        L: L21 from the first row of the part on.
        width: Nodes of its columns.
        local: Local node in the ancestor's front of every node of the part's rows.
        cols: Nodes of the part's columns, which are those of its first rows.
        target: Panel.
    """
    rows, result = L.values.reshape(-1, 6), target.values.reshape(-1, 6)
    leading, step = L.leading // 6, target.leading // 6
    for j in range(cols):
        column = 6 * local[j] * step
        for i in range(j, len(local)):
            for k in range(width):
                left = 6 * k * leading
                _subtract_product(
                    result, rows, column + local[i], step, left + i, left + j, leading
                )


@rows_of_six
def add_transposed(numbers: F64, at: int, leading: int, values: F64, block: int) -> None:
    """Add the transposed block of some (B, 6, 6) to a block of a panel."""
    for c in range(6):
        numbers[at + c * leading] = numbers[at + c * leading] + values[block, c]


@rows_of_six
def add_block(numbers: F64, at: int, leading: int, values: F64, block: int) -> None:
    """Add a block of some (B, 6, 6) to a block of a panel."""
    for c in range(6):
        column = row(
            values[block, 0, c],
            values[block, 1, c],
            values[block, 2, c],
            values[block, 3, c],
            values[block, 4, c],
            values[block, 5, c],
        )
        numbers[at + c * leading] = numbers[at + c * leading] + column
