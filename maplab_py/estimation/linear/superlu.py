"""The same solver by scipy's SuperLU: slower, needs no compilation; for checks and as a fallback."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from maplab_py.array_types import F64, I32, I64
from maplab_py.estimation.linear.block_cholesky import BlockListSolver
from maplab_py.estimation.linear.ordering import AUTOMATIC
from maplab_py.estimation.linear.pattern import BlockPattern
from maplab_py.estimation.linear.protocol import FactorStatistics, NotPositiveDefinite
from maplab_py.estimation.linear.supernodal_solver import BlockStorage
from maplab_py.estimation.linear.symbolic import FrontPlan, plan_of_matrix


class SuperLU(BlockStorage):
    """Sparse LU without pivoting on the Cholesky solver's order; a `assembled.AssembledSolver`."""

    def __init__(
        self,
        rows: I32,
        cols: I32,
        num_nodes: int,
        node_size: int,
        ordering: Callable[[BlockPattern], I64] = AUTOMATIC,
    ) -> None:
        """Order the structure of the lower blocks at rows and cols, each (B,)."""
        pattern = BlockPattern.checked(rows, cols, num_nodes, node_size)
        super().__init__(plan_of_matrix(pattern, ordering(pattern)))
        self._indices, self._start = _columns(self.plan)
        self._factors: Any = None
        self._is_factorised = False

    @property
    def statistics(self) -> FactorStatistics:
        """Size of the last factorisation; the work is not known to SuperLU."""
        nonzeros = int(self._factors.L.nnz) if self._factors is not None else 0
        nodes, d = len(self.plan.order), self.plan.node_size
        return FactorStatistics(nodes, d, nonzeros, float("nan"), 0, 0)

    def clear(self) -> None:
        """Set the matrix to zero."""
        self._factors, self._is_factorised = None, False
        super().clear()

    def factorise(self) -> None:
        """Factorise what has been added, which is kept.

        Raises:
            NotPositiveDefinite: A pivot is not positive (or not a number).
        """
        from scipy.sparse import csc_array, tril
        from scipy.sparse.linalg import splu

        size = len(self.plan.order) * self.plan.node_size
        stored = csc_array((self.numbers, self._indices, self._start), shape=(size, size))
        lower = tril(stored, format="csc")
        matrix = (lower + tril(lower, -1).T).tocsc()
        if size:
            self._factors = self._factorised_matrix(splu, matrix)
        self._is_factorised = True

    def _factorised_matrix(self, splu: Any, matrix: Any) -> Any:
        if not np.all(np.isfinite(matrix.data)):
            bad_columns = np.repeat(np.arange(matrix.shape[1]), np.diff(matrix.indptr))
            bad = bad_columns[~np.isfinite(matrix.data)]
            raise NotPositiveDefinite(self._node(int(bad.min())))
        try:
            factors = splu(
                matrix,
                permc_spec="NATURAL",
                diag_pivot_thresh=0.0,
                options={"SymmetricMode": True, "Equil": False},
            )
        except RuntimeError as error:  # "Factor is exactly singular"
            empty = np.flatnonzero(matrix.diagonal() <= 0.0)
            raise NotPositiveDefinite(self._node(int(empty[0]) if len(empty) else 0)) from error
        # without pivoting U's diagonal has the pivots of L D L^T; a row exchange betrays a zero one
        moved = np.flatnonzero(factors.perm_r != factors.perm_c)
        bad_pivots = np.flatnonzero(~(factors.U.diagonal() > 0.0))
        if len(moved) or len(bad_pivots):
            place = int(bad_pivots[0]) if len(bad_pivots) else int(moved[0])
            raise NotPositiveDefinite(self._node(int(np.argsort(factors.perm_c)[place])))
        return factors

    def _node(self, scalar_position: int) -> int:
        return int(self.plan.order[scalar_position // self.plan.node_size])

    def solve(self, right_side: F64) -> F64:
        """Return x (n, k) of A x = b for b (n, k)."""
        if not self._is_factorised:
            raise ValueError("the matrix has to be factorised before its factor can be used")
        d = self.plan.node_size
        order = (self.plan.order[:, None] * d + np.arange(d)).reshape(-1)
        x = np.empty_like(right_side)
        if self._factors is not None:
            x[order] = self._factors.solve(right_side[order])
        return x

    def inverse_blocks(self, rows: I32, cols: I32, places: I32) -> F64:  # noqa: ARG002
        """Return blocks (B, d, d) of the inverse, column by column: for small systems."""
        n, d = len(self.plan.order), self.plan.node_size
        values = np.empty((len(rows), d, d))
        for node in range(n):
            blocks = np.flatnonzero(cols == node)
            unit = np.zeros((n * d, d))
            unit[node * d : node * d + d] = np.eye(d)
            values[blocks] = self.solve(unit).reshape(n, d, d)[rows[blocks]]
        return values


def _columns(plan: FrontPlan) -> tuple[I64, I64]:
    """Return row indices and offsets of the scalar columns of panels of one node each."""
    n, d = len(plan.order), plan.node_size
    height = 1 + np.diff(plan.below_start)
    indices = [np.zeros(0, dtype=np.int64)]
    for node in range(n):
        below = plan.below[plan.below_start[node] : plan.below_start[node + 1]]
        rows = np.concatenate([[node], below])[:, None] * d + np.arange(d)
        indices += [rows.reshape(-1)] * d
    start = np.zeros(n * d + 1, dtype=np.int64)
    np.cumsum(np.repeat(height * d, d), out=start[1:])
    return np.concatenate(indices), start


class SuperLUSolver(BlockListSolver):
    """SuperLU for listed blocks."""

    storage = SuperLU
