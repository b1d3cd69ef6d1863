"""Wide panels, and the storage in which matrices are summed and factorised."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.solution import effort
from maplab_py.estimation.linear.block_cholesky import BlockCholesky
from maplab_py.estimation.linear.ordering import AUTOMATIC
from maplab_py.estimation.linear.pattern import BlockPattern
from maplab_py.estimation.linear.supernodal import SCRATCH_SIZE
from maplab_py.estimation.linear.supernodal_solver import SupernodalCholesky
from maplab_py.estimation.linear.symbolic import analyse
from tests.estimation.linear.systems import STRUCTURES, system

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


def random_system(rows: np.ndarray, cols: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return values (B, 3, 3) of a definite matrix, and the matrix."""
    rng = np.random.default_rng(0)
    values = rng.normal(size=(len(rows), D, D))
    strict = rows != cols
    values[~strict] = values[~strict] @ np.swapaxes(values[~strict], 1, 2)
    values[~strict] += 8.0 * np.sqrt(n) * np.eye(D)
    dense = np.zeros((n, D, n, D))
    np.add.at(dense.transpose(0, 2, 1, 3), (rows, cols), values)
    upper = np.swapaxes(values[strict], 1, 2)
    np.add.at(dense.transpose(0, 2, 1, 3), (cols[strict], rows[strict]), upper)
    return values, dense.reshape(n * D, n * D)


def test_wide_fronts_are_cut_and_solved() -> None:
    """Every way of an update: whole and scattered, in tiles, and straight into the panel."""
    rows, cols, n = arrow(branches=4, length=3, trunk=400)
    pattern = BlockPattern.checked(rows, cols, n, D)
    plan = analyse(pattern, AUTOMATIC).plan
    width = np.diff(plan.first_node) * D
    assert width.max() <= 256
    assert (np.diff(plan.below_start).max() * D) ** 2 > SCRATCH_SIZE
    values, dense = random_system(rows, cols, n)
    solver = BlockCholesky(rows, cols, n, D)
    solver.factor(values)
    b = np.random.default_rng(1).normal(size=(n * D, 2))
    wanted = np.linalg.solve(dense, b)
    np.testing.assert_allclose(solver.solve(b), wanted, atol=1e-11 * np.abs(wanted).max())
    inverse = np.linalg.inv(dense).reshape(n, D, n, D)
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
    solver = SupernodalCholesky(rows, cols, n, D)
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
    solver = SupernodalCholesky(rows, cols, n, D)
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


def test_a_factor_that_is_gone_is_not_used() -> None:
    node = np.zeros(1, dtype=np.int32)
    solver = SupernodalCholesky(node, node, 1, D)
    solver.clear()
    solver.add_to_diagonal(np.full((1, D), 2.0))
    solver.factorise()
    np.testing.assert_allclose(solver.solve(np.ones((D, 1))), 0.5)
    solver.clear()
    with pytest.raises(ValueError, match="factorised"):
        solver.solve(np.ones((D, 1)))


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
        solver = SupernodalCholesky(rows, cols, n, D)
        places = solver.places(rows, cols)
        solver.clear()
        solver.add(rows, cols, places, values)
    factor_mb = 8.0 * solver.statistics.nonzeros / 2**20
    assert factor_mb > 100.0
    assert spent.peak_growth_mb <= 1.6 * factor_mb
