"""Block-sparse Cholesky whose matrix is summed in the storage of its factor."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from maplab_py.array_types import F64, I32, I64, Mask
from maplab_py.compilation import compiled
from maplab_py.estimation.linear import supernodal
from maplab_py.estimation.linear.block_storage import (
    BlockLayout,
    add_blocks,
    add_to_diagonal,
    layout_of_panels,
    panel_places,
    project_panels,
    read_blocks,
)
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
from maplab_py.estimation.linear.ordering import AUTOMATIC
from maplab_py.estimation.linear.pattern import BlockPattern
from maplab_py.estimation.linear.protocol import FactorStatistics, NotPositiveDefinite
from maplab_py.estimation.linear.single_solve import solve_single
from maplab_py.estimation.linear.symbolic import FrontPlan, analyse, most_below
from maplab_py.estimation.linear.threads import single_blas_thread
from maplab_py.memory import require_memory

# A supernode's panel is [L11; L21], see `symbolic.FrontPlan`. Everything is sequential and ordered, so
# results are the same bits each time.


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


# Takahashi 1973; Erisman and Tinney 1975: with [L11; L21] the panel of a supernode, Y = L21 L11^-1 and
# Z = A^-1,
#
#     Z21 = -Z22 Y,    Z11 = L11^-T L11^-1 - Y^T Z21,
#
# where Z22 lies in the panels of the supernode's ancestors, which come first.


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


BYTES_PER_NUMBER = 8.0
_WORTH_TELLING = 1e8
"""Bytes of a factor from which users want to know its size."""


class SupernodalCholesky:
    """Supernodal Cholesky factorisation, in whose storage the lower blocks of A are summed.

    The constructor analyses the structure. `clear`, `add` and `factorise` may then follow each other any
    number of times. The factor replaces the matrix. Any kernel that knows the layout may write to
    `numbers`.
    """

    def __init__(
        self,
        rows: I32,
        cols: I32,
        num_nodes: int,
        node_size: int,
        ordering: Callable[[BlockPattern], I64] = AUTOMATIC,
        tell: Callable[[str], None] | None = None,
    ) -> None:
        """Analyse the structure of the lower blocks at rows and cols, each (B,).

        Args:
            rows: Block rows.
            cols: Block columns.
            num_nodes: Block rows of the matrix.
            node_size: Rows of a block.
            ordering: Orders the nodes.
            tell: Shows the size of a large factor before it is allocated.

        Raises:
            ValueError: A block lies above the diagonal or outside the matrix.
            NotEnoughMemory: The factor would not fit into memory.
        """
        symbolic = analyse(BlockPattern.checked(rows, cols, num_nodes, node_size), ordering)
        self.statistics: FactorStatistics = symbolic.statistics
        plan = symbolic.plan
        widest_update = (most_below(plan) * node_size) ** 2
        self._scratch = np.empty(min(supernodal.SCRATCH_SIZE, widest_update))
        needed = BYTES_PER_NUMBER * (symbolic.statistics.nonzeros + len(self._scratch))
        if tell is not None and needed > _WORTH_TELLING:
            tell(
                f"linear solver: direct, a factor of {1e-9 * needed:.2f} GB in "
                f"{1e-9 * symbolic.statistics.flops:.0f} Gflop an iteration"
            )
        require_memory(needed, f"the factor of {num_nodes * node_size} unknowns")
        self.plan = plan
        self.layout = BlockLayout(node_size, *layout_of_panels(plan))
        self.numbers = np.empty(int(plan.panel_start[-1]))  # undefined until `clear`
        every = np.arange(num_nodes, dtype=np.int32)
        self._diagonal_places = self.places(every, every)
        self._blas = Blas.workspace()
        self._is_factorised = False

    def clear(self) -> None:
        """Set the matrix to zero, which discards the factor."""
        self._is_factorised = False
        self.numbers.fill(0.0)

    def places(self, rows: I32, cols: I32) -> I32:
        """Return the places of blocks (B,) of the pattern, for `add`."""
        return np.asarray(panel_places(self.plan, self.layout.position, rows, cols))

    def add(self, rows: I32, cols: I32, places: I32, values: F64) -> None:
        """Add blocks (B, d, d) at block rows and columns (B,); of diagonal ones the lower triangle."""
        add_blocks(self.layout, rows, cols, places, values, self.numbers)

    def add_to_diagonal(self, added: F64) -> None:
        """Add numbers (num_nodes, d) to the diagonal."""
        add_to_diagonal(self.layout, self._diagonal_places, added, self.numbers)

    def project(self, is_restricted: Mask, projector: F64, size: F64) -> None:
        """Turn the matrix A into P A P + s (I - P); see `block_storage.project_panels`."""
        project_panels(self.plan, is_restricted, projector, size, self.numbers)

    def blocks(self, rows: I32, cols: I32) -> F64:
        """Return blocks (B, d, d) of the matrix as it was summed."""
        return np.asarray(
            read_blocks(self.layout, rows, cols, self.places(rows, cols), self.numbers)
        )

    def factorise(self) -> None:
        """Overwrite the matrix by its factor.

        Raises:
            NotPositiveDefinite: A pivot is not positive (or not a number).
        """
        with single_blas_thread():
            bad = supernodal.factorise(self.plan, self.numbers, self._scratch, self._blas)
        if bad >= 0:
            raise NotPositiveDefinite(int(self.plan.order[bad]))
        self._is_factorised = True

    def solve(self, right_side: F64) -> F64:
        """Return x (n, k) of A x = b for b (n, k)."""
        self._require_factor()
        with single_blas_thread():
            if right_side.shape[1] == 1:
                x = solve_single(self.plan, self.numbers, right_side[:, 0].copy())
                return np.asarray(x[:, None])
            columns = np.ascontiguousarray(right_side.T)
            x = solve(self.plan, self.numbers, columns, self._blas)
        return np.ascontiguousarray(x.T)

    def inverse_blocks(self, rows: I32, cols: I32, places: I32) -> F64:
        """Return blocks (B, d, d) of the inverse, diagonal ones in full."""
        self._require_factor()
        with single_blas_thread():
            panels = invert_panels(self.plan, self.numbers, self._blas)
        return np.asarray(read_blocks(self.layout, rows, cols, places, panels))

    def _require_factor(self) -> None:
        if not self._is_factorised:
            raise ValueError("the matrix has to be factorised before its factor can be used")


@dataclasses.dataclass(frozen=True, eq=False)
class BlockPlaces:
    """Blocks (B,) of a pattern, and where they lie in a solver's storage."""

    rows: I32
    cols: I32
    places: I32

    @classmethod
    def of(cls, solver: SupernodalCholesky, rows: I64, cols: I64) -> BlockPlaces:
        """Find the places in the storage of a solver that has analysed the blocks."""
        short_rows, short_cols = rows.astype(np.int32), cols.astype(np.int32)
        return cls(short_rows, short_cols, solver.places(short_rows, short_cols))

    def add(self, solver: SupernodalCholesky, values: F64, first: int = 0) -> None:
        """Add the blocks (k, d, d) from number `first` on to a matrix."""
        part = slice(first, first + len(values))
        solver.add(self.rows[part], self.cols[part], self.places[part], values)
