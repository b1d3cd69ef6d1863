"""Interface of a solver of symmetric positive definite block systems."""

from __future__ import annotations

import dataclasses
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from maplab_py.array_types import F64
from maplab_py.errors import EstimationError
from maplab_py.report import Report


class NotPositiveDefinite(EstimationError):
    """The matrix has a pivot that is not positive; `node` is the block row where it showed."""

    def __init__(self, node: int) -> None:
        super().__init__(f"the matrix is not positive definite at node {node}")
        self.node = node


@dataclasses.dataclass(frozen=True)
class FactorStatistics(Report):
    """Size and cost of a factorisation."""

    num_nodes: int
    node_size: int
    nonzeros: int  # stored numbers of the factor
    flops: float  # of one numeric factorisation
    supernodes: int
    largest_front: int  # rows of the largest dense matrix


class LinearSolver(Protocol):
    """Factorises and solves A x = b for matrices A of one block structure.

    A is symmetric, (num_nodes * node_size) square and given by its lower blocks: block b has the
    block row `block_rows[b]` >= `block_cols[b]`. Entry (r, c) of `values[b]` is the entry
    (block_rows[b] * node_size + r, block_cols[b] * node_size + c) of A. Of diagonal blocks only
    the lower triangle is read. Blocks that occur several times are added.
    """

    @property
    def statistics(self) -> FactorStatistics:
        """Size and cost of the factorisation."""

    def factor(self, values: F64) -> None:
        """Factorise A from its blocks (num_blocks, node_size, node_size).

        Raises:
            NotPositiveDefinite: A pivot is not positive (or not a number).
        """

    def solve(self, right_side: F64, *, refinements: int = 0) -> F64:
        """Return x of A x = b for b (n,) or (n, k), n = num_nodes * node_size.

        Args:
            right_side: b.
            refinements: Steps of iterative refinement, x += A^-1 (b - A x).
        """

    def marginal_covariance(self, nodes: NDArray[np.int64]) -> F64:
        """Return the rows and columns of A^-1 that belong to nodes (k,), as one matrix.

        The result is (k * node_size) square, in the order of `nodes`.
        """

    def inverse_blocks(self) -> F64:
        """Return A^-1 at every given block, in the layout of `values`; diagonal blocks are full."""
