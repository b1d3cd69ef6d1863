"""Sums of blocks in the storage of a solver."""

from __future__ import annotations

import dataclasses
from typing import Protocol

import numpy as np

from maplab_py.array_types import F64, I32, I64
from maplab_py.estimation.linear.block_storage import BlockLayout
from maplab_py.estimation.linear.supernodal_solver import SupernodalCholesky


class BlockSums(Protocol):
    """Storage in which the blocks of a matrix are summed."""

    layout: BlockLayout
    numbers: F64  # the storage; see `block_storage`

    def add(self, rows: I32, cols: I32, places: I32, values: F64) -> None:
        """Add blocks (B, d, d) at block rows and columns (B,); of diagonal ones the lower triangle."""


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

    def add(self, solver: BlockSums, values: F64, first: int = 0) -> None:
        """Add the blocks (k, d, d) from number `first` on to a matrix."""
        part = slice(first, first + len(values))
        solver.add(self.rows[part], self.cols[part], self.places[part], values)
