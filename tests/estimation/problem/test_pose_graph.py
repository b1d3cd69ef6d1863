"""Normal equations of pose graphs against finite differences of the cost, steps, uncertainty."""

import numpy as np
import pytest

from maplab_py.estimation.loss import Loss
from maplab_py.estimation.problem.gauge import clusters
from maplab_py.estimation.problem.pose_graph import PoseGraphProblem
from maplab_py.estimation.symbolic.sources import PoseError
from maplab_py.estimation.terms.pose_graph import RelativePoses, TiltPriors
from maplab_py.geometry import se3, so3


def _edges(rng, T, a, b, *, kind, error):
    T_A_B = se3.compose(
        se3.relative(T[a], T[b]), se3.inverse(se3.exp(error * rng.normal(size=(len(a), 6))))
    )
    W = rng.normal(size=(len(a), 6, 6)) + 2.0 * np.eye(6)
    return RelativePoses(a, b, T_A_B, W, kind)


def _poses(rng, count):
    return se3.make(so3.exp(rng.normal(size=(count, 3))), rng.normal(size=(count, 3)))


def _system(problem, T):
    """Return the gradient (n,) and the matrix (n, n) of the normal equations."""
    system = problem.linearize(T, 0.0).system
    pattern, size = problem._solver._pattern, len(system.gradient)
    H = np.zeros((size, size, 6, 6))
    for row, col, block in zip(pattern.rows, pattern.cols, system.blocks, strict=True):
        if row == col:  # the lower triangle counts
            H[row, col] += np.tril(block) + np.tril(block, -1).T
        else:
            H[row, col] += block
            H[col, row] += block.T
    return system.gradient.reshape(-1).copy(), H.transpose(0, 2, 1, 3).reshape(6 * size, 6 * size)


def _problem(rng, kind, loss=Loss.NONE, error=0.3):
    """Return poses and a problem of four, the first fixed, with edges either way round."""
    T, free = _poses(rng, 4), np.array([False, True, True, True])
    a, b = np.array([1, 0, 3, 2, 3]), np.array([0, 2, 1, 3, 2])
    edges = _edges(rng, T, a, b, kind=kind, error=error)
    tilt = TiltPriors.of_vertices(np.array([0, 2]), se3.retract(T, np.full(6, 0.05)), 5.0)
    loops = edges.take(np.arange(3, 5))
    return T, PoseGraphProblem(free, edges.take(np.arange(3)), loops, tilt, loss)


def _half_cost(problem, T, *twists):
    moved = T.copy()
    moved[1:] = se3.compose(T[1:], se3.exp(sum(twists).reshape(3, 6)))
    return 0.5 * problem.cost(moved)


@pytest.mark.parametrize("kind", PoseError)
@pytest.mark.parametrize("loss", [Loss.NONE, Loss.DCS, Loss.GEMAN_MCCLURE, Loss.CAUCHY])
def test_gradient_is_the_derivative_of_the_cost(kind, loss):
    T, problem = _problem(np.random.default_rng(4), kind, loss)
    problem.set_squared_scale(2.0)
    gradient, _ = _system(problem, T)
    axes = 1e-4 * np.eye(18)
    numeric = [(_half_cost(problem, T, x) - _half_cost(problem, T, -x)) / 2e-4 for x in axes]
    np.testing.assert_allclose(gradient, numeric, atol=1e-6)


@pytest.mark.parametrize("kind", PoseError)
def test_second_derivatives_are_those_of_the_cost(kind):
    T, problem = _problem(np.random.default_rng(4), kind)
    axes = 1e-4 * np.eye(18)
    numeric = [
        [sum(s * _half_cost(problem, T, x, s * y) for s in (1, -1)) for y in axes] for x in axes
    ]
    opposite = [
        [sum(s * _half_cost(problem, T, -x, s * y) for s in (1, -1)) for y in axes] for x in axes
    ]
    second = (np.array(numeric) - opposite) / 4e-8
    _, gauss_newton = _system(problem, T)
    problem.set_second_order(True)
    _, H = _system(problem, T)
    level = np.r_[0:6, 12:18]  # the second derivatives of tilt priors are left out
    H, second, gauss_newton = (M[np.ix_(level, level)] for M in (H, second, gauss_newton))
    assert np.abs(second - gauss_newton).max() > 0.1
    np.testing.assert_allclose(H, second, atol=1e-5)


def test_tilt_priors_feel_tilt_only():
    T = se3.make(so3.exp([[0.1, -0.2, 0.3]]), [[1.0, 2.0, 3.0]])
    none = np.zeros(0, dtype=np.int64)
    edges = RelativePoses(none, none, np.zeros((0, 7)), np.zeros((0, 6, 6)))
    prior = TiltPriors.of_vertices(np.array([0]), T, 0.5)
    problem = PoseGraphProblem(np.array([True]), edges, edges, prior, Loss.NONE)
    moved = se3.compose(se3.make(so3.exp([0.0, 0.0, 0.7]), [3.0, 2.0, 1.0]), T)
    assert problem.cost(moved) == pytest.approx(0.0, abs=1e-12)
    tilted = se3.compose(se3.make(so3.exp([0.01, 0.0, 0.0]), np.zeros(3)), T)
    assert problem.cost(tilted) == pytest.approx((0.01 / np.deg2rad(0.5)) ** 2)


@pytest.mark.parametrize("angle_rad", [0.0, 1e-9, 1e-3, 0.1, 2.0])
def test_derivatives_of_tilt_priors(angle_rad):
    rng = np.random.default_rng(3)
    T, axes = _poses(rng, 1), 1e-5 * np.eye(6)
    turn = so3.exp(angle_rad * np.array([[0.48, -0.6, 0.64]]))
    measured = se3.compose(T, se3.make(turn, np.zeros((1, 3))))
    none = np.zeros(0, dtype=np.int64)
    edges = RelativePoses(none, none, np.zeros((0, 7)), np.zeros((0, 6, 6)))
    prior = TiltPriors.of_vertices(np.array([0]), measured, 20.0)
    problem = PoseGraphProblem(np.array([True]), edges, edges, prior, Loss.NONE)
    gradient, _ = _system(problem, T)

    def half(x):
        return 0.5 * problem.cost(se3.compose(T, se3.exp(x)[None]))

    numeric = [(half(x) - half(-x)) / 2e-5 for x in axes]
    np.testing.assert_allclose(gradient, numeric, atol=1e-7)


def test_promised_decrease_is_that_of_the_model():
    T, problem = _problem(np.random.default_rng(5), PoseError.LOGARITHM)
    gradient, H = _system(problem, T)
    diagonal = np.diag(H).copy()
    step = problem.try_step(T, problem.linearize(T, 0.0), 0.01)
    x = np.linalg.solve(H + 0.01 * np.diag(diagonal), -gradient)
    expected = se3.compose(T[1:], se3.exp(x.reshape(3, 6)))
    np.testing.assert_allclose(se3.local(step.states[1:], expected), 0.0, atol=1e-9)
    assert step.promised == pytest.approx(-gradient @ x - 0.5 * x @ H @ x)
    assert step.norm == pytest.approx(np.linalg.norm(x))
    assert step.cost == pytest.approx(0.5 * problem.cost(step.states))


def test_a_step_that_leads_uphill_is_shortened():
    T, problem = _problem(np.random.default_rng(2), PoseError.LOGARITHM, error=4.0)
    gradient, H = _system(problem, T)
    linear = problem.linearize(T, 0.0)
    step = problem.try_step(T, linear, 1e-9)
    x = np.linalg.solve(H + 1e-9 * np.diag(np.diag(H)), -gradient)
    share = step.norm / np.linalg.norm(x)
    assert 0.0 < share < 0.5
    assert step.cost == pytest.approx(_half_cost(problem, T, share * x))
    assert step.cost < linear.cost < _half_cost(problem, T, x)
    assert step.promised == pytest.approx(share * (-gradient @ x - 0.5 * share * x @ H @ x))


def test_inactive_closures_do_not_count():
    rng = np.random.default_rng(6)
    T, free = _poses(rng, 4), np.array([False, True, True, True])
    chain = _edges(rng, T, np.arange(3), np.arange(1, 4), kind=PoseError.SPLIT, error=0.1)
    loops = _edges(rng, T, np.array([3, 0]), np.array([0, 2]), kind=PoseError.SPLIT, error=0.1)
    both = PoseGraphProblem(free, chain, loops, TiltPriors.none(), Loss.NONE)
    both.linearize(T, 0.0)  # fills blocks that are to be empty afterwards
    both.set_active(np.array([False, True]))
    one = PoseGraphProblem(free, chain, loops.take(np.array([1])), TiltPriors.none(), Loss.NONE)
    assert both.cost(T) == pytest.approx(one.cost(T))
    for left, right in zip(_system(both, T), _system(one, T), strict=True):
        np.testing.assert_allclose(left, right, rtol=1e-12, atol=1e-12)


def test_poses_without_an_active_edge_do_not_make_the_others_singular():
    rng = np.random.default_rng(8)
    T, free = _poses(rng, 4), np.array([False, True, True, True])
    chain = _edges(rng, T, np.arange(2), np.arange(1, 3), kind=PoseError.SPLIT, error=0.1)
    loops = _edges(rng, T, np.array([0, 2]), np.array([2, 3]), kind=PoseError.SPLIT, error=0.1)
    problem = PoseGraphProblem(free, chain, loops, TiltPriors.none(), Loss.NONE)
    problem.set_active(np.array([True, False]))  # nothing holds pose 3
    assert np.isfinite(problem.closure_uncertainty(T)[0]).all()
    step = problem.try_step(T, problem.linearize(T, 0.0), 1e-8)
    np.testing.assert_allclose(step.states[3], T[3], atol=1e-12)
    assert problem.cost(step.states) < problem.cost(T)


def test_uncertainty_of_closures_is_that_of_the_inverse():
    rng = np.random.default_rng(7)
    T, free = _poses(rng, 5), np.array([False, True, True, True, True])
    kind = PoseError.LOGARITHM
    chain = _edges(rng, T, np.arange(4), np.arange(1, 5), kind=kind, error=0.01)
    loops = _edges(rng, T, np.array([4, 1, 3]), np.array([0, 3, 2]), kind=kind, error=0.01)
    problem = PoseGraphProblem(free, chain, loops, TiltPriors.none(), Loss.DCS).without_loss()
    problem.set_active(np.array([True, False, True]))
    _, H = _system(problem, T)
    inverse = np.zeros((5, 5, 6, 6))
    inverse[1:, 1:] = np.linalg.inv(H).reshape(4, 6, 4, 6).transpose(0, 2, 1, 3)
    uncertainty = problem.closure_uncertainty(T)
    jacobian = loops.linearized(T)[1]
    for row, (a, b) in enumerate(zip(loops.from_vertex, loops.to_vertex, strict=True)):
        J = np.concatenate(jacobian[row], axis=1)
        joint = np.block([[inverse[a, a], inverse[a, b]], [inverse[b, a], inverse[b, b]]])
        np.testing.assert_allclose(uncertainty[row], J @ joint @ J.T, rtol=1e-6, atol=1e-9)


def test_clusters_count_from_their_first_vertex():
    links = [(np.array([7, 1]), np.array([6, 3])), (np.array([3, 4]), np.array([5, 7]))]
    np.testing.assert_array_equal(clusters(9, links), [0, 1, 2, 1, 3, 1, 3, 3, 4])
    np.testing.assert_array_equal(clusters(3, []), [0, 1, 2])
