"""Symbolic analysis: what the Cholesky factor of a block pattern looks like, before any number.

With nodes numbered in elimination order:

1. The ELIMINATION TREE: the parent of node j is the first node below the diagonal in column j of
   the factor (Liu 1990). Numbering nodes in POSTORDER of the tree keeps the fill and puts every
   subtree in one piece.
2. COLUMN STRUCTURES: the rows of column j of the factor are those of column j of the matrix and
   those of its children's columns, without the rows above (Davis, Direct Methods, ch. 4); row by
   row, they are paths of the tree.
3. SUPERNODES: neighbouring columns with the same structure are kept as one dense panel (Ng and
   Peyton 1993). Small ones are merged with their parents although that stores some zeros, because
   BLAS likes larger panels (Ashcraft and Grimes 1989).
4. For the multifrontal method: where every block of the matrix and every row of a child's update
   matrix goes in the front of its supernode.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from maplab_py.compilation import compiled
from maplab_py.estimation.linear.ordering import minimum_degree
from maplab_py.estimation.linear.pattern import BlockPattern, sorted_distinct
from maplab_py.estimation.linear.protocol import FactorStatistics

I64 = NDArray[np.int64]


class FrontPlan(NamedTuple):
    """What the numeric kernels need to know. S supernodes in postorder.

    A node's position is its place in the elimination order. The front of supernode s is a dense
    matrix over its own nodes (positions `first_node[s]` .. `first_node[s + 1] - 1`) followed by the
    nodes below, `below[below_start[s]]` .. `below[below_start[s + 1] - 1]`. Its first columns are
    kept as a panel of the factor.
    """

    node_size: int
    order: I64  # (n,) node at each position
    first_node: I64  # (S + 1,)
    below_start: I64  # (S + 1,)
    below: I64  # (R,) positions of nodes below the diagonal block
    below_in_parent: I64  # (R,) the same nodes as local nodes of the parent's front
    child_count: I64  # (S,)
    panel_start: I64  # (S + 1,) offsets into the factor's numbers
    block_of: I64  # (B,) matrix blocks sorted by supernode
    block_start: I64  # (S + 1,) offsets into block_of
    block_row: I64  # (B,) local node of the block's row in its front
    block_col: I64  # (B,)
    block_is_transposed: NDArray[np.bool_]  # (B,) the order put the block's column below its row


@dataclasses.dataclass(frozen=True, eq=False)
class SymbolicFactor:
    """Structure of the factor and the room that the numeric kernels need."""

    plan: FrontPlan
    stack_size: int  # numbers that wait on the stack of update matrices at most
    front_size: int  # numbers of the largest update matrix
    statistics: FactorStatistics


def analyse(
    pattern: BlockPattern, ordering: Callable[[BlockPattern], I64] = minimum_degree
) -> SymbolicFactor:
    """Order the nodes and find the factor's structure."""
    order = ordering(pattern)
    parent = elimination_tree(*_upper_columns(pattern, _inverse(order)))
    order = order[postorder(parent)]
    position = _inverse(order)
    start, upper = _upper_columns(pattern, position)
    parent = elimination_tree(start, upper)
    structure_start, structure = column_structures(start, upper, parent)
    first_node = supernodes(structure_start, parent, pattern.node_size)
    return _plan_fronts(pattern, order, position, first_node, structure_start, structure)


def _plan_fronts(
    pattern: BlockPattern,
    order: I64,
    position: I64,
    first_node: I64,
    structure_start: I64,
    structure: I64,
) -> SymbolicFactor:
    d = pattern.node_size
    width = np.diff(first_node)
    count = len(width)
    last = first_node[1:] - 1  # a supernode's rows below are those of its last column
    below_start = _offsets(structure_start[last + 1] - structure_start[last])
    below = _ranges(structure, structure_start[last], below_start)
    supernode_of = np.repeat(np.arange(count), width)
    height = np.diff(below_start)
    has_parent = height > 0
    parent = np.full(count, -1, dtype=np.int64)
    parent[has_parent] = supernode_of[below[below_start[:-1][has_parent]]]
    low = np.minimum(position[pattern.rows], position[pattern.cols])
    high = np.maximum(position[pattern.rows], position[pattern.cols])
    owner = supernode_of[low]
    rows = (width + height).astype(np.int64)
    wide, tall = (width * d).astype(np.float64), (height * d).astype(np.float64)
    flops = float(np.sum(wide**3 / 3.0 + wide**2 * tall + wide * tall**2))
    panel_start = _offsets(rows * width * d * d)
    plan = FrontPlan(
        node_size=d,
        order=order,
        first_node=first_node,
        below_start=below_start,
        below=below,
        below_in_parent=local_rows(
            below, np.repeat(parent, height), first_node, below_start, below
        ),
        child_count=np.bincount(parent[has_parent], minlength=count).astype(np.int64),
        panel_start=panel_start,
        block_of=np.argsort(owner, kind="stable"),
        block_start=_offsets(np.bincount(owner, minlength=count)),
        block_row=local_rows(high, owner, first_node, below_start, below),
        block_col=low - first_node[owner],
        block_is_transposed=position[pattern.rows] < position[pattern.cols],
    )
    return SymbolicFactor(
        plan=plan,
        stack_size=int(stack_height(height * d, parent)),
        front_size=int(height.max(initial=0) * d) ** 2,
        statistics=FactorStatistics(
            num_nodes=pattern.num_nodes,
            node_size=d,
            nonzeros=int(panel_start[-1]),
            flops=flops,
            supernodes=count,
            largest_front=int(rows.max(initial=0)) * d,
        ),
    )


def _inverse(order: I64) -> I64:
    position = np.empty(len(order), dtype=np.int64)
    position[order] = np.arange(len(order))
    return position


def _offsets(counts: NDArray[np.int64]) -> I64:
    start = np.zeros(len(counts) + 1, dtype=np.int64)
    np.cumsum(counts, out=start[1:])
    return start


def _ranges(items: I64, first: I64, start: I64) -> I64:
    """Concatenate items[first[i] : first[i] + start[i + 1] - start[i]] over all i."""
    shift = np.repeat(first - start[:-1], np.diff(start))
    return np.asarray(items[np.arange(start[-1]) + shift])


def _upper_columns(pattern: BlockPattern, position: I64) -> tuple[I64, I64]:
    """Return the strictly upper pattern by columns: (offsets (n + 1,), rows)."""
    r, c = position[pattern.rows], position[pattern.cols]
    key = np.maximum(r, c) * pattern.num_nodes + np.minimum(r, c)
    key = sorted_distinct(key[r != c])
    col, row = key // max(pattern.num_nodes, 1), key % max(pattern.num_nodes, 1)
    return _offsets(np.bincount(col, minlength=pattern.num_nodes)), row


@compiled()
def elimination_tree(start: I64, upper: I64) -> I64:
    """Return the parent (n,) of every node, -1 for roots, of the upper pattern by columns.

    `ancestor` shortens the paths that were walked already (Liu 1990).
    """
    n = len(start) - 1
    parent = np.full(n, -1, np.int64)
    ancestor = np.full(n, -1, np.int64)
    for node in range(n):
        for entry in range(start[node], start[node + 1]):
            below = upper[entry]
            while below != -1 and below < node:
                following = ancestor[below]
                ancestor[below] = node
                if following == -1:
                    parent[below] = node
                below = following
    return parent


@compiled()
def postorder(parent: I64) -> I64:
    """Return the nodes (n,) of a forest such that children come before their parents."""
    n = len(parent)
    first_child = np.full(n, -1, np.int64)
    next_sibling = np.full(n, -1, np.int64)
    for node in range(n - 1, -1, -1):
        if parent[node] >= 0:
            next_sibling[node] = first_child[parent[node]]
            first_child[parent[node]] = node
    order = np.empty(n, np.int64)
    path = np.empty(n, np.int64)
    done = 0
    for root in range(n):
        if parent[root] != -1:
            continue
        depth = 0
        path[0] = root
        while depth >= 0:
            node = path[depth]
            child = first_child[node]
            if child == -1:
                order[done] = node
                done += 1
                depth -= 1
            else:
                first_child[node] = next_sibling[child]
                depth += 1
                path[depth] = child
    return order


@compiled()
def column_structures(start: I64, upper: I64, parent: I64) -> tuple[I64, I64]:
    """Return the rows below the diagonal of every factor column: (offsets (n + 1,), sorted rows).

    Row i of the factor has an entry in every column on the tree's paths from the columns of the
    matrix' row i up to i (Liu 1986, the row subtree). Rows are visited in ascending order, so every
    column's rows come sorted; the first round counts them, the second writes them down.
    """
    n = len(parent)
    structure_start = np.zeros(n + 1, np.int64)
    structure = np.empty(0, np.int64)
    next_entry = np.zeros(n, np.int64)
    for is_counting in (True, False):
        visited_by = np.full(n, -1, np.int64)
        for row in range(n):
            visited_by[row] = row
            for entry in range(start[row], start[row + 1]):
                col = upper[entry]
                while visited_by[col] != row:
                    visited_by[col] = row
                    if not is_counting:
                        structure[structure_start[col] + next_entry[col]] = row
                    next_entry[col] += 1
                    col = parent[col]
        if is_counting:
            for col in range(n):
                structure_start[col + 1] = structure_start[col] + next_entry[col]
                next_entry[col] = 0
            structure = np.empty(structure_start[n], np.int64)
    return structure_start, structure


@compiled()
def supernodes(structure_start: I64, parent: I64, node_size: int) -> I64:
    """Return the first node of every supernode, and n at the end: (S + 1,).

    A column joins the supernode of the column before it when that one is its child and either
    the structures agree, or few zeros have to be stored: less than 80 % of a panel up to
    16 scalar columns wide, 10 % up to 48, 5 % beyond.
    """
    n = len(parent)
    first_node = np.empty(n + 1, np.int64)
    zeros = np.zeros(n, np.float64)  # scalar zeros stored by each supernode
    count = 0
    for node in range(n):
        # a new column is a supernode of its own first; then it may swallow the one before,
        # and the result the one before that
        first_node[count] = node
        zeros[count] = 0.0
        count += 1
        height = structure_start[node + 1] - structure_start[node]
        while count > 1:
            child_first = first_node[count - 2]
            child_last = first_node[count - 1] - 1
            if parent[child_last] != first_node[count - 1]:
                break
            child_width = child_last + 1 - child_first
            width = node + 1 - child_first
            child_height = structure_start[child_last + 1] - structure_start[child_last]
            extra = (node - child_last + height - child_height) * child_width
            stored = zeros[count - 2] + zeros[count - 1] + extra
            total = width * (width + 1) / 2 + width * height
            share = stored / total
            columns = width * node_size
            if not (
                extra == 0
                or (columns <= 16 and share < 0.8)
                or (columns <= 48 and share < 0.1)
                or share < 0.05
            ):
                break
            zeros[count - 2] = stored
            count -= 1
    first_node[count] = n
    return first_node[: count + 1].copy()


@compiled()
def local_rows(nodes: I64, fronts: I64, first_node: I64, below_start: I64, below: I64) -> I64:
    """Return the place of each node (m,) in the front of supernode fronts (m,)."""
    local = np.empty(len(nodes), np.int64)
    for item in range(len(nodes)):
        front, node = fronts[item], nodes[item]
        if front < 0:
            local[item] = -1
        elif node < first_node[front + 1]:
            local[item] = node - first_node[front]
        else:
            rows = below[below_start[front] : below_start[front + 1]]
            width = first_node[front + 1] - first_node[front]
            local[item] = width + np.searchsorted(rows, node)
    return local


@compiled()
def stack_height(update_rows: I64, parent: I64) -> int:
    """Return how many numbers the stack of update matrices holds at most, in postorder."""
    waiting = np.zeros(len(parent), np.int64)  # numbers of the children of a supernode
    height = 0
    highest = 0
    for front in range(len(parent)):
        size = update_rows[front] * update_rows[front]
        height += size - waiting[front]
        highest = max(highest, height)
        if parent[front] >= 0:
            waiting[parent[front]] += size
    return highest
