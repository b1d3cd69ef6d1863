"""Numeric part of the supernodal Cholesky factorisation A = L L^T, in the storage of A.

The lower triangle of A is summed into the panels of L (`block_storage`), zeros where L fills in.
Supernodes are visited from the leaves of the elimination tree to its roots ("right-looking": Ng and
Peyton, Block Sparse Cholesky Algorithms, 1993). With F = [F11; F21] the panel of a supernode, which has
received all updates by then,

    L11 L11^T = F11            dpotrf
    L21 = F21 L11^-T           dtrsm
    U = L21 L21^T              dsyrk, subtracted from the panels of its ancestors right away.

All rows of U belong to ancestors, so nothing waits: beside the factor there is room for one small
matrix. The multifrontal method, which keeps update matrices on a stack until their parents need
them, makes as many operations with up to twice the memory.

Where U is small it is computed as a whole and scattered. Where it is large every ancestor's part is
computed on its own, into the panel itself if the rows lie side by side there. Nodes of six numbers need
less of BLAS: their panels are factorised by blocks, and a U that is not large is subtracted by blocks.

Everything is sequential and ordered, so results are the same bits each time.
"""

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.compilation import compiled
from maplab_py.estimation.linear.blocks_of_six import factorise_blocks, subtract_square
from maplab_py.estimation.linear.dense_kernels import (
    MINUS_ONE,
    ONE,
    PLAIN,
    RIGHT,
    TRANSPOSED,
    ZERO,
    Blas,
    Matrix,
    cholesky,
    multiply,
    solve_triangle,
    square,
)
from maplab_py.estimation.linear.symbolic import FrontPlan, most_below

SCRATCH_SIZE = 2**18
"""Numbers of the small matrix: 2 MB, which stay in the processor's cache."""
_MOST_BY_BLOCKS = 66
"""Nodes below a supernode up to which blocks are subtracted faster than by BLAS."""


@compiled()
def factorise(plan: FrontPlan, numbers: F64, scratch: F64, blas: Blas) -> int:
    """Overwrite the panels of A by those of L; return -1 or the position that has no pivot.

    What a supernode leaves is subtracted from the panels of all its ancestors.

    Args:
        plan: Structure.
        numbers: Panels.
        scratch: Room for a part of an update matrix; at least as large as a panel is wide, squared.
        blas: Workspace.
    """
    d = plan.node_size
    room = most_below(plan) + 1
    local, runs = np.empty(room, np.int64), np.empty((room, 2), np.int64)
    inverse = np.empty((1, 6))
    for s in range(len(plan.parent)):
        w = (plan.first_node[s + 1] - plan.first_node[s]) * d
        n = (plan.below_start[s + 1] - plan.below_start[s]) * d
        panel = numbers[plan.panel_start[s] : plan.panel_start[s + 1]]
        if d == 6:
            bad_column = factorise_blocks(panel.reshape(-1, 6), w // 6, inverse)
        else:
            bad_column = cholesky(blas, panel, w, w + n)
        if bad_column != 0:
            return int(plan.first_node[s] + (bad_column - 1) // d)
        if n > 0:
            if d != 6:
                below = panel[w:]  # L21 starts below L11 in every column
                solve_triangle(blas, RIGHT, TRANSPOSED, panel, w + n, below, n, w, w + n)
            _update_ancestors(plan, s, numbers, scratch, local, runs, blas)
    return -1


@compiled()
def _update_ancestors(
    plan: FrontPlan, s: int, numbers: F64, scratch: F64, local: I64, runs: I64, blas: Blas
) -> None:
    """Subtract L21 L21^T of a supernode from the panels of its ancestors.

    The walk up the tree keeps the local nodes of the rows that are left in the front at hand:
    those of the parent are known, and from one front to the next they follow the front's own rows.
    """
    d = plan.node_size
    w = (plan.first_node[s + 1] - plan.first_node[s]) * d
    start = plan.below_start[s]
    rows = plan.below_start[s + 1] - start
    n = rows * d
    L21 = numbers[plan.panel_start[s] + w : plan.panel_start[s + 1]]
    by_blocks = d == 6 and rows <= _MOST_BY_BLOCKS
    is_whole = not by_blocks and n * n <= len(scratch)
    if is_whole:
        square(blas, L21, w + n, n, w, scratch)
    for i in range(rows):
        local[i] = plan.below_in_parent[start + i]
    begin, front = 0, plan.parent[s]
    while begin < rows:
        width = plan.first_node[front + 1] - plan.first_node[front]
        end = begin
        while end < rows and local[end] < width:
            end += 1
        if end > begin:
            panel = numbers[plan.panel_start[front] : plan.panel_start[front + 1]]
            target = Matrix(panel, len(panel) // (width * d))
            part, cols = local[begin:rows], end - begin
            L = Matrix(L21[begin * d :], w + n)
            if by_blocks:
                subtract_square(L, w // d, part, cols, target)
            elif is_whole:
                update = Matrix(scratch[begin * d * (n + 1) :], n)
                _scatter(update, part, part[:cols], d, True, runs, target)
            else:
                _update_panel(L, w, part, cols, d, runs, target, scratch, blas)
        below = plan.below_start[front] - width
        for i in range(end, rows):
            local[i] = plan.below_in_parent[below + local[i]]
        begin, front = end, plan.parent[front]


@compiled()
def _find_runs(local: I64, d: int, runs: I64) -> int:
    """Find the runs of rows that are neighbours in the front as well; return their number.

    Args:
        local: Local nodes, ascending.
        d: Rows of a node.
        runs: Result (number + 1, 2): first row of every run here and in the front; the last row
            of the result ends the last run.
    """
    count = 0
    for node in range(len(local)):
        if node == 0 or local[node] != local[node - 1] + 1:
            runs[count, 0], runs[count, 1] = node * d, local[node] * d
            count += 1
    runs[count, 0] = len(local) * d
    return count


@compiled()
def _scatter(
    update: Matrix, rows: I64, cols: I64, d: int, is_triangle: bool, runs: I64, target: Matrix
) -> None:
    """Subtract an update matrix from the panel of a front, whole runs of rows at a time.

    Args:
        update: One column after another.
        rows: Local node in the front of every node of the update's rows.
        cols: The same of its columns.
        d: Rows of a node.
        is_triangle: Whether columns and first rows are the same and only the lower triangle counts.
        runs: Room for runs.
        target: Panel.
    """
    count, run = _find_runs(rows, d, runs), 0
    for j in range(len(cols) * d):
        first = 0
        if is_triangle:
            first = j
            while runs[run + 1, 0] <= j:
                run += 1
        col = cols[j // d] * d + j % d
        source, panel = j * update.leading, col * target.leading
        for other in range(run, count):
            begin, end = max(first, runs[other, 0]), runs[other + 1, 0]
            place = panel + begin + runs[other, 1] - runs[other, 0]
            part = target.values[place : place + end - begin]
            for i, value in enumerate(update.values[source + begin : source + end]):
                part[i] -= value


@compiled()
def _update_panel(
    L: Matrix,
    inner: int,
    local: I64,
    cols: int,
    d: int,
    runs: I64,
    target: Matrix,
    scratch: F64,
    blas: Blas,
) -> None:
    """Subtract the part of L21 L21^T that belongs to the panel of one ancestor.

    What is above the diagonal is written, too; nobody reads it.

    Args:
        L: L21 from the first row of the part on.
        inner: Columns of L21.
        local: Local node in the ancestor's front of every node of the part's rows.
        cols: Nodes of the part's columns, which are those of its first rows.
        d: Rows of a node.
        runs: Room for runs.
        target: Panel.
        scratch: Room for a part of the product.
        blas: Workspace.
    """
    rows, forms = len(local), (PLAIN, TRANSPOSED)
    if local[rows - 1] - local[0] == rows - 1:
        at = local[0] * d
        result = Matrix(target.values[at * target.leading + at :], target.leading)
        multiply(blas, (rows * d, cols * d, inner), forms, L, L, (MINUS_ONE, ONE), result)
        return
    most = max(1, len(scratch) // (cols * d * d))
    for first in range(0, rows, most):
        height = min(most, rows - first)
        product = Matrix(scratch, height * d)
        part = Matrix(L.values[first * d :], L.leading)
        multiply(blas, (height * d, cols * d, inner), forms, part, L, (ONE, ZERO), product)
        _scatter(product, local[first : first + height], local[:cols], d, False, runs, target)
