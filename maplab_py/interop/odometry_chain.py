"""Initial poses of a graph that has none: composed along odometry, then along other edges."""

from __future__ import annotations

import numpy as np

from maplab_py.array_types import F64, I64, U64
from maplab_py.geometry import se3


def chained_poses(id: U64, first: I64, second: I64, T_A_B: F64) -> F64:
    """Return poses T_G_V (V, 7) along a spanning forest of the edges, odometry before other edges.

    The first pose of every connected part is the identity.

    Args:
        id: Ids (V,), ascending; an edge between subsequent ids is odometry.
        first: Row of A (E,).
        second: Row of B (E,).
        T_A_B: Measured relative poses (E, 7).
    """
    parent, edge, is_forward = _spanning_forest(id, first, second)
    root = len(id)  # a further node above the first pose of every part
    step = se3.identity(root + 1)
    linked = np.flatnonzero(edge >= 0)
    measured = T_A_B[edge[linked]]
    forward = is_forward[linked, None]
    step[linked] = np.where(forward, measured, se3.inverse(measured))
    above = np.append(parent, root)
    while np.any(above != root):  # twice as far up in every round
        step = se3.compose(step[above], step)
        above = above[above]
    return np.asarray(step[:root])


def _spanning_forest(id: U64, first: I64, second: I64) -> tuple[I64, I64, np.ndarray]:
    """Return for every pose its parent, the edge that joins them (-1 = root), and its direction.

    A root's parent is V. Forward edges run from the parent to the pose.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import (
        breadth_first_order,
        connected_components,
        minimum_spanning_tree,
    )

    count = len(id)
    proper = np.flatnonzero(first != second)
    low = np.minimum(first[proper], second[proper])
    high = np.maximum(first[proper], second[proper])
    key, weight = low * count + high, np.where(id[high] - id[low] == 1, 1.0, 2.0)
    key, earliest = np.unique(key, return_index=True)
    edges, weight = proper[earliest], weight[earliest]
    ends = (key // count, key % count)
    graph = coo_array((weight, ends), shape=(count + 1, count + 1)).tocsr()
    _, part = connected_components(graph[:count, :count], directed=False)
    roots = np.unique(part, return_index=True)[1]
    tree = minimum_spanning_tree(graph).tocoo()
    rooted = coo_array(
        (
            np.ones(len(tree.data) + len(roots)),
            (np.append(tree.row, np.full(len(roots), count)), np.append(tree.col, roots)),
        ),
        shape=(count + 1, count + 1),
    ).tocsr()
    _, parent = breadth_first_order(rooted, count, directed=False)
    parent = parent[:count].astype(np.int64)
    rows = np.arange(count)
    wanted = np.minimum(rows, parent) * count + np.maximum(rows, parent)
    edge = np.full(count, -1, dtype=np.int64)
    linked = parent < count
    edge[linked] = edges[np.searchsorted(key, wanted[linked])]
    return parent, edge, np.asarray(second[edge] == rows)
