"""The solver of the reduced normal equations: block-sparse Cholesky, analysed once per structure."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from maplab_py.estimation.linear import multifrontal
from maplab_py.estimation.linear.ordering import minimum_degree
from maplab_py.estimation.linear.pattern import BlockPattern
from maplab_py.estimation.linear.protocol import FactorStatistics, NotPositiveDefinite
from maplab_py.estimation.linear.single_solve import solve_single
from maplab_py.estimation.linear.symbolic import analyse
from maplab_py.estimation.linear.threads import single_blas_thread

F64 = NDArray[np.float64]


class BlockCholesky:
    """Supernodal multifrontal Cholesky factorisation; a `protocol.LinearSolver`.

    The constructor analyses the structure; `factor` may then be called any number of times.
    """

    def __init__(
        self,
        block_rows: ArrayLike,
        block_cols: ArrayLike,
        num_nodes: int,
        node_size: int,
        ordering: Callable[[BlockPattern], NDArray[np.int64]] = minimum_degree,
    ) -> None:
        """Analyse the structure of the lower blocks at (block_rows, block_cols), each (B,).

        Raises:
            ValueError: A block lies above the diagonal or outside the matrix.
        """
        self._pattern = BlockPattern.checked(block_rows, block_cols, num_nodes, node_size)
        self._symbolic = symbolic = analyse(self._pattern, ordering)
        self._factor = np.empty(symbolic.statistics.nonzeros)
        self._front = np.empty(symbolic.front_size)
        self._stack = np.empty(symbolic.stack_size)
        self._blas = multifrontal.Blas.workspace()
        self._values: F64 | None = None

    @property
    def statistics(self) -> FactorStatistics:
        """Size and cost of the factorisation."""
        return self._symbolic.statistics

    def factor(self, values: F64) -> None:
        """Factorise the matrix with blocks (B, d, d); see `protocol.LinearSolver`.

        Raises:
            NotPositiveDefinite: A pivot is not positive.
        """
        checked = self._pattern.check_values(values)
        self._values = None
        with single_blas_thread():
            bad_position = multifrontal.factorise(
                self._symbolic.plan, checked, self._factor, self._front, self._stack, self._blas
            )
        if bad_position >= 0:
            raise NotPositiveDefinite(int(self._symbolic.plan.order[bad_position]))
        self._values = checked

    def solve(self, right_side: F64, *, refinements: int = 0) -> F64:
        """Return x of A x = b for b (n,) or (n, k); see `protocol.LinearSolver`."""
        values = self._factorised()
        with single_blas_thread():
            return self._pattern.refined(self._solve, values, right_side, refinements)

    def marginal_covariance(self, nodes: ArrayLike) -> F64:
        """Return the joint covariance of some nodes; see `protocol.LinearSolver`."""
        return self._pattern.joint_covariance(self.solve, nodes)

    def inverse_blocks(self) -> F64:
        """Return the inverse at every given block; see `protocol.LinearSolver`."""
        self._factorised()
        plan = self._symbolic.plan
        with single_blas_thread():
            panels = multifrontal.invert_panels(plan, self._factor, self._stack, self._blas)
        return np.asarray(multifrontal.blocks_of_panels(plan, panels))

    def _factorised(self) -> F64:
        if self._values is None:
            raise ValueError("factor() has to succeed before the factor can be used")
        return self._values

    def _solve(self, b: F64) -> F64:
        if b.shape[1] == 1:
            x = solve_single(self._symbolic.plan, self._factor, b[:, 0].copy())
            return np.asarray(x[:, None])
        columns = np.ascontiguousarray(b.T)
        x = multifrontal.solve(self._symbolic.plan, self._factor, columns, self._blas)
        return np.ascontiguousarray(x.T)
