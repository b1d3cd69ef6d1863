"""The structure of the factor against a dense elimination."""

from __future__ import annotations

import numpy as np
import pytest

from maplab_py.estimation.linear.ordering import indistinguishable_nodes, minimum_degree
from maplab_py.estimation.linear.pattern import BlockPattern, upper_columns
from maplab_py.estimation.linear.symbolic import analyse, postorder
from tests.estimation.linear.systems import STRUCTURES, system


def _dense_fill(pattern, order):
    """Return the pattern (n, n) of the factor by elimination of a dense boolean matrix."""
    n = pattern.num_nodes
    full = np.eye(n, dtype=bool)
    full[pattern.rows, pattern.cols] = True
    full |= full.T
    full = full[np.ix_(order, order)]
    for k in range(n):
        below = np.flatnonzero(full[k + 1 :, k]) + k + 1
        full[np.ix_(below, below)] = True
    return np.tril(full)


@pytest.mark.parametrize("name", STRUCTURES)
def test_fronts_hold_the_factor_and_few_zeros_more(name):
    rows, cols, n, _, _ = system(name, 1, seed=7)
    pattern = BlockPattern.checked(rows, cols, n, 3)
    symbolic = analyse(pattern).plan
    assert sorted(symbolic.order) == list(range(n))
    held = np.zeros((n, n), dtype=bool)
    for s in range(len(symbolic.parent)):
        own = np.arange(symbolic.first_node[s], symbolic.first_node[s + 1])
        below = symbolic.below[symbolic.below_start[s] : symbolic.below_start[s + 1]]
        assert np.all(np.diff(below) > 0)
        assert np.all(below >= symbolic.first_node[s + 1])
        held[np.ix_(np.concatenate([own, below]), own)] = True
    held = np.tril(held)
    fill = _dense_fill(pattern, symbolic.order)
    assert np.all(held[fill])
    assert held.sum() <= 2.0 * fill.sum()


@pytest.mark.parametrize("name", ["chain", "star", "ring"])
def test_minimum_degree_makes_no_needless_fill(name):
    rows, cols, n, _, _ = system(name, 1, seed=7)
    pattern = BlockPattern.checked(rows, cols, n, 1)
    fill = _dense_fill(pattern, minimum_degree(pattern)).sum()
    tree_entries = 2 * n - 1
    assert fill <= tree_entries + (n if name == "ring" else 0)


def test_postorder_puts_every_subtree_in_one_piece():
    parent = np.array([3, 3, 4, 6, 5, 6, -1, -1, 7])
    order = postorder(parent)
    place = np.argsort(order)
    assert sorted(order) == list(range(9))
    for node, above in enumerate(parent):
        assert above < 0 or place[node] < place[above]
    assert set(order[place[3] - 2 : place[3]]) == {0, 1}


def test_nodes_with_equal_neighbourhoods_are_one_group():
    # nodes 0 and 1 see each other and 2; 2 sees 3 as well
    rows, cols = np.array([1, 2, 2, 3, 3]), np.array([0, 0, 1, 2, 2])
    pattern = BlockPattern.checked(rows, cols, 5, 1)
    start, upper = upper_columns(pattern.rows, pattern.cols, np.arange(5))
    group, count = indistinguishable_nodes(start, upper)
    assert count == 4
    assert group[0] == group[1]
    assert len({group[0], group[2], group[3], group[4]}) == 4
