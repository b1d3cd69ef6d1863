"""Numeric part of the supernodal multifrontal Cholesky factorisation A = L L^T (Liu 1992).

The supernodes are visited from the leaves of the elimination tree to its roots. Each one has a
FRONT, a dense symmetric matrix over its own rows (width w) and the rows below (n of them):

    [ F11      ]   first w columns: assembled from the blocks of A plus the children's updates
    [ F21  F22 ]   F22: the children's updates only

    L11 L11^T = F11            dpotrf
    L21 = F21 L11^-T           dtrsm
    U = F22 - L21 L21^T        dsyrk: the update matrix, which waits for the parent

[L11; L21] is the supernode's panel of the factor. In postorder the update matrices that a front
needs are always those on top of a stack, so one array holds them all.

The inverse at the positions of the factor (`invert_panels`) runs the same tree from the roots to
the leaves (Takahashi 1973; Erisman and Tinney 1975): with Y = L21 L11^-1 and Z = A^-1

    Z21 = -Z22 Y,    Z11 = L11^-T L11^-1 - Y^T Z21,

where Z22 is part of what the parent has computed already.

Matrices are column-major as BLAS wants them: a numpy view `panel[column, row]`. Everything here is
sequential and ordered, so results are the same bits each time.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from maplab_py.compilation import compiled
from maplab_py.estimation.linear.blas import dgemm, dpotrf, dsyrk, dtrsm
from maplab_py.estimation.linear.symbolic import FrontPlan

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

LEFT, RIGHT = 0, 1  # places in Blas.letters
PLAIN, TRANSPOSED = 2, 3
ONE, MINUS_ONE, ZERO = 0, 1, 2  # places in Blas.factors


class Blas(NamedTuple):
    """Letters, factors and sizes, which BLAS takes by address."""

    letters: NDArray[np.int8]
    factors: F64
    sizes: NDArray[np.int32]

    @classmethod
    def workspace(cls) -> Blas:
        """Make what the wrappers below need; not to be shared between threads."""
        letters = np.frombuffer(b"LRNT", dtype=np.int8).copy()
        return cls(letters, np.array([1.0, -1.0, 0.0]), np.zeros(8, dtype=np.int32))


# -- BLAS on flat arrays: every matrix comes with its leading dimension ----------------------------


@compiled()
def _cholesky(blas: Blas, matrix: F64, order: int, leading: int) -> int:
    """Factorise the leading square of `matrix` in place; return 0 or the bad column plus one."""
    sizes = blas.sizes
    sizes[0], sizes[1], sizes[2] = order, leading, 0
    lower = blas.letters[LEFT:]  # the same letter L
    dpotrf(lower.ctypes, sizes[0:].ctypes, matrix.ctypes, sizes[1:].ctypes, sizes[2:].ctypes)
    bad_column = int(sizes[2])
    for column in range(order if bad_column == 0 else 0):  # OpenBLAS lets NaN pass
        if not 0.0 < matrix[column * leading + column] < np.inf:
            return column + 1
    return bad_column


@compiled()
def _solve_triangle(
    blas: Blas,
    side: int,
    form: int,
    triangle: F64,
    leading: int,
    right: F64,
    rows: int,
    cols: int,
    right_leading: int,
) -> None:
    """Overwrite right (rows, cols) by op(triangle)^-1 right (LEFT) or right op(triangle)^-1.

    The triangle is lower; `form` PLAIN or TRANSPOSED says what op is.
    """
    letters, sizes = blas.letters, blas.sizes
    sizes[0], sizes[1], sizes[2], sizes[3] = rows, cols, leading, right_leading
    dtrsm(
        letters[side:].ctypes,
        letters[LEFT:].ctypes,
        letters[form:].ctypes,
        letters[PLAIN:].ctypes,  # N: the diagonal is not all ones
        sizes[0:].ctypes,
        sizes[1:].ctypes,
        blas.factors[ONE:].ctypes,
        triangle.ctypes,
        sizes[2:].ctypes,
        right.ctypes,
        sizes[3:].ctypes,
    )


@compiled()
def _subtract_square(
    blas: Blas, factor: F64, leading: int, rows: int, cols: int, keep: int, result: F64
) -> None:
    """Overwrite the lower triangle of result (rows, rows) by keep result - factor factor^T.

    The factor is (rows, cols).
    """
    letters, sizes = blas.letters, blas.sizes
    sizes[0], sizes[1], sizes[2], sizes[3] = rows, cols, leading, rows
    dsyrk(
        letters[LEFT:].ctypes,
        letters[PLAIN:].ctypes,
        sizes[0:].ctypes,
        sizes[1:].ctypes,
        blas.factors[MINUS_ONE:].ctypes,
        factor.ctypes,
        sizes[2:].ctypes,
        blas.factors[keep:].ctypes,
        result.ctypes,
        sizes[3:].ctypes,
    )


@compiled()
def _multiply(
    blas: Blas,
    shape: tuple[int, int, int],
    form_a: int,
    a: F64,
    a_leading: int,
    b: F64,
    b_leading: int,
    sign: int,
    keep: int,
    c: F64,
    c_leading: int,
) -> None:
    """Overwrite c by sign op(a) b + keep c; shape = rows of c, columns of c, inner size."""
    letters, factors, sizes = blas.letters, blas.factors, blas.sizes
    sizes[0], sizes[1], sizes[2] = shape
    sizes[3], sizes[4], sizes[5] = a_leading, b_leading, c_leading
    dgemm(
        letters[form_a:].ctypes,
        letters[PLAIN:].ctypes,
        sizes[0:].ctypes,
        sizes[1:].ctypes,
        sizes[2:].ctypes,
        factors[sign:].ctypes,
        a.ctypes,
        sizes[3:].ctypes,
        b.ctypes,
        sizes[4:].ctypes,
        factors[keep:].ctypes,
        c.ctypes,
        sizes[5:].ctypes,
    )


# -- factorisation, from the leaves up -------------------------------------------------------------


@compiled()
def _add_matrix_blocks(plan: FrontPlan, supernode: int, values: F64, panel: F64) -> None:
    """Add the matrix' blocks of one supernode to its panel[column, row]."""
    d = plan.node_size
    for block in plan.block_of[plan.block_start[supernode] : plan.block_start[supernode + 1]]:
        row, col = plan.block_row[block] * d, plan.block_col[block] * d
        if plan.block_is_transposed[block]:
            for c in range(d):
                for r in range(d):
                    panel[col + c, row + r] += values[block, c, r]
        else:
            for c in range(d):
                for r in range(d):
                    panel[col + c, row + r] += values[block, r, c]


@compiled()
def _add_child_update(panel: F64, update: F64, child: F64, place: I64, d: int, runs: I64) -> None:
    """Add a child's update matrix to a front ("extend-add").

    Rows of the child that are neighbours in the front as well make one run, and whole runs are
    added at a time.

    Args:
        panel: First columns of the front, [column, row] (w, w + n).
        update: The others, [column, row] (n, n).
        child: The child's update matrix, [column, row], lower triangle.
        place: Local node of the front for every node of the child's matrix, ascending.
        d: Rows of a node.
        runs: Room (nodes + 1, 2) for the first row of every run in the child and in the front.
    """
    width = panel.shape[0]
    count = 0
    for node in range(len(place)):
        if node == 0 or place[node] != place[node - 1] + 1:
            runs[count, 0], runs[count, 1] = node * d, place[node] * d
            count += 1
    runs[count, 0] = len(place) * d
    for run in range(count):
        for j in range(runs[run, 0], runs[run + 1, 0]):
            col = runs[run, 1] + j - runs[run, 0]
            source = child[j]
            target, before = (panel[col], 0) if col < width else (update[col - width], width)
            for other in range(run, count):
                shift = runs[other, 1] - runs[other, 0] - before
                for i in range(max(j, runs[other, 0]), runs[other + 1, 0]):
                    target[i + shift] += source[i]


@compiled()
def _clear_triangle(matrix: F64) -> None:
    for col in range(len(matrix)):
        matrix[col, col:] = 0.0


@compiled()
def _copy_triangle(matrix: F64, result: F64) -> None:
    for col in range(len(matrix)):
        for row in range(col, len(matrix)):
            result[col, row] = matrix[col, row]


@compiled()
def _most_below(plan: FrontPlan) -> int:
    """Return the largest number of nodes below a supernode."""
    most = 0
    for s in range(len(plan.first_node) - 1):
        most = max(most, plan.below_start[s + 1] - plan.below_start[s])
    return most


@compiled()
def factorise(plan: FrontPlan, values: F64, factor: F64, front: F64, stack: F64, blas: Blas) -> int:
    """Compute the panels of L into `factor`; return -1 or the position that has no pivot.

    Args:
        plan: Structure.
        values: Blocks of the matrix (B, d, d).
        factor: Room for the panels.
        front: Room for the largest update matrix, kept from its beginning on.
        stack: Room for the waiting update matrices.
        blas: Workspace.
    """
    d = plan.node_size
    supernodes = len(plan.first_node) - 1
    top = 0  # first free number of the stack
    waiting = np.empty(supernodes, np.int64)  # supernodes whose updates are on the stack
    num_waiting = 0
    runs = np.empty((_most_below(plan) + 1, 2), np.int64)
    for s in range(supernodes):
        w = (plan.first_node[s + 1] - plan.first_node[s]) * d
        n = (plan.below_start[s + 1] - plan.below_start[s]) * d
        panel = factor[plan.panel_start[s] : plan.panel_start[s + 1]].reshape(w, w + n)
        panel[:] = 0.0
        update = front[: n * n].reshape(n, n)
        is_leaf = plan.child_count[s] == 0
        if not is_leaf:
            _clear_triangle(update)
        _add_matrix_blocks(plan, s, values, panel)
        for _ in range(plan.child_count[s]):
            num_waiting -= 1
            child = waiting[num_waiting]
            place = plan.below_in_parent[plan.below_start[child] : plan.below_start[child + 1]]
            rows = len(place) * d
            top -= rows * rows
            child_update = stack[top : top + rows * rows].reshape(rows, rows)
            _add_child_update(panel, update, child_update, place, d, runs)
        triangle = panel.reshape(-1)
        bad_column = _cholesky(blas, triangle, w, w + n)
        if bad_column != 0:
            return int(plan.first_node[s] + (bad_column - 1) // d)
        if n > 0:
            below = factor[plan.panel_start[s] + w :]  # L21 starts below L11 in every column
            _solve_triangle(blas, RIGHT, TRANSPOSED, triangle, w + n, below, n, w, w + n)
            waits = stack[top : top + n * n]
            if is_leaf:
                _subtract_square(blas, below, w + n, n, w, ZERO, waits)
            else:
                _subtract_square(blas, below, w + n, n, w, ONE, front)
                _copy_triangle(update, waits.reshape(n, n))
            top += n * n
            waiting[num_waiting] = s
            num_waiting += 1
    return -1


# -- solution --------------------------------------------------------------------------------------


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
    gathered = np.empty((k, max(_most_below(plan) * d, 1)))
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
    own, flat = x.reshape(-1)[first:], gathered.reshape(-1)
    _solve_triangle(blas, LEFT, PLAIN, panel, w + n, own, w, k, total)
    if n == 0:
        return
    shape = (n, k, w)
    _multiply(blas, shape, PLAIN, panel[w:], w + n, own, total, ONE, ZERO, flat, tallest)
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
    own, flat = x.reshape(-1)[first:], gathered.reshape(-1)
    if n > 0:
        for col in range(k):
            for i in range(len(below)):
                for r in range(d):
                    gathered[col, i * d + r] = x[col, below[i] * d + r]
        shape = (w, k, n)
        _multiply(
            blas, shape, TRANSPOSED, panel[w:], w + n, flat, tallest, MINUS_ONE, ONE, own, total
        )
    _solve_triangle(blas, LEFT, TRANSPOSED, panel, w + n, own, w, k, total)


# -- inverse at the positions of the factor, from the roots down -----------------------------------


@compiled()
def invert_panels(plan: FrontPlan, factor: F64, stack: F64, blas: Blas) -> F64:
    """Return the inverse at the positions of the factor: panels [Z11; Z21] laid out as L's.

    `stack` needs the room of the factorisation's: every front leaves there, for each of its
    children, the inverse over the child's rows below. The last child comes to lie on top, and it
    is the next supernode of the walk down.
    """
    d = plan.node_size
    inverse = np.empty(len(factor))
    children, child_start = _children(plan)
    top = 0
    for s in range(len(plan.first_node) - 2, -1, -1):
        w = (plan.first_node[s + 1] - plan.first_node[s]) * d
        n = (plan.below_start[s + 1] - plan.below_start[s]) * d
        top -= n * n
        z22 = stack[top : top + n * n].reshape(n, n)
        panel = factor[plan.panel_start[s] :]
        z = _invert_front(blas, panel, w, n, z22)
        own_panel = inverse[plan.panel_start[s] : plan.panel_start[s + 1]].reshape(w, w + n)
        for i in range(w):
            for j in range(w + n):
                own_panel[i, j] = z[i, j]
        for child in children[child_start[s] : child_start[s + 1]]:
            place = plan.below_in_parent[plan.below_start[child] : plan.below_start[child + 1]]
            rows = len(place) * d
            part = stack[top : top + rows * rows].reshape(rows, rows)
            for j in range(len(place)):
                for c in range(d):
                    for i in range(len(place)):
                        for r in range(d):
                            part[j * d + c, i * d + r] = z[place[j] * d + c, place[i] * d + r]
            top += rows * rows
    return inverse


@compiled()
def _invert_front(blas: Blas, panel: F64, w: int, n: int, z22: F64) -> F64:
    """Return the inverse over a front (w + n, w + n) from its panel of L and Z22 (n, n)."""
    z = np.empty((w + n, w + n))
    unit = np.eye(w).reshape(-1)
    _solve_triangle(blas, LEFT, PLAIN, panel, w + n, unit, w, w, w)  # now L11^-1
    z11 = np.empty((w, w))
    _multiply(blas, (w, w, w), TRANSPOSED, unit, w, unit, w, ONE, ZERO, z11.reshape(-1), w)
    if n > 0:
        y, z21 = np.empty(w * n), np.empty(w * n)  # column after column
        _multiply(blas, (n, w, w), PLAIN, panel[w:], w + n, unit, w, ONE, ZERO, y, n)
        _multiply(blas, (n, w, n), PLAIN, z22.reshape(-1), n, y, n, MINUS_ONE, ZERO, z21, n)
        _multiply(blas, (w, w, n), TRANSPOSED, y, n, z21, n, MINUS_ONE, ONE, z11.reshape(-1), w)
        for i in range(w):
            for j in range(n):
                z[i, w + j] = z[w + j, i] = z21[i * n + j]
        for i in range(n):
            for j in range(n):
                z[w + i, w + j] = z22[i, j]
    for i in range(w):
        for j in range(w):
            z[i, j] = 0.5 * (z11[i, j] + z11[j, i])
    return z


@compiled()
def _children(plan: FrontPlan) -> tuple[I64, I64]:
    """Return the children of every supernode, ascending: (children, offsets (S + 1,))."""
    supernodes = len(plan.first_node) - 1
    start = np.zeros(supernodes + 1, np.int64)
    for s in range(supernodes):
        start[s + 1] = start[s] + plan.child_count[s]
    children = np.empty(start[supernodes], np.int64)
    waiting = np.empty(supernodes, np.int64)
    num_waiting = 0
    for s in range(supernodes):
        for k in range(plan.child_count[s]):
            num_waiting -= 1
            children[start[s + 1] - 1 - k] = waiting[num_waiting]
        if plan.below_start[s + 1] > plan.below_start[s]:
            waiting[num_waiting] = s
            num_waiting += 1
    return children, start


@compiled()
def blocks_of_panels(plan: FrontPlan, panels: F64) -> F64:
    """Return the blocks (B, d, d), at the matrix' blocks, of a symmetric matrix in panels."""
    d = plan.node_size
    values = np.empty((len(plan.block_of), d, d))
    for s in range(len(plan.first_node) - 1):
        w = (plan.first_node[s + 1] - plan.first_node[s]) * d
        m = w + (plan.below_start[s + 1] - plan.below_start[s]) * d
        panel = panels[plan.panel_start[s] : plan.panel_start[s + 1]].reshape(w, m)
        for block in plan.block_of[plan.block_start[s] : plan.block_start[s + 1]]:
            row, col = plan.block_row[block] * d, plan.block_col[block] * d
            for c in range(d):
                for r in range(d):
                    if plan.block_is_transposed[block]:
                        values[block, c, r] = panel[col + c, row + r]
                    else:
                        values[block, r, c] = panel[col + c, row + r]
    return values
