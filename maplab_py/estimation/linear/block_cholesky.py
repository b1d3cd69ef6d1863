"""Block-sparse Cholesky of matrices that are given as a list of blocks."""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from maplab_py.array_types import F64, I64
from maplab_py.estimation.linear import protocol, supernodal_solver
from maplab_py.estimation.linear.ordering import AUTOMATIC
from maplab_py.estimation.linear.pattern import BlockPattern


class BlockCholesky:
    """Factorises and solves A x = b for matrices A of one block structure.

    A is symmetric, (num_nodes * node_size) square and given by its lower blocks: block b has the
    block row `block_rows[b]` >= `block_cols[b]`. Entry (r, c) of `values[b]` is the entry
    (block_rows[b] * node_size + r, block_cols[b] * node_size + c) of A. Of diagonal blocks only
    the lower triangle is read. Blocks that occur several times are added. The constructor analyses the
    structure; `factor` may then be called any number of times.
    """

    def __init__(
        self,
        block_rows: ArrayLike,
        block_cols: ArrayLike,
        num_nodes: int,
        node_size: int,
        ordering: Callable[[BlockPattern], I64] = AUTOMATIC,
    ) -> None:
        """Analyse the structure of the lower blocks at (block_rows, block_cols), each (B,).

        Raises:
            ValueError: A block lies above the diagonal or outside the matrix.
            NotEnoughMemory: The factor would not fit into memory.
        """
        self._pattern = pattern = BlockPattern.checked(block_rows, block_cols, num_nodes, node_size)
        self._solver = supernodal_solver.SupernodalCholesky(
            pattern.rows, pattern.cols, num_nodes, node_size, ordering
        )
        self._places = self._solver.places(pattern.rows, pattern.cols)
        self._is_factorised = False

    @property
    def statistics(self) -> protocol.FactorStatistics:
        """Size and cost of the factorisation."""
        return self._solver.statistics

    def factor(self, values: F64) -> None:
        """Factorise A from its blocks (B, d, d).

        Raises:
            NotPositiveDefinite: A pivot is not positive (or not a number).
        """
        checked = self._pattern.check_values(values)
        self._is_factorised = False
        self._solver.clear()
        self._solver.add(self._pattern.rows, self._pattern.cols, self._places, checked)
        self._solver.factorise()
        self._is_factorised = True

    def solve(self, right_side: F64) -> F64:
        """Return x of A x = b for b (n,) or (n, k), n = num_nodes * node_size."""
        self._require_factor()
        b = self._pattern.check_right_side(right_side)
        return self._solver.solve(b).reshape(right_side.shape)

    def inverse_blocks(self) -> F64:
        """Return A^-1 at every given block, in the layout of `values`; diagonal blocks are full."""
        self._require_factor()
        return self._solver.inverse_blocks(self._pattern.rows, self._pattern.cols, self._places)

    def _require_factor(self) -> None:
        if not self._is_factorised:
            raise ValueError("factor() has to succeed before the factor can be used")


def compile_kernels() -> None:
    """Compile factorisation and solution on a matrix of two nodes."""
    solver = BlockCholesky(np.array([0, 1, 1]), np.array([0, 0, 1]), 2, 3)
    solver.factor(np.stack([4.0 * np.eye(3), np.eye(3), 4.0 * np.eye(3)]))
    solver.solve(np.ones(6))
    solver.solve(np.ones((6, 2)))
    node = np.zeros(1, dtype=np.int32)
    matrix = supernodal_solver.SupernodalCholesky(node, node, 1, 3)
    matrix.clear()
    matrix.add_to_diagonal(np.ones((1, 3)))
    matrix.project(np.ones(1, dtype=np.bool_), np.eye(3)[None], np.ones(1))
