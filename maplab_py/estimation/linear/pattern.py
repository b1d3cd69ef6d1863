"""The block structure of a symmetric matrix, checked."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from maplab_py.array_types import F64, I32, I64
from maplab_py.compilation import compiled


@dataclasses.dataclass(frozen=True, eq=False)
class BlockPattern:
    """Places of the lower blocks of a symmetric block matrix (see `block_cholesky.BlockCholesky`)."""

    rows: I32
    cols: I32
    num_nodes: int
    node_size: int

    @classmethod
    def checked(
        cls, rows: ArrayLike, cols: ArrayLike, num_nodes: int, node_size: int
    ) -> BlockPattern:
        """Make a pattern of block rows and columns (B,).

        Raises:
            ValueError: Shapes differ, a block is above the diagonal or outside the matrix.
        """
        r, c = np.asarray(rows, dtype=np.int32), np.asarray(cols, dtype=np.int32)
        if r.ndim != 1 or r.shape != c.shape:
            raise ValueError(f"block rows {r.shape} and columns {c.shape} must be equal vectors")
        if num_nodes < 0 or node_size < 1:
            raise ValueError(f"{num_nodes} nodes of size {node_size} make no matrix")
        if len(r) and (c.min() < 0 or r.max() >= num_nodes or bool(np.any(r < c))):
            raise ValueError("every block needs 0 <= column <= row < num_nodes")
        return cls(r, c, num_nodes, node_size)

    @property
    def size(self) -> int:
        """Rows of the scalar matrix."""
        return self.num_nodes * self.node_size

    def check_values(self, values: F64) -> F64:
        """Return block values (B, d, d) as contiguous doubles; ValueError for another shape."""
        wanted = (len(self.rows), self.node_size, self.node_size)
        if values.shape != wanted:
            raise ValueError(f"block values have shape {values.shape}, expected {wanted}")
        return np.ascontiguousarray(values, dtype=np.float64)

    def check_right_side(self, right_side: F64) -> F64:
        """Return a right side as (n, k) doubles; ValueError for another shape."""
        b = np.asarray(right_side, dtype=np.float64)
        if b.ndim not in (1, 2) or b.shape[0] != self.size:
            raise ValueError(f"right side has shape {b.shape}, expected ({self.size},) or (.., k)")
        return b.reshape(self.size, -1) if b.ndim == 2 or b.size else b.reshape(0, 1)


def joint_covariance(
    solve: Callable[[F64], F64], nodes: ArrayLike, num_nodes: int, node_size: int
) -> F64:
    """Return the inverse at the rows of some nodes (m d, m d), by solving for their columns."""
    chosen = np.asarray(nodes, dtype=np.int64)
    rows = (chosen[:, None] * node_size + np.arange(node_size)).reshape(-1)
    unit = np.zeros((num_nodes * node_size, len(rows)))
    unit[rows, np.arange(len(rows))] = 1.0
    covariance = solve(unit)[rows]
    return np.asarray(0.5 * (covariance + covariance.T))


@compiled()
def upper_columns(rows: I32, cols: I32, position: I64) -> tuple[I64, I32]:
    """Return the strictly upper pattern by columns: (offsets (n + 1,), rows), duplicates included.

    Blocks are counted, not sorted: beside the result nothing of their number is allocated.

    Args:
        rows: Block rows (B,).
        cols: Block columns (B,).
        position: New number of every node (n,).
    """
    n = len(position)
    start = np.zeros(n + 1, np.int64)
    for block in range(len(rows)):
        i, j = position[rows[block]], position[cols[block]]
        if i != j:
            start[max(i, j) + 1] += 1
    for node in range(n):
        start[node + 1] += start[node]
    following = start[:-1].copy()
    upper = np.empty(start[n], np.int32)
    for block in range(len(rows)):
        i, j = position[rows[block]], position[cols[block]]
        if i != j:
            high = max(i, j)
            upper[following[high]] = min(i, j)
            following[high] += 1
    return start, upper
