"""The same solver by scipy's SuperLU: slower, needs no compilation; for checks and as a fallback."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from maplab_py.estimation.linear.ordering import minimum_degree
from maplab_py.estimation.linear.pattern import BlockPattern, symmetric_of_lower
from maplab_py.estimation.linear.protocol import FactorStatistics, NotPositiveDefinite

F64 = NDArray[np.float64]


class SuperLUSolver:
    """Sparse LU without pivoting on the Cholesky solver's order; a `protocol.LinearSolver`."""

    def __init__(
        self, block_rows: ArrayLike, block_cols: ArrayLike, num_nodes: int, node_size: int
    ) -> None:
        """Order the structure of the lower blocks at (block_rows, block_cols), each (B,)."""
        self._pattern = BlockPattern.checked(block_rows, block_cols, num_nodes, node_size)
        d = node_size
        self._scalar_order = (minimum_degree(self._pattern)[:, None] * d + np.arange(d)).reshape(-1)
        self._values: F64 | None = None
        self._factors: Any = None

    @cached_property
    def _entries(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        d, p = self._pattern.node_size, self._pattern
        position = np.empty(p.size, dtype=np.int64)
        position[self._scalar_order] = np.arange(p.size)
        row = p.rows[:, None, None] * d + np.arange(d)[:, None] + np.zeros((1, d), dtype=np.int64)
        col = p.cols[:, None, None] * d + np.arange(d) + np.zeros((d, 1), dtype=np.int64)
        strict = p.rows != p.cols
        rows = np.concatenate([row.reshape(-1), col[strict].reshape(-1)])
        cols = np.concatenate([col.reshape(-1), row[strict].reshape(-1)])
        return position[rows], position[cols]

    @property
    def statistics(self) -> FactorStatistics:
        """Size of the last factorisation; the work is not known to SuperLU."""
        nonzeros = int(self._factors.L.nnz) if self._factors is not None else 0
        nodes, d = self._pattern.num_nodes, self._pattern.node_size
        return FactorStatistics(nodes, d, nonzeros, float("nan"), 0, 0)

    def factor(self, values: F64) -> None:
        """Factorise the matrix with blocks (B, d, d); see `protocol.LinearSolver`.

        Raises:
            NotPositiveDefinite: A pivot is not positive.
        """
        from scipy.sparse import coo_array
        from scipy.sparse.linalg import splu

        p = self._pattern
        checked = p.check_values(values)
        self._values = self._factors = None
        full = checked.copy()
        on_diagonal = np.flatnonzero(p.rows == p.cols)
        full[on_diagonal] = symmetric_of_lower(checked[on_diagonal])
        numbers = np.concatenate([full.reshape(-1), full[p.rows != p.cols].reshape(-1)])
        matrix = coo_array((numbers, self._entries), shape=(p.size, p.size)).tocsc()
        if p.size:
            self._factors = self._factorise(splu, matrix)
        self._values = checked

    def _factorise(self, splu: Any, matrix: Any) -> Any:
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
        return int(self._scalar_order[scalar_position]) // self._pattern.node_size

    def solve(self, right_side: F64, *, refinements: int = 0) -> F64:
        """Return x of A x = b for b (n,) or (n, k); see `protocol.LinearSolver`."""
        values = self._factorised()
        return self._pattern.refined(self._solve, values, right_side, refinements)

    def marginal_covariance(self, nodes: ArrayLike) -> F64:
        """Return the joint covariance of some nodes; see `protocol.LinearSolver`."""
        return self._pattern.joint_covariance(self.solve, nodes)

    def inverse_blocks(self) -> F64:
        """Return the inverse at every given block, column by column: for small systems."""
        p, d = self._pattern, self._pattern.node_size
        values = np.empty((len(p.rows), d, d))
        for node in range(p.num_nodes):
            blocks = np.flatnonzero(p.cols == node)
            unit = np.zeros((p.size, d))
            unit[node * d : node * d + d] = np.eye(d)
            values[blocks] = self.solve(unit).reshape(p.num_nodes, d, d)[p.rows[blocks]]
        return values

    def _factorised(self) -> F64:
        if self._values is None:
            raise ValueError("factor() has to succeed before the factor can be used")
        return self._values

    def _solve(self, b: F64) -> F64:
        x = np.empty_like(b)
        if self._factors is not None:
            x[self._scalar_order] = self._factors.solve(b[self._scalar_order])
        return x
