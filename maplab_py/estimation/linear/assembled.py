"""Interface of a solver in whose storage a matrix is summed."""

from __future__ import annotations

import dataclasses
from typing import Protocol

import numpy as np

from maplab_py.array_types import F64, I32, I64, Mask
from maplab_py.estimation.linear.block_storage import BlockLayout
from maplab_py.estimation.linear.protocol import FactorStatistics


class BlockSums(Protocol):
    """Storage in which the blocks of a matrix are summed."""

    layout: BlockLayout
    numbers: F64  # the storage; see `block_storage`

    def add(self, rows: I32, cols: I32, places: I32, values: F64) -> None:
        """Add blocks (B, d, d) at block rows and columns (B,); of diagonal ones the lower triangle."""


class AssembledSolver(BlockSums, Protocol):
    """Factorises and solves A x = b; the blocks of A are summed in the solver's own storage.

    A is symmetric, (num_nodes * node_size) square, and its lower blocks (row >= col) are given. The
    constructor takes their rows and columns, number and size of nodes, and an ordering.
    """

    @property
    def statistics(self) -> FactorStatistics:
        """Size and cost of the factorisation."""

    def places(self, rows: I32, cols: I32) -> I32:
        """Return what `add` needs to know about blocks (B,) of the pattern."""

    def clear(self) -> None:
        """Set A to zero; a factor is gone."""

    def add_to_diagonal(self, added: F64) -> None:
        """Add numbers (num_nodes, d) to the diagonal of A."""

    def project(self, is_restricted: Mask, projector: F64, size: F64) -> None:
        """Turn A into P A P + s (I - P); P (num_nodes, d, d) where nodes are restricted, s by node."""

    def blocks(self, rows: I32, cols: I32) -> F64:
        """Return blocks (B, d, d) of A, before it is factorised."""

    def factorise(self) -> None:
        """Factorise A; its storage may be overwritten.

        Raises:
            NotPositiveDefinite: A pivot is not positive (or not a number).
        """

    def solve(self, right_side: F64) -> F64:
        """Return x (n, k) of A x = b for b (n, k), n = num_nodes * node_size."""

    def inverse_blocks(self, rows: I32, cols: I32, places: I32) -> F64:
        """Return blocks (B, d, d) of A^-1 at blocks of the pattern, diagonal ones in full."""


@dataclasses.dataclass(frozen=True, eq=False)
class BlockPlaces:
    """Blocks (B,) of a pattern, and where they lie in a solver's storage."""

    rows: I32
    cols: I32
    places: I32

    @classmethod
    def of(cls, solver: AssembledSolver, rows: I64, cols: I64) -> BlockPlaces:
        """Find the places in the storage of a solver that has analysed the blocks."""
        short_rows, short_cols = rows.astype(np.int32), cols.astype(np.int32)
        return cls(short_rows, short_cols, solver.places(short_rows, short_cols))

    def add(self, solver: BlockSums, values: F64, first: int = 0) -> None:
        """Add the blocks (k, d, d) from number `first` on to a matrix."""
        part = slice(first, first + len(values))
        solver.add(self.rows[part], self.cols[part], self.places[part], values)
