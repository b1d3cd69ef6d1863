"""The inverse at the positions of the factor, from the roots of the elimination tree to its leaves.

Takahashi 1973; Erisman and Tinney 1975: with [L11; L21] the panel of a supernode, Y = L21 L11^-1 and
Z = A^-1,

    Z21 = -Z22 Y,    Z11 = L11^-T L11^-1 - Y^T Z21,

where Z22 lies in the panels of the supernode's ancestors, which come first.
"""

from __future__ import annotations

import numpy as np

from maplab_py.array_types import F64
from maplab_py.compilation import compiled
from maplab_py.estimation.linear.dense_kernels import (
    LEFT,
    MINUS_ONE,
    ONE,
    PLAIN,
    TRANSPOSED,
    ZERO,
    Blas,
    Matrix,
    multiply,
    solve_triangle,
)
from maplab_py.estimation.linear.symbolic import FrontPlan


@compiled()
def invert_panels(plan: FrontPlan, factor: F64, blas: Blas) -> F64:
    """Return the inverse at the positions of the factor: panels [Z11; Z21] laid out as L's."""
    d = plan.node_size
    inverse = np.empty(len(factor))
    for s in range(len(plan.first_node) - 2, -1, -1):
        w = (plan.first_node[s + 1] - plan.first_node[s]) * d
        n = (plan.below_start[s + 1] - plan.below_start[s]) * d
        z22 = _gather(plan, s, inverse)
        panel = inverse[plan.panel_start[s] : plan.panel_start[s + 1]].reshape(w, w + n)
        _invert_panel(blas, factor[plan.panel_start[s] :], z22, panel)
    return inverse


@compiled()
def _gather(plan: FrontPlan, s: int, inverse: F64) -> F64:
    """Return the inverse (n, n) over the rows below a supernode, from its ancestors' panels."""
    d, start = plan.node_size, plan.below_start[s]
    rows = plan.below_start[s + 1] - start
    z22 = np.empty((rows * d, rows * d))
    local = plan.below_in_parent[start : start + rows].copy()
    begin, front = 0, plan.parent[s]
    while begin < rows:
        width = plan.first_node[front + 1] - plan.first_node[front]
        end = begin
        while end < rows and local[end] < width:
            end += 1
        panel = inverse[plan.panel_start[front] : plan.panel_start[front + 1]]
        panel_columns = panel.reshape(width * d, -1)
        for j in range(begin, end):
            for c in range(d):
                column = panel_columns[local[j] * d + c]
                for i in range(begin, rows):
                    for r in range(d):
                        z22[i * d + r, j * d + c] = column[local[i] * d + r]
                        z22[j * d + c, i * d + r] = column[local[i] * d + r]
        below = plan.below_start[front] - width
        for i in range(end, rows):
            local[i] = plan.below_in_parent[below + local[i]]
        begin, front = end, plan.parent[front]
    return z22


@compiled()
def _invert_panel(blas: Blas, factor: F64, z22: F64, panel: F64) -> None:
    """Write the inverse [Z11; Z21], column after column, to panel (w, w + n).

    Args:
        blas: Workspace.
        factor: Panel of L.
        z22: Inverse (n, n) over the rows below.
        panel: Result; both triangles of Z11.
    """
    w, n = len(panel), len(z22)
    unit = np.eye(w).reshape(-1)
    solve_triangle(blas, LEFT, PLAIN, factor, w + n, unit, w, w, w)  # now L11^-1
    z11 = np.empty((w, w))
    inverse, Z11 = Matrix(unit, w), Matrix(z11.reshape(-1), w)
    multiply(blas, (w, w, w), (TRANSPOSED, PLAIN), inverse, inverse, (ONE, ZERO), Z11)
    if n > 0:
        y, z21 = np.empty(w * n), np.empty(w * n)  # column after column
        L21, Z22 = Matrix(factor[w:], w + n), Matrix(z22.reshape(-1), n)
        Y, Z21 = Matrix(y, n), Matrix(z21, n)
        multiply(blas, (n, w, w), (PLAIN, PLAIN), L21, inverse, (ONE, ZERO), Y)
        multiply(blas, (n, w, n), (PLAIN, PLAIN), Z22, Y, (MINUS_ONE, ZERO), Z21)
        multiply(blas, (w, w, n), (TRANSPOSED, PLAIN), Y, Z21, (MINUS_ONE, ONE), Z11)
        for i in range(w):
            panel[i, w:] = z21[i * n : (i + 1) * n]
    for i in range(w):
        for j in range(w):
            panel[i, j] = 0.5 * (z11[i, j] + z11[j, i])
