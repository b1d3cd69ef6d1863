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
   Wide ones are cut, so that little is stored above the diagonal.
4. FRONTS: the rows of a supernode's panel, and where the rows below it lie in its parent's front.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from maplab_py.array_types import I32, I64
from maplab_py.compilation import compiled
from maplab_py.estimation.linear.ordering import AUTOMATIC
from maplab_py.estimation.linear.pattern import BlockPattern, upper_columns
from maplab_py.estimation.linear.protocol import FactorStatistics
from maplab_py.estimation.linear.quotient_graph import inverse_order
from maplab_py.vimap.table import starts_of_counts


class FrontPlan(NamedTuple):
    """Data of the numeric kernels. S supernodes in postorder.

    A node's position is its place in the elimination order. The front of supernode s are its own nodes
    (positions `first_node[s]` .. `first_node[s + 1] - 1`) followed by the nodes below,
    `below[below_start[s]]` .. `below[below_start[s + 1] - 1]`. Its panel holds the columns of its
    own nodes over all rows of the front, one column after another.
    """

    node_size: int
    order: I64  # (n,) node at each position
    first_node: I64  # (S + 1,)
    below_start: I64  # (S + 1,)
    below: I64  # (R,) positions of nodes below the diagonal block
    below_in_parent: I64  # (R,) the same nodes as local nodes of the parent's front
    parent: I64  # (S,) -1 = root
    panel_start: I64  # (S + 1,) offsets into the factor's numbers


_WIDEST, _WIDEST_OF_SIX = 256, 96
"""Columns of a panel at most: half of its square on the diagonal is stored in vain. Panels of nodes of
six numbers, which are not factorised by BLAS, should stay in the processor's cache."""


@dataclasses.dataclass(frozen=True, eq=False)
class SymbolicFactor:
    """Structure and size of the factor."""

    plan: FrontPlan
    statistics: FactorStatistics


def analyse(
    pattern: BlockPattern, ordering: Callable[[BlockPattern], I64] = AUTOMATIC
) -> SymbolicFactor:
    """Order the nodes and find the factor's structure."""
    order = ordering(pattern)
    parent = elimination_tree(*upper_columns(pattern.rows, pattern.cols, inverse_order(order)))
    order = order[postorder(parent)]
    start, upper = upper_columns(pattern.rows, pattern.cols, inverse_order(order))
    parent = elimination_tree(start, upper)
    structure_start, structure = column_structures(start, upper, parent)
    first_node = supernodes(structure_start, parent, pattern.node_size)
    return _plan_fronts(
        pattern, order, *_fronts(first_node, structure_start, structure, pattern.node_size)
    )


def _fronts(
    first_node: I64, structure_start: I64, structure: I64, node_size: int
) -> tuple[I64, I64, I64]:
    """Cut wide supernodes; return first nodes (S + 1,), offsets (S + 1,) and nodes (R,) below."""
    most = max(1, (_WIDEST_OF_SIX if node_size == 6 else _WIDEST) // node_size)
    count = -(-np.diff(first_node) // most)
    whole = np.repeat(np.arange(len(count)), count)  # supernode of every piece
    step = np.arange(len(whole)) - np.repeat(np.cumsum(count) - count, count)
    width = np.diff(first_node)[whole]
    pieces = first_node[whole] + step * width // count[whole]
    end = first_node[whole] + (step + 1) * width // count[whole]
    last = first_node[whole + 1] - 1  # the rows below a supernode are those of its last column
    outside = structure_start[last + 1] - structure_start[last]
    below_start = starts_of_counts(last + 1 - end + outside)
    below = np.empty(below_start[-1], dtype=np.int64)
    fill_below(end, last, structure_start, structure, below_start, below)
    return np.append(pieces, first_node[-1]), below_start, below


def _plan_fronts(
    pattern: BlockPattern, order: I64, first_node: I64, below_start: I64, below: I64
) -> SymbolicFactor:
    d = pattern.node_size
    width, height = np.diff(first_node), np.diff(below_start)
    count = len(width)
    supernode_of = np.repeat(np.arange(count), width)
    has_parent = height > 0
    parent = np.full(count, -1, dtype=np.int64)
    parent[has_parent] = supernode_of[below[below_start[:-1][has_parent]]]
    rows = (width + height).astype(np.int64)
    wide, tall = (width * d).astype(np.float64), (height * d).astype(np.float64)
    flops = float(np.sum(wide**3 / 3.0 + wide**2 * tall + wide * tall**2))
    panel_start = starts_of_counts(rows * width * d * d)
    in_parent = local_rows(below, np.repeat(parent, height), first_node, below_start, below)
    plan = FrontPlan(
        node_size=d,
        order=order,
        first_node=first_node,
        below_start=below_start,
        below=below,
        below_in_parent=in_parent,
        parent=parent,
        panel_start=panel_start,
    )
    return SymbolicFactor(
        plan=plan,
        statistics=FactorStatistics(
            num_nodes=pattern.num_nodes,
            node_size=d,
            nonzeros=int(panel_start[-1]),
            flops=flops,
            supernodes=count,
            largest_front=int(rows.max(initial=0)) * d,
        ),
    )


@compiled()
def elimination_tree(start: I64, upper: I32) -> I64:
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
def column_structures(start: I64, upper: I32, parent: I64) -> tuple[I64, I64]:
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
def fill_below(
    end: I64, last: I64, structure_start: I64, structure: I64, below_start: I64, below: I64
) -> None:
    """Write the nodes below every piece of a supernode: the supernode's further nodes, then its rows.

    Args:
        end: First node (S,) that is not a piece's.
        last: Last node (S,) of the whole supernode.
        structure_start: Offsets (n + 1,) into structure.
        structure: Rows below the diagonal of every column.
        below_start: Offsets (S + 1,) into the result.
        below: Result (R,).
    """
    for piece in range(len(end)):
        entry = below_start[piece]
        for node in range(end[piece], last[piece] + 1):
            below[entry] = node
            entry += 1
        for row in structure[structure_start[last[piece]] : structure_start[last[piece] + 1]]:
            below[entry] = row
            entry += 1


@compiled()
def most_below(plan: FrontPlan) -> int:
    """Return the largest number of nodes below a supernode."""
    most = 0
    for s in range(len(plan.first_node) - 1):
        most = max(most, plan.below_start[s + 1] - plan.below_start[s])
    return most
