"""Fill-reducing order of the nodes: minimum degree on the graph of the block matrix.

Eliminating a node connects all its neighbours; eliminating nodes of few neighbours first keeps the
factor sparse (Liu 1985, multiple minimum degree). SuperLU inside scipy has that algorithm. An
INCOMPLETE factorisation that drops every off-diagonal entry makes it hand out the order without
paying for the fill of a factorisation whose numbers nobody needs.

Nodes with equal closed neighbourhoods (position and orientation of one camera, say) are ordered as
one: it makes the graph small, and they end up side by side, hence in one supernode.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maplab_py.estimation.linear.pattern import BlockPattern, sorted_distinct

I64 = NDArray[np.int64]


def minimum_degree(pattern: BlockPattern) -> I64:
    """Return the order (num_nodes,): entry k is the node that is eliminated as number k."""
    off_diagonal = pattern.rows != pattern.cols
    rows, cols = pattern.rows[off_diagonal], pattern.cols[off_diagonal]
    group, num_groups = indistinguishable_nodes(rows, cols, pattern.num_nodes)
    group_order = _superlu_minimum_degree(group[rows], group[cols], num_groups)
    position = np.empty(num_groups, dtype=np.int64)
    position[group_order] = np.arange(num_groups)
    return np.argsort(position[group], kind="stable")


def indistinguishable_nodes(rows: I64, cols: I64, num_nodes: int) -> tuple[I64, int]:
    """Group nodes whose neighbourhoods, themselves included, are equal.

    Neighbourhoods are compared by the sum of 52-bit random numbers drawn for their members; an
    accidental agreement would cost sparsity, never correctness.

    Returns:
        Group of every node (num_nodes,) and the number of groups.
    """
    label = np.random.default_rng(0).integers(1, 2**52, size=num_nodes).astype(np.uint64)
    edges = sorted_distinct(rows * num_nodes + cols)
    row, col = edges // max(num_nodes, 1), edges % max(num_nodes, 1)
    signature = label.copy()
    np.add.at(signature, row, label[col])
    np.add.at(signature, col, label[row])
    distinct, group = np.unique(signature, return_inverse=True)
    return np.asarray(group, dtype=np.int64), len(distinct)


def _superlu_minimum_degree(rows: I64, cols: I64, num_nodes: int) -> I64:
    from scipy.sparse import coo_array
    from scipy.sparse.linalg import spilu

    apart = rows != cols
    if not np.any(apart):
        return np.arange(num_nodes)
    i, j = rows[apart], cols[apart]
    diagonal = np.arange(num_nodes)
    # duplicates are summed: the diagonal must dominate by far whatever their number
    entries = np.concatenate([np.full(2 * len(i), 1.0), np.full(num_nodes, 1e6 * (len(i) + 1.0))])
    places = (np.concatenate([i, j, diagonal]), np.concatenate([j, i, diagonal]))
    matrix = coo_array((entries, places), shape=(num_nodes, num_nodes)).tocsc()
    factors = spilu(
        matrix,
        drop_tol=1.0,
        fill_factor=1.0,
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    return np.argsort(factors.perm_c).astype(np.int64)
