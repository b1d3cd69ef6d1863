"""The quotient graph of a block pattern: nodes with equal neighbourhoods are merged.

Position and orientation of a camera, for instance, have blocks with the same other nodes. Merged
nodes make the graph small, and are adjacent in the order, hence in the same supernode.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.array_types import I32, I64, U64, Mask
from maplab_py.compilation import compiled
from maplab_py.distinct import distinct
from maplab_py.estimation.linear.pattern import BlockPattern, upper_columns


@dataclasses.dataclass(frozen=True, eq=False)
class QuotientGraph:
    """Groups of indistinguishable nodes, and which groups share a block."""

    group: I64  # (num_nodes,) group of every node
    size: I64  # (groups,) nodes of every group
    rows: I64  # (E,) of the strictly lower triangle, each edge once, ascending
    cols: I64  # (E,) ascending within a row

    @classmethod
    def of(cls, pattern: BlockPattern) -> QuotientGraph:
        """Group the nodes of a pattern."""
        every = np.arange(pattern.num_nodes, dtype=np.int64)
        start, upper = upper_columns(pattern.rows, pattern.cols, every)
        group, count = indistinguishable_nodes(start, upper)
        # nodes of a group have the same neighbours: the first of each tells them all
        member = np.full(count, pattern.num_nodes, dtype=np.int64)
        np.minimum.at(member, group, every)
        is_first = member[group] == every
        first, second = distinct_edges(start, upper, is_first)
        first, second = group[first], group[second]
        key = np.maximum(first, second) * max(count, 1) + np.minimum(first, second)
        key = distinct(key)
        size = np.bincount(group, minlength=count).astype(np.int64)
        return cls(group, size, key // max(count, 1), key % max(count, 1))

    def __len__(self) -> int:
        return len(self.size)

    def adjacency(self, *, has_diagonal: bool = False) -> tuple[I32, I32]:
        """Return the neighbours of every group: (offsets (groups + 1,), groups (2 E,) ascending).

        Both directions, no duplicates, and no diagonal unless it is asked for.
        """
        start, neighbours = neighbours_of_edges(self.rows, self.cols, len(self), has_diagonal)
        return start, neighbours

    def order_of_nodes(self, order: I64) -> I64:
        """Return the order (num_nodes,) of the nodes for an order (groups,) of the groups."""
        return np.argsort(inverse_order(order)[self.group], kind="stable")

    def work(self, order: I64, node_size: int) -> float:
        """Predict the floating-point operations of a factorisation in an order (groups,).

        From the column counts alone: zeros that supernodes store are not counted, and nothing of the
        size of the factor is allocated.
        """
        size = self.size[order]
        below = column_counts(*self._upper_columns(order), size).astype(np.float64) * node_size
        wide = size * float(node_size)
        return float(np.sum(wide**3 / 3.0 + wide**2 * below + wide * below**2))

    def _upper_columns(self, order: I64) -> tuple[I64, I64]:
        """Return the strictly upper pattern by columns in an order: offsets (groups + 1,), rows."""
        position = inverse_order(order)
        first, second = position[self.rows], position[self.cols]
        key = np.sort(np.maximum(first, second) * len(self) + np.minimum(first, second))
        start = np.zeros(len(self) + 1, dtype=np.int64)
        np.cumsum(np.bincount(key // max(len(self), 1), minlength=len(self)), out=start[1:])
        return start, key % max(len(self), 1)


def inverse_order(order: I64) -> I64:
    """Return the position of every node: order[position[i]] = i."""
    position = np.empty(len(order), dtype=np.int64)
    position[order] = np.arange(len(order))
    return position


def indistinguishable_nodes(start: I64, upper: I32) -> tuple[I64, int]:
    """Group nodes whose neighbourhoods, themselves included, are equal.

    Neighbourhoods are compared by the sum of 52-bit random numbers drawn for their members; an
    accidental agreement would cost sparsity, never correctness.

    Args:
        start: Offsets (num_nodes + 1,) of the strictly upper pattern by columns.
        upper: Its rows; some may repeat.

    Returns:
        Group of every node (num_nodes,) and the number of groups.
    """
    num_nodes = len(start) - 1
    label = np.random.default_rng(0).integers(1, 2**52, size=num_nodes).astype(np.uint64)
    sums, group = np.unique(neighbour_sums(start, upper, label), return_inverse=True)
    return np.asarray(group, dtype=np.int64), len(sums)


@compiled()
def neighbour_sums(start: I64, upper: I32, label: U64) -> U64:
    """Return the sum (n,) of the labels of every node and its distinct neighbours."""
    total = label.copy()
    met_by = np.full(len(label), -1, np.int64)
    for col in range(len(label)):
        for row in upper[start[col] : start[col + 1]]:
            if met_by[row] != col:
                met_by[row] = col
                total[row] += label[col]
                total[col] += label[row]
    return total


@compiled()
def distinct_edges(start: I64, upper: I32, is_kept: Mask) -> tuple[I64, I64]:
    """Return both ends (E,) of the edges between nodes that are kept, each edge once."""
    n = len(start) - 1
    first, second = np.empty(0, np.int64), np.empty(0, np.int64)
    for is_counting in (True, False):
        count = 0
        met_by = np.full(n, -1, np.int64)
        for col in range(n):
            if not is_kept[col]:
                continue
            for row in upper[start[col] : start[col + 1]]:
                if is_kept[row] and met_by[row] != col:
                    met_by[row] = col
                    if not is_counting:
                        first[count], second[count] = col, row
                    count += 1
        if is_counting:
            first, second = np.empty(count, np.int64), np.empty(count, np.int64)
    return first, second


@compiled()
def neighbours_of_edges(rows: I64, cols: I64, n: int, has_diagonal: bool) -> tuple[I32, I32]:
    """Return offsets (n + 1,) and neighbours, ascending, of edges by row > col, then col, ascending."""
    start = np.zeros(n + 1, np.int32)
    for edge in range(len(rows)):
        start[rows[edge] + 1] += 1
        start[cols[edge] + 1] += 1
    for node in range(n):
        start[node + 1] += start[node] + (1 if has_diagonal else 0)
    following = start[:-1].copy()
    neighbours = np.empty(start[n], np.int32)
    for edge in range(len(rows)):
        neighbours[following[rows[edge]]] = cols[edge]
        following[rows[edge]] += 1
    if has_diagonal:
        for node in range(n):
            neighbours[following[node]] = node
            following[node] += 1
    for edge in range(len(rows)):
        neighbours[following[cols[edge]]] = rows[edge]
        following[cols[edge]] += 1
    return start, neighbours


@compiled()
def column_counts(start: I64, upper: I64, weight: I64) -> I64:
    """Return the weight below the diagonal of every factor column (n,).

    Row i of the factor has entries on the paths of the elimination tree from the columns of the
    matrix' row i up to i (Liu 1986, the row subtree); the tree grows as the rows are visited.

    Args:
        start: Offsets (n + 1,) of the strictly upper pattern by columns.
        upper: Its rows.
        weight: Weight of every row (n,).
    """
    n = len(start) - 1
    parent = np.full(n, -1, np.int64)
    visited_by = np.full(n, -1, np.int64)
    count = np.zeros(n, np.int64)
    for row in range(n):
        visited_by[row] = row
        for entry in range(start[row], start[row + 1]):
            col = upper[entry]
            while visited_by[col] != row:
                if parent[col] == -1:
                    parent[col] = row
                count[col] += weight[row]
                visited_by[col] = row
                col = parent[col]
    return count
