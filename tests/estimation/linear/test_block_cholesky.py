"""The solver against dense algebra, on every kind of structure."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from maplab_py.estimation.linear.block_cholesky import BlockCholesky
from maplab_py.estimation.linear.protocol import NotPositiveDefinite
from tests.estimation.linear.systems import STRUCTURES, system


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
    nodes = np.unique([0, n // 2, n - 1])[::-1]
    index = (nodes[:, None] * d + np.arange(d)).reshape(-1)
    np.testing.assert_allclose(
        solver.marginal_covariance(nodes), inverse[np.ix_(index, index)], atol=1e-12
    )


@settings(max_examples=40, deadline=None)
@given(st.sampled_from(STRUCTURES), st.integers(1, 5), st.integers(0, 10_000))
def test_solutions_are_those_of_dense_algebra_to_1e_9(name, node_size, seed):
    rows, cols, n, values, dense = system(name, node_size, seed)
    b = np.random.default_rng(seed).normal(size=n * node_size)
    solver = BlockCholesky(rows, cols, n, node_size)
    solver.factor(values)
    wanted = np.linalg.solve(dense, b)
    assert np.abs(solver.solve(b) - wanted).max() <= 1e-9 * np.abs(wanted).max()


@pytest.mark.parametrize("name", ["one node", "chain", "star", "cameras"])
def test_indefinite_matrix_is_refused_and_the_solver_lives_on(name):
    rows, cols, n, values, dense = system(name, 3, seed=5)
    solver = BlockCholesky(rows, cols, n, 3)
    bad = values.copy()
    victim = n // 2
    bad[(rows == victim) & (cols == victim), 1, 1] = -1e6
    with pytest.raises(NotPositiveDefinite) as caught:
        solver.factor(bad)
    # the node is the bad one, or an ancestor that its pivot made bad
    assert 0 <= caught.value.node < n
    if name == "one node":
        assert caught.value.node == victim
    with pytest.raises(ValueError, match="factor"):
        solver.solve(np.ones(n * 3))
    solver.factor(values)
    np.testing.assert_allclose(dense @ solver.solve(np.ones(n * 3)), 1.0, atol=1e-9)


def test_a_node_without_information_and_one_that_is_not_a_number_are_named():
    rows, cols, n, values, _ = system("singletons", 2, seed=0)
    for bad_value in (0.0, np.nan):
        bad = values.copy()
        bad[rows == 4] = bad_value
        solver = BlockCholesky(rows, cols, n, 2)
        with pytest.raises(NotPositiveDefinite) as caught:
            solver.factor(bad)
        assert caught.value.node == 4


def test_matrix_without_rows():
    solver = BlockCholesky([], [], 0, 3)
    solver.factor(np.zeros((0, 3, 3)))
    assert solver.solve(np.zeros(0)).shape == (0,)


def test_bad_arguments():
    with pytest.raises(ValueError, match="column <= row"):
        BlockCholesky([0], [1], 2, 3)
    with pytest.raises(ValueError, match="column <= row"):
        BlockCholesky([2], [0], 2, 3)
    with pytest.raises(ValueError, match="equal vectors"):
        BlockCholesky([0, 1], [0], 2, 3)
    solver = BlockCholesky([0, 1], [0, 1], 2, 3)
    with pytest.raises(ValueError, match="block values"):
        solver.factor(np.zeros((2, 2, 2)))
    solver.factor(np.stack([np.eye(3)] * 2))
    with pytest.raises(ValueError, match="right side"):
        solver.solve(np.zeros(5))


def test_refinement_reduces_the_residual_of_a_badly_scaled_system():
    rows, cols, n, values, dense = system("cameras", 3, seed=2)
    scale = 10.0 ** np.random.default_rng(0).uniform(-5, 5, size=n * 3)
    scaled = dense * scale[:, None] * scale
    for block in range(len(values)):
        r, c = rows[block] * 3, cols[block] * 3
        values[block] = scaled[r : r + 3, c : c + 3]
    solver = BlockCholesky(rows, cols, n, 3)
    solver.factor(values)
    b = scaled @ np.ones(n * 3)
    plain = np.linalg.norm(scaled @ solver.solve(b) - b)
    refined = np.linalg.norm(scaled @ solver.solve(b, refinements=2) - b)
    assert refined <= max(plain, 1e-15 * np.linalg.norm(b))


def test_same_bits_every_time_and_for_any_thread_setting():
    from threadpoolctl import threadpool_limits

    rows, cols, n, values, _ = system("cameras", 6, seed=2)
    b = np.random.default_rng(0).normal(size=n * 6)
    results = []
    for threads in (1, 2, 2):
        with threadpool_limits(threads):
            solver = BlockCholesky(rows, cols, n, 6)
            solver.factor(values)
            results.append(solver.solve(b).tobytes() + solver.inverse_blocks().tobytes())
    assert results[0] == results[1] == results[2]


def test_only_the_lower_triangle_of_diagonal_blocks_is_read():
    rows, cols, n, values, dense = system("chain", 3, seed=2)
    noisy = values.copy()
    noisy[rows == cols] += np.triu(np.full((3, 3), 7.0), 1)
    b = np.ones(n * 3)
    solver = BlockCholesky(rows, cols, n, 3)
    solver.factor(noisy)
    np.testing.assert_allclose(dense @ solver.solve(b, refinements=1), b, atol=1e-9)
