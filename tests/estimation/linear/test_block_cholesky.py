"""Symbolic analysis, factors of blocks and supernodes, and their threads."""

import numba
import numpy as np
import pytest
from threadpoolctl import threadpool_info

from benchmarks.solution import effort
from maplab_py.estimation.linear import ordering, protocol, supernodal, supernodal_solver
from maplab_py.estimation.linear.block_cholesky import BlockCholesky
from maplab_py.estimation.linear.pattern import BlockPattern, upper_columns
from maplab_py.estimation.linear.symbolic import analyse, postorder
from maplab_py.estimation.linear.threads import single_blas_thread, single_thread
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
    fill = _dense_fill(pattern, ordering.minimum_degree(pattern)).sum()
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
    group, count = ordering.indistinguishable_nodes(start, upper)
    assert count == 4
    assert group[0] == group[1]
    assert len({group[0], group[2], group[3], group[4]}) == 4


@pytest.mark.parametrize("node_size", [1, 3, 6])
@pytest.mark.parametrize("name", STRUCTURES)
def test_solution_and_inverse_agree_with_dense_algebra(node_size, name):
    rows, cols, n, values, dense = system(name, node_size, seed=3)
    solver = BlockCholesky(rows, cols, n, node_size)
    solver.factor(values)
    b = np.random.default_rng(1).normal(size=(n * node_size, 3))
    expected = np.linalg.solve(dense, b)
    np.testing.assert_allclose(solver.solve(b), expected, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(solver.solve(b[:, 0]), expected[:, 0], rtol=1e-9, atol=1e-12)
    inverse = np.linalg.inv(dense)
    d = node_size
    for block, value in enumerate(solver.inverse_blocks()):
        row, col = rows[block] * d, cols[block] * d
        np.testing.assert_allclose(value, inverse[row : row + d, col : col + d], atol=1e-12)


@pytest.mark.parametrize("d", [3, 6])
@pytest.mark.parametrize("name", ["one node", "chain", "star", "cameras"])
def test_indefinite_matrix_is_refused_and_the_solver_lives_on(name, d):
    rows, cols, n, values, dense = system(name, d, seed=5)
    solver = BlockCholesky(rows, cols, n, d)
    bad = values.copy()
    victim = n // 2
    bad[(rows == victim) & (cols == victim), 1, 1] = -1e6
    with pytest.raises(protocol.NotPositiveDefinite) as caught:
        solver.factor(bad)
    # the node is the bad one, or an ancestor that its pivot made bad
    assert 0 <= caught.value.node < n
    if name == "one node":
        assert caught.value.node == victim
    with pytest.raises(ValueError, match="factor"):
        solver.solve(np.ones(n * d))
    solver.factor(values)
    np.testing.assert_allclose(dense @ solver.solve(np.ones(n * d)), 1.0, atol=1e-9)


@pytest.mark.parametrize("node_size", [2, 6])
def test_a_node_without_information_and_one_that_is_not_a_number_are_named(node_size):
    rows, cols, n, values, _ = system("singletons", node_size, seed=0)
    for bad_value in (0.0, np.nan):
        bad = values.copy()
        bad[rows == 4] = bad_value
        solver = BlockCholesky(rows, cols, n, node_size)
        with pytest.raises(protocol.NotPositiveDefinite) as caught:
            solver.factor(bad)
        assert caught.value.node == 4


def test_matrix_without_rows():
    solver = BlockCholesky([], [], 0, 3)
    solver.factor(np.zeros((0, 3, 3)))
    assert solver.solve(np.zeros(0)).shape == (0,)


def test_only_the_lower_triangle_of_diagonal_blocks_is_read():
    rows, cols, n, values, dense = system("chain", 3, seed=2)
    noisy = values.copy()
    noisy[rows == cols] += np.triu(np.full((3, 3), 7.0), 1)
    b = np.ones(n * 3)
    solver = BlockCholesky(rows, cols, n, 3)
    solver.factor(noisy)
    np.testing.assert_allclose(dense @ solver.solve(b), b, atol=1e-9)


D = 3


def arrow(branches: int, length: int, trunk: int) -> tuple[np.ndarray, np.ndarray, int]:
    """Return lower blocks of chains whose nodes each see every third, other ones, of a dense trunk."""
    n = branches * length + trunk
    inner, outer = np.tril_indices(trunk)
    rows, cols = [np.arange(n), n - trunk + inner], [np.arange(n), n - trunk + outer]
    for branch in range(branches):
        chain = branch * length + np.arange(length)
        rows.append(chain[1:])
        cols.append(chain[:-1])
        seen = np.arange(n - trunk + branch % 3, n, 3)
        rows.append(np.repeat(seen, length))
        cols.append(np.tile(chain, len(seen)))
    return np.concatenate(rows), np.concatenate(cols), n


def random_system(
    rows: np.ndarray, cols: np.ndarray, n: int, d: int = D
) -> tuple[np.ndarray, np.ndarray]:
    """Return values (B, d, d) of a definite matrix, and the matrix."""
    rng = np.random.default_rng(0)
    values = rng.normal(size=(len(rows), d, d))
    strict = rows != cols
    values[~strict] = values[~strict] @ np.swapaxes(values[~strict], 1, 2)
    values[~strict] += 8.0 * np.sqrt(n) * np.eye(d)
    dense = np.zeros((n, d, n, d))
    np.add.at(dense.transpose(0, 2, 1, 3), (rows, cols), values)
    upper = np.swapaxes(values[strict], 1, 2)
    np.add.at(dense.transpose(0, 2, 1, 3), (cols[strict], rows[strict]), upper)
    return values, dense.reshape(n * d, n * d)


@pytest.mark.parametrize(("d", "trunk", "widest"), [(3, 400, 256), (6, 200, 96)])
def test_wide_fronts_are_cut_and_solved(d: int, trunk: int, widest: int) -> None:
    """Every way of an update: by blocks, whole and scattered, in tiles, and straight into the panel."""
    rows, cols, n = arrow(branches=4, length=3, trunk=trunk)
    pattern = BlockPattern.checked(rows, cols, n, d)
    plan = analyse(pattern, ordering.AUTOMATIC).plan
    width = np.diff(plan.first_node) * d
    assert width.max() <= widest
    assert (np.diff(plan.below_start).max() * d) ** 2 > supernodal.SCRATCH_SIZE
    values, dense = random_system(rows, cols, n, d)
    solver = BlockCholesky(rows, cols, n, d)
    solver.factor(values)
    b = np.random.default_rng(1).normal(size=(n * d, 2))
    wanted = np.linalg.solve(dense, b)
    np.testing.assert_allclose(solver.solve(b), wanted, atol=1e-11 * np.abs(wanted).max())
    inverse = np.linalg.inv(dense).reshape(n, d, n, d)
    found = solver.inverse_blocks()
    np.testing.assert_allclose(found, inverse[rows, :, cols], atol=1e-11 * np.abs(found).max())


def test_hardly_anything_is_stored_above_the_diagonal() -> None:
    n = 1000
    rows, cols = np.tril_indices(n)
    stored = analyse(BlockPattern.checked(rows, cols, n, D)).statistics.nonzeros
    lower = n * D * (n * D + 1) / 2
    assert lower <= stored <= 1.1 * lower


@pytest.mark.parametrize("name", STRUCTURES)
def test_blocks_come_back_as_they_were_summed(name: str) -> None:
    rows, cols, n, values, dense = system(name, D, seed=1)
    rows, cols = rows.astype(np.int32), cols.astype(np.int32)
    solver = supernodal_solver.SupernodalCholesky(rows, cols, n, D)
    places = solver.places(rows, cols)
    solver.clear()
    solver.add(rows, cols, places, values)
    solver.add(rows, cols, places, values)
    blocks = dense.reshape(n, D, n, D)[rows, :, cols]
    strict = rows != cols
    found = solver.blocks(rows, cols)
    np.testing.assert_allclose(found[strict], 2.0 * blocks[strict], atol=1e-12)
    np.testing.assert_allclose(np.tril(found), 2.0 * np.tril(blocks), atol=1e-12)


def test_projection_and_damping_are_those_of_dense_algebra() -> None:
    rows, cols, n, values, dense = system("cameras", D, seed=4)
    rng = np.random.default_rng(0)
    is_restricted = rng.random(n) < 0.4
    axes = rng.normal(size=(n, D))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    projector = np.tile(np.eye(D), (n, 1, 1))
    projector[is_restricted] -= axes[is_restricted, :, None] * axes[is_restricted, None, :]
    fixed = np.flatnonzero(is_restricted)[0]
    projector[fixed] = 0.0
    added, size = rng.uniform(0.1, 1.0, (n, D)), rng.uniform(1.0, 2.0, n)
    rows, cols = rows.astype(np.int32), cols.astype(np.int32)
    solver = supernodal_solver.SupernodalCholesky(rows, cols, n, D)
    solver.clear()
    solver.add(rows, cols, solver.places(rows, cols), values)
    solver.add_to_diagonal(added)
    solver.project(is_restricted, projector, size)
    solver.factorise()
    P = np.zeros((n * D, n * D))
    for node in range(n):
        P[node * D : node * D + D, node * D : node * D + D] = projector[node]
    wanted = P @ (dense + np.diag(added.reshape(-1))) @ P
    wanted += np.repeat(size, D)[:, None] * (np.eye(n * D) - P)
    b = rng.normal(size=(n * D, 1))
    np.testing.assert_allclose(solver.solve(b), np.linalg.solve(wanted, b), atol=1e-9)


@pytest.mark.flaky(reruns=2)  # a kernel that reclaims idle pages makes growth of what comes back
def test_memory_grows_by_little_more_than_the_factor() -> None:
    """Analysis, places and the sum of the blocks; factorising allocates nothing."""
    n, band = 3000, 700
    first = np.maximum(0, np.arange(n) - band + 1)
    rows = np.repeat(np.arange(n), np.arange(n) + 1 - first).astype(np.int32)
    cols = np.concatenate([np.arange(first[i], i + 1) for i in range(n)]).astype(np.int32)
    values = np.zeros((len(rows), D, D))
    BlockCholesky([0, 1, 1], [0, 0, 1], 2, D).factor(
        np.eye(D) * np.array([2.0, 1.0, 2.0])[:, None, None]
    )
    with effort() as spent:
        solver = supernodal_solver.SupernodalCholesky(rows, cols, n, D)
        places = solver.places(rows, cols)
        solver.clear()
        solver.add(rows, cols, places, values)
    factor_mb = 8.0 * solver.statistics.nonzeros / 2**20
    assert factor_mb > 100.0
    assert spent.peak_growth_mb <= 1.6 * factor_mb


def blas_threads() -> list[int]:
    """Return the threads of numpy's and scipy's libraries; OpenCV has its own, which no solver uses."""
    blas = [pool for pool in threadpool_info() if pool["user_api"] == "blas"]
    return [pool["num_threads"] for pool in blas if "opencv" not in pool["filepath"]]


def test_the_limit_lasts_until_the_last_user_leaves():
    with single_blas_thread():  # finds the libraries
        pass
    before = blas_threads()
    first, second = single_blas_thread(), single_blas_thread()
    first.__enter__()
    second.__enter__()
    assert set(blas_threads()) == {1}
    first.__exit__(None, None, None)  # threads may leave in any order
    assert set(blas_threads()) == {1}
    second.__exit__(None, None, None)
    assert blas_threads() == before


def test_compiled_loops_have_a_single_thread_until_the_end_or_an_error():
    before, inside = numba.get_num_threads(), []

    def fail():
        inside.append(numba.get_num_threads())
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError), single_thread():
        fail()
    assert inside == [1]
    assert numba.get_num_threads() == before
