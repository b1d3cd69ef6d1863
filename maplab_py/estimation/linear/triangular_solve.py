"""Solution of L L^T x = b for several right sides, supernode by supernode.

A supernode's panel is [L11; L21], see `symbolic.FrontPlan`. Everything is sequential and ordered, so
results are the same bits each time.
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
from maplab_py.estimation.linear.symbolic import FrontPlan, most_below


@compiled()
def solve(plan: FrontPlan, factor: F64, right_sides: F64, blas: Blas) -> F64:
    """Return x (k, n * d) of L L^T x = b for right sides in rows (k, n * d)."""
    d, order = plan.node_size, plan.order
    k, total = right_sides.shape
    x = np.empty((k, total))
    for col in range(k):
        for place in range(len(order)):
            for r in range(d):
                x[col, place * d + r] = right_sides[col, order[place] * d + r]
    supernodes = len(plan.first_node) - 1
    gathered = np.empty((k, max(most_below(plan) * d, 1)))
    for s in range(supernodes):
        _solve_up(plan, s, factor, x, gathered, blas)
    for s in range(supernodes - 1, -1, -1):
        _solve_down(plan, s, factor, x, gathered, blas)
    result = np.empty((k, total))
    for col in range(k):
        for place in range(len(order)):
            for r in range(d):
                result[col, order[place] * d + r] = x[col, place * d + r]
    return result


@compiled()
def _solve_up(plan: FrontPlan, s: int, factor: F64, x: F64, gathered: F64, blas: Blas) -> None:
    """One supernode of L y = b: x1 <- L11^-1 x1, then x2 -= L21 x1 in the rows below."""
    d, (k, total), tallest = plan.node_size, x.shape, gathered.shape[1]
    first = plan.first_node[s] * d
    w = plan.first_node[s + 1] * d - first
    below = plan.below[plan.below_start[s] : plan.below_start[s + 1]]
    n = len(below) * d
    panel = factor[plan.panel_start[s] :]
    front, flat = x.reshape(-1)[first:], gathered.reshape(-1)
    solve_triangle(blas, LEFT, PLAIN, panel, w + n, front, w, k, total)
    if n == 0:
        return
    L21, x1, product = Matrix(panel[w:], w + n), Matrix(front, total), Matrix(flat, tallest)
    multiply(blas, (n, k, w), (PLAIN, PLAIN), L21, x1, (ONE, ZERO), product)
    for col in range(k):
        for i in range(len(below)):
            for r in range(d):
                x[col, below[i] * d + r] -= gathered[col, i * d + r]


@compiled()
def _solve_down(plan: FrontPlan, s: int, factor: F64, x: F64, gathered: F64, blas: Blas) -> None:
    """One supernode of L^T x = y: x1 <- L11^-T (x1 - L21^T x2)."""
    d, (k, total), tallest = plan.node_size, x.shape, gathered.shape[1]
    first = plan.first_node[s] * d
    w = plan.first_node[s + 1] * d - first
    below = plan.below[plan.below_start[s] : plan.below_start[s + 1]]
    n = len(below) * d
    panel = factor[plan.panel_start[s] :]
    front, flat = x.reshape(-1)[first:], gathered.reshape(-1)
    if n > 0:
        for col in range(k):
            for i in range(len(below)):
                for r in range(d):
                    gathered[col, i * d + r] = x[col, below[i] * d + r]
        L21, x1, x2 = Matrix(panel[w:], w + n), Matrix(front, total), Matrix(flat, tallest)
        multiply(blas, (w, k, n), (TRANSPOSED, PLAIN), L21, x2, (MINUS_ONE, ONE), x1)
    solve_triangle(blas, LEFT, TRANSPOSED, panel, w + n, front, w, k, total)
