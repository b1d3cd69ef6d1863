"""Derivatives of the pose graph's cost against finite differences of the cost itself."""

from __future__ import annotations

import numpy as np
import pytest

from maplab_py.algorithms.relaxation import kernels
from maplab_py.algorithms.relaxation.optimizer import PoseGraphOptimizer
from maplab_py.algorithms.relaxation.pose_graph import RelativePoses, TiltPriors, clusters
from maplab_py.estimation.linear.ordering import exact_minimum_degree, minimum_degree
from maplab_py.estimation.linear.pattern import BlockPattern
from maplab_py.estimation.linear.symbolic import analyse
from maplab_py.geometry import se3, so3


def _edges(rng, T, a, b, *, is_log, error):
    T_A_B = se3.compose(
        se3.relative(T[a], T[b]), se3.inverse(se3.exp(error * rng.normal(size=(len(a), 6))))
    )
    W = rng.normal(size=(len(a), 6, 6)) + 2.0 * np.eye(6)
    return RelativePoses(a, b, T_A_B, W, np.full(len(a), is_log))


def _poses(rng, count):
    return se3.make(so3.exp(rng.normal(size=(count, 3))), rng.normal(size=(count, 3)))


def _system(optimizer, T, bend):
    """Return the gradient (n,) and the matrix (n, n) of the normal equations."""
    linear = optimizer._linearize(T, 1.0, bend)
    pattern, size = optimizer._solver._pattern, len(linear.gradient)
    H = np.zeros((size, size, 6, 6))
    for row, col, block in zip(pattern.rows, pattern.cols, optimizer._blocks, strict=True):
        if row == col:  # the lower triangle counts
            H[row, col] += np.tril(block) + np.tril(block, -1).T
        else:
            H[row, col] += block
            H[col, row] += block.T
    return linear.gradient.reshape(-1), H.transpose(0, 2, 1, 3).reshape(6 * size, 6 * size)


@pytest.mark.parametrize("is_log", [False, True])
def test_gradient_and_second_derivatives(is_log):
    rng = np.random.default_rng(4)
    T, free = _poses(rng, 4), np.array([False, True, True, True])
    a, b = np.array([1, 0, 3, 2, 3]), np.array([0, 2, 1, 3, 2])  # either way round
    edges = _edges(rng, T, a, b, is_log=is_log, error=0.1)
    tilt = TiltPriors.of_vertices(np.array([0, 2]), se3.retract(T, np.full(6, 0.05)), 5.0)
    optimizer = PoseGraphOptimizer(
        free, edges.take(np.arange(3)), edges.take(np.arange(3, 5)), tilt, "none"
    )

    def half(*steps):
        moved = kernels.moved(T, np.arange(1, 4), sum(steps).reshape(3, 6))
        return 0.5 * optimizer.cost(moved, 1.0)

    gradient, H = _system(optimizer, T, bend=is_log)
    axes = 1e-4 * np.eye(18)
    numeric = np.array([(half(x) - half(-x)) / 2e-4 for x in axes])
    np.testing.assert_allclose(gradient, numeric, atol=1e-6)
    second = np.array(
        [
            [(half(x, y) - half(x, -y) - half(-x, y) + half(-x, -y)) / 4e-8 for y in axes]
            for x in axes
        ]
    )
    _, gauss_newton = _system(optimizer, T, bend=False)
    if is_log:  # the prior's second derivatives are left out
        level = np.r_[0:6, 12:18]
        H, second, gauss_newton = (M[np.ix_(level, level)] for M in (H, second, gauss_newton))
        missing = np.abs(second - gauss_newton).max()
        assert np.abs(second - H).max() < 0.01 * missing
    else:
        np.testing.assert_array_equal(H, gauss_newton)


def test_steps_are_exponentials():
    rng = np.random.default_rng(1)
    T, step = _poses(rng, 3), rng.normal(size=(3, 6))
    step[1] *= 1e-9
    moved = kernels.moved(T, np.array([0, 2, 1]), step)
    expected = se3.compose(T[[0, 2, 1]], se3.exp(step))[[0, 2, 1]]
    np.testing.assert_allclose(so3.to_matrix(moved[:, :4]), so3.to_matrix(expected[:, :4]))
    np.testing.assert_allclose(moved[:, 4:], expected[:, 4:])


def test_uncertainty_of_closures_is_that_of_the_inverse():
    rng = np.random.default_rng(7)
    T, free = _poses(rng, 5), np.array([False, True, True, True, True])
    chain = _edges(rng, T, np.arange(4), np.arange(1, 5), is_log=True, error=0.01)
    loops = _edges(rng, T, np.array([4, 1, 3]), np.array([0, 3, 2]), is_log=True, error=0.01)
    none = TiltPriors.of_vertices(np.zeros(0, dtype=np.int64), T, 1.0)
    optimizer = PoseGraphOptimizer(free, chain, loops, none, "none").plain()
    optimizer.trust(np.array([True, False, True]))
    _, H = _system(optimizer, T, bend=False)
    inverse = np.zeros((5, 5, 6, 6))
    inverse[1:, 1:] = np.linalg.inv(H).reshape(4, 6, 4, 6).transpose(0, 2, 1, 3)
    uncertainty = optimizer.closure_uncertainty(T)
    _, J_a, J_b = loops.linearized(T)
    for row, (a, b) in enumerate(zip(loops.from_vertex, loops.to_vertex, strict=True)):
        J = np.concatenate([J_a[row], J_b[row]], axis=1)
        joint = np.block([[inverse[a, a], inverse[a, b]], [inverse[b, a], inverse[b, b]]])
        np.testing.assert_allclose(uncertainty[row], J @ joint @ J.T, rtol=1e-6, atol=1e-9)


def test_parts_are_named_after_their_first_node():
    chain = _edges(
        np.random.default_rng(0),
        se3.identity()[None].repeat(9, axis=0),
        np.array([7, 1, 3, 4]),
        np.array([6, 3, 5, 7]),
        is_log=False,
        error=0.0,
    )
    np.testing.assert_array_equal(clusters(9, [chain]), [0, 1, 2, 1, 4, 1, 4, 4, 8])


@pytest.mark.parametrize("count", [1, 60, 64, 65, 400])
def test_exact_minimum_degree_fills_in_no_more_than_the_other(count):
    rng = np.random.default_rng(count)
    nodes = np.arange(count)
    far = np.sort(rng.integers(0, count, (2, count // 4)), axis=0)
    rows = np.concatenate([nodes, nodes[1:], far[1]])
    cols = np.concatenate([nodes, nodes[:-1], far[0]])
    pattern = BlockPattern.checked(rows, cols, count, 6)
    order = exact_minimum_degree(pattern)
    np.testing.assert_array_equal(np.sort(order), nodes)
    exact, other = (
        analyse(pattern, way).statistics.nonzeros for way in (exact_minimum_degree, minimum_degree)
    )
    assert exact <= 1.1 * other
