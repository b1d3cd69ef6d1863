"""Solution of L L^T x = b for one right side: plain loops, as BLAS takes longer to be called.

Panels of L are columns of a front, see `symbolic.FrontPlan`; each is read once on the way up the
tree and once on the way down. The order of sums is fixed.
"""

from typing import Any

import numpy as np

from maplab_py.array_types import F64
from maplab_py.compilation import compiled
from maplab_py.estimation.linear.symbolic import FrontPlan, most_below


@compiled(fastmath={"reassoc", "contract"})
def _dot(a: F64, b: F64) -> float:
    total = 0.0
    for i in range(len(a)):
        total += a[i] * b[i]
    return total


@compiled(fastmath={"contract"})
def _subtract(a: F64, factor: float, result: F64) -> None:
    for i in range(len(a)):
        result[i] -= factor * a[i]


@compiled()
def solve_single(plan: FrontPlan, factor: F64, right_side: F64) -> F64:
    """Return x (n * d,) of L L^T x = b for one right side (n * d,)."""
    d, order = plan.node_size, plan.order
    x = np.empty(len(right_side))
    for place in range(len(order)):
        for r in range(d):
            x[place * d + r] = right_side[order[place] * d + r]
    supernodes = len(plan.first_node) - 1
    gathered = np.empty(most_below(plan) * d)
    for s in range(supernodes):
        _up(plan, s, factor, x, gathered)
    for s in range(supernodes - 1, -1, -1):
        _down(plan, s, factor, x, gathered)
    result = np.empty(len(x))
    for place in range(len(order)):
        for r in range(d):
            result[order[place] * d + r] = x[place * d + r]
    return result


@compiled(forceinline=True)
def _parts(plan: FrontPlan, s: int, factor: F64, x: F64, gathered: F64) -> Any:
    """Return node size, columns w, nodes below, panel (w, w + rows below), x1 and room for x2."""
    d = plan.node_size
    below = plan.below[plan.below_start[s] : plan.below_start[s + 1]]
    first, w = plan.first_node[s] * d, (plan.first_node[s + 1] - plan.first_node[s]) * d
    rows = len(below) * d
    panel = factor[plan.panel_start[s] : plan.panel_start[s + 1]].reshape(w, w + rows)
    return d, w, below, panel, x[first : first + w], gathered[:rows]


@compiled()
def _up(plan: FrontPlan, s: int, factor: F64, x: F64, gathered: F64) -> None:
    """One supernode of L y = b: x1 <- L11^-1 x1, then x2 -= L21 x1 in the rows below."""
    d, w, below, panel, front, rest = _parts(plan, s, factor, x, gathered)
    rest[:] = 0.0
    for j in range(w):
        column = panel[j]
        front[j] /= column[j]
        _subtract(column[j + 1 : w], front[j], front[j + 1 :])
        _subtract(column[w:], front[j], rest)
    for i in range(len(below)):
        for r in range(d):
            x[below[i] * d + r] += rest[i * d + r]


@compiled()
def _down(plan: FrontPlan, s: int, factor: F64, x: F64, gathered: F64) -> None:
    """One supernode of L^T x = y: x1 <- L11^-T (x1 - L21^T x2)."""
    d, w, below, panel, front, rest = _parts(plan, s, factor, x, gathered)
    for i in range(len(below)):
        for r in range(d):
            rest[i * d + r] = x[below[i] * d + r]
    for j in range(w - 1, -1, -1):
        column = panel[j]
        known = _dot(column[j + 1 : w], front[j + 1 :]) + _dot(column[w:], rest)
        front[j] = (front[j] - known) / column[j]
