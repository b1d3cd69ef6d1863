"""Block-sparse Cholesky whose matrix is summed in the storage of its factor."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from maplab_py.array_types import F64, I32, I64, Mask
from maplab_py.estimation.linear import supernodal, triangular_solve
from maplab_py.estimation.linear.block_storage import (
    BlockLayout,
    add_blocks,
    add_to_diagonal,
    layout_of_panels,
    panel_places,
    project_panels,
    read_blocks,
)
from maplab_py.estimation.linear.dense_kernels import Blas
from maplab_py.estimation.linear.ordering import AUTOMATIC
from maplab_py.estimation.linear.pattern import BlockPattern
from maplab_py.estimation.linear.protocol import FactorStatistics, NotPositiveDefinite
from maplab_py.estimation.linear.selected_inverse import invert_panels
from maplab_py.estimation.linear.single_solve import solve_single
from maplab_py.estimation.linear.symbolic import analyse, most_below
from maplab_py.estimation.linear.threads import single_blas_thread
from maplab_py.memory import require_memory

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
        """Set the matrix to zero; the factor is gone."""
        self._is_factorised = False
        self.numbers.fill(0.0)

    def places(self, rows: I32, cols: I32) -> I32:
        """Return what `add` needs to know about blocks (B,) of the pattern."""
        return np.asarray(panel_places(self.plan, self.layout.position, rows, cols))

    def add(self, rows: I32, cols: I32, places: I32, values: F64) -> None:
        """Add blocks (B, d, d) at block rows and columns (B,); of diagonal ones the lower triangle."""
        add_blocks(self.layout, rows, cols, places, values, self.numbers)

    def add_to_diagonal(self, added: F64) -> None:
        """Add numbers (num_nodes, d) to the diagonal."""
        add_to_diagonal(self.layout, self._diagonal_places, added, self.numbers)

    def project(self, is_restricted: Mask, projector: F64, size: F64) -> None:
        """Turn the matrix A into P A P + s (I - P); see `block_storage.project_panels`."""
        every = 0, len(self.plan.parent)
        project_panels(self.plan, is_restricted, projector, size, self.numbers, *every)

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
            every = 0, len(self.plan.parent)
            bad = supernodal.factorise(self.plan, self.numbers, self._scratch, self._blas, *every)
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
            x = triangular_solve.solve(self.plan, self.numbers, columns, self._blas)
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
