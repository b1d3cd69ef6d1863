"""Nested dissection: cut the graph in halves, order each half, and eliminate the cut last.

Overlapping trajectories make a long thin graph. Minimum degree considers a single node at a time and
misses its small separators, which nested dissection searches for (George 1973). METIS finds them
in the graph alone (Karypis and Kumar 1998, multilevel nested dissection). Where METIS is not
installed, the graph is cut by the positions of the nodes.
"""

import importlib.util

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.estimation.linear.quotient_graph import QuotientGraph, inverse_order

_SEED = 0
_LEAF = 64
"""Groups that are not divided any further."""
_MOST_LEVELS = 30
"""Digits of a base-3 path that fit into 64 bits."""
_LEFT, _RIGHT, _CUT = 0, 1, 2


def has_metis() -> bool:
    """Return whether the optional package pymetis is installed."""
    return importlib.util.find_spec("pymetis") is not None


def dissect_by_metis(graph: QuotientGraph) -> I64:
    """Return the order (groups,) of METIS, with a fixed seed.

    Raises:
        ImportError: pymetis is not installed.
    """
    import pymetis

    if len(graph.rows) == 0:
        return np.arange(len(graph))
    adjacency = pymetis.CSRAdjacency(*graph.adjacency())
    weights = graph.size.astype(np.int32)
    order, _ = pymetis.nested_dissection(
        adjacency, vweights=weights, options=pymetis.Options(seed=_SEED)
    )
    return np.asarray(order, dtype=np.int64)


def dissect_by_position(graph: QuotientGraph, position_m: F64) -> I64:
    """Return the order (groups,) of cuts at the median along the longest axis.

    Nodes without a position are eliminated last of all.

    Args:
        graph: Groups of nodes.
        position_m: Position (num_nodes, 3) of every node; not-a-number = none.
    """
    place = _positions_of_groups(graph, position_m)
    count = len(graph)
    path = np.zeros(count, dtype=np.int64)  # digits of base 3, the first cut's first
    is_last = ~np.isfinite(place).all(axis=1)
    part = np.where(is_last, -1, 0)  # the part that is divided next; -1 = in a cut
    for _ in range(_MOST_LEVELS):
        members = np.bincount(part[part >= 0], minlength=1)
        active = (part >= 0) & (members[part] > _LEAF)
        digit = np.zeros(count, dtype=np.int64)
        if active.any():
            digit = _divided(graph, place, part, active)
        path = 3 * path + digit
        part = np.where(active & (digit != _CUT), 2 * part + digit, -1)
        part[part >= 0] = np.unique(part[part >= 0], return_inverse=True)[1]
    return np.lexsort((np.arange(count), path, is_last))


def _positions_of_groups(graph: QuotientGraph, position_m: F64) -> F64:
    """Return the mean position (groups, 3) of the nodes of each group."""
    total = np.zeros((len(graph), 3))
    np.add.at(total, graph.group, position_m)
    return np.asarray(total / graph.size[:, None])


def _divided(
    graph: QuotientGraph, place: F64, part: I64, active: np.typing.NDArray[np.bool_]
) -> I64:
    """Return for every active group whether it goes left, right or into the cut of its part."""
    rows = np.flatnonzero(active)
    parts, local = np.unique(part[rows], return_inverse=True)
    low, high = np.full((len(parts), 3), np.inf), np.full((len(parts), 3), -np.inf)
    np.minimum.at(low, local, place[rows])
    np.maximum.at(high, local, place[rows])
    axis = np.argmax(high - low, axis=1)
    along = place[rows, axis[local]]
    ranked = np.lexsort((rows, along, local))
    start = np.searchsorted(local[ranked], np.arange(len(parts)))
    rank = inverse_order(ranked) - start[local]
    digit = np.zeros(len(graph), dtype=np.int64)
    digit[rows] = np.where(2 * rank < np.bincount(local)[local], _LEFT, _RIGHT)
    a, b = graph.rows, graph.cols
    crosses = active[a] & active[b] & (part[a] == part[b]) & (digit[a] != digit[b])
    digit[_smaller_sides(a[crosses], b[crosses], digit, part)] = _CUT
    return digit


def _smaller_sides(a: I64, b: I64, digit: I64, part: I64) -> I64:
    """Return the ends of crossing edges (a, b) on that side of their part that has fewer of them."""
    is_left = digit[a] == _LEFT
    left, right = np.unique(np.where(is_left, a, b)), np.unique(np.where(is_left, b, a))
    size = len(digit)
    takes_left = np.bincount(part[left], minlength=size) <= np.bincount(part[right], minlength=size)
    return np.concatenate([left[takes_left[part[left]]], right[~takes_left[part[right]]]])
