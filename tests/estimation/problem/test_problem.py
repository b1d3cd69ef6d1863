"""Problems: residuals, steps uphill, trust region."""

import dataclasses
from functools import cache

import numpy as np
import pytest

from maplab_py.estimation.codegen.kernels import residual_kernel
from maplab_py.estimation.loss import Loss
from maplab_py.estimation.problem.problem import Linearization, Problem
from maplab_py.estimation.problem.solver import SolverOptions, optimize_states
from maplab_py.estimation.problem.trust_region import Schedule, StepJudge, TrustRegion
from maplab_py.estimation.states import NODES_PER_VERTEX, ORIENTATION, POSITION
from maplab_py.estimation.symbolic.sources import absolute_pose, relative_pose
from maplab_py.estimation.terms import factor as factor_terms
from maplab_py.estimation.terms import pose, protocol
from maplab_py.geometry import se3, so3
from maplab_py.progress import SILENT
from maplab_py.sensors import Distortion, Projection
from maplab_py.vimap import VIMap
from tests.estimation.dense import system_matrix
from tests.support.dense import DenseProblem, dense_problem
from tests.support.scene import EVERY_MODEL, Scene, corrupted

TWO_MODELS = ((Projection.PINHOLE, Distortion.FOV), (Projection.PINHOLE, Distortion.NONE))


def disturbed(scene: Scene, seed: int = 3) -> VIMap:
    return corrupted(
        scene.make(),
        np.random.default_rng(seed),
        position_m=0.02,
        quaternion=0.003,
        landmark_m=0.02,
        velocity_mps=0.05,
        gyro_bias=1e-3,
        accel_bias=0.02,
        keep=0,
    )


def small(**options: object) -> VIMap:
    return disturbed(Scene(vertices=4, landmarks=20, seen_share=0.8, **options))  # type: ignore[arg-type]


def pose_terms(dense: DenseProblem) -> list[protocol.FactorTerm]:
    """Return a relative term whose ends are against the rows' order, and an absolute one."""
    T_I_S = se3.make(so3.exp([[0.2, 0.1, -0.4]]), [[0.1, 0.2, -0.1]])
    T_G_S = se3.compose(dense.states.T_G_I, T_I_S)
    off = se3.exp(0.05 * np.arange(1.0, 7.0))
    spread = np.random.default_rng(2).normal(size=(6, 6))
    W = pose.whitening((spread @ spread.T + np.eye(6))[None] * 1e-3)
    first, second = np.array([2, 0]), np.array([1, 3])
    measured = se3.compose(se3.relative(T_G_S[first], T_G_S[second]), off)
    vertex = np.array([1])
    return [
        pose.RelativePoseTerm(
            residual_kernel("relative_pose", relative_pose),
            "odometry",
            first,
            second,
            np.repeat(T_I_S, 2, axis=0),
            measured,
            np.repeat(W, 2, axis=0),
        ),
        pose.AbsolutePoseTerm(
            residual_kernel("absolute_pose", absolute_pose),
            vertex,
            T_I_S,
            se3.compose(T_G_S[vertex], off),
            W,
        ),
    ]


@dataclasses.dataclass(frozen=True, eq=False)
class Everything:
    """All terms over two cameras, with numeric Jacobian and residuals; shared by tests."""

    dense: DenseProblem
    J: np.ndarray
    r: np.ndarray


@cache
def everything() -> Everything:
    dense = dense_problem(small(models=TWO_MODELS))
    dense.factors.extend(pose_terms(dense))
    dense.problem().linearize(dense.states, 0.0)  # integrates
    return Everything(dense, dense.jacobian(dense.states), dense.residuals(dense.states))


def assembled(problem: Problem, linear: Linearization) -> np.ndarray:
    """Return the undamped system matrix of the nodes as a dense one."""
    return system_matrix(problem, linear, 0.0)


def reduced(J: np.ndarray, r: np.ndarray, nodes: int, damping: float) -> tuple[np.ndarray, ...]:
    """Eliminate the columns behind `nodes` from J'J and J'r, those damped as landmarks are."""
    H, g = J.T @ J, J.T @ r
    A, B, C = H[:nodes, :nodes], H[:nodes, nodes:], H[nodes:, nodes:].copy()
    C += damping * np.diag(np.clip(np.diag(C), 1e-6, 1e32))
    return A - B @ np.linalg.solve(C, B.T), g[:nodes] - B @ np.linalg.solve(C, g[nodes:]), H, g


def assert_close(value: np.ndarray, wanted: np.ndarray, relative: float = 1e-6) -> None:
    """Compare entries against the size of the node's rows and columns they stand in."""
    assert value.shape == wanted.shape
    if wanted.ndim == 2 and wanted.shape[0] == wanted.shape[1]:
        size = np.sqrt(np.abs(np.diag(wanted)))
        scale = np.maximum(size[:, None] * size[None, :], 1e-9 * np.abs(wanted).max())
        assert np.max(np.abs(value - wanted) / scale) <= relative
    else:
        assert np.abs(value - wanted).max() <= relative * np.abs(wanted).max()


@pytest.mark.parametrize("model", EVERY_MODEL, ids=lambda m: "-".join(x.value for x in m))
@pytest.mark.parametrize("move_points", [False, True])
def test_reprojection_of_every_model(
    model: tuple[Projection, Distortion], move_points: bool
) -> None:
    dense = dense_problem(small(models=(model,)), include_inertial=False, move_points=move_points)
    J, r = dense.jacobian(dense.states), dense.residuals(dense.states)
    nodes = 15 * len(dense.states.T_G_I)
    S, g, H, _ = reduced(J, r, nodes, 1e-3)
    problem = dense.problem()
    linear = problem.linearize(dense.states, 1e-3)
    if not move_points:
        S, g = H[:nodes, :nodes], J[:, :nodes].T @ r
    seen = np.flatnonzero(np.diag(H)[:nodes] > 0.0)
    assert len(seen) == 6 * len(dense.states.T_G_I)
    assert_close(assembled(problem, linear)[np.ix_(seen, seen)], S[np.ix_(seen, seen)])
    assert_close(linear.gradient.reshape(-1), g)
    assert_close(linear.diagonal.reshape(-1), np.diag(H)[:nodes])
    assert linear.cost == pytest.approx(0.5 * r @ r, rel=1e-10)


def test_every_term_together() -> None:
    dense, J, r = everything().dense, everything().J, everything().r
    problem, damping = dense.problem(), 1e-3
    linear = problem.linearize(dense.states, damping)
    nodes = 15 * len(dense.states.T_G_I)
    S, g, H, _ = reduced(J, r, nodes, damping)
    assert_close(assembled(problem, linear), S)
    assert_close(linear.gradient.reshape(-1), g)
    assert_close(linear.diagonal.reshape(-1), np.diag(H)[:nodes])
    assert linear.cost == pytest.approx(0.5 * r @ r, rel=1e-10)


def test_derivatives_of_the_reference_are_those_by_differences() -> None:
    dense, J = everything().dense, everything().J
    size = np.abs(J).max(axis=1, keepdims=True)
    assert np.abs((dense.exact_jacobian(dense.states) - J) / size).max() <= 1e-6


def test_step_is_that_of_the_dense_damped_system() -> None:
    dense, J, r = everything().dense, everything().J, everything().r
    problem, damping = dense.problem(), 1e-2
    linear = problem.linearize(dense.states, damping)
    H = J.T @ J
    H += damping * np.diag(np.clip(np.diag(H), 1e-6, 1e32))
    wanted = -np.linalg.solve(H, J.T @ r)
    step = problem.solve(linear, damping)
    nodes = step.size
    moved = dense.states.moved(step, dense.states.p_G)
    assert dense.visual is not None
    p_G, _, promised = dense.visual.take_step(dense.states, step, moved, damping)
    for kind in range(NODES_PER_VERTEX):  # each kind has units of its own
        own = step.reshape(-1, NODES_PER_VERTEX, 3)[:, kind]
        assert_close(own, wanted[:nodes].reshape(-1, NODES_PER_VERTEX, 3)[:, kind])
    assert_close((p_G - dense.states.p_G).reshape(-1), wanted[nodes:])
    visual = slice(0, 2 * len(dense.observations))
    after = r[visual] + J[visual] @ wanted
    assert promised == pytest.approx(0.5 * (r[visual] @ r[visual] - after @ after), rel=1e-6)


def test_restricted_nodes_step_only_where_they_may() -> None:
    dense = everything().dense
    problem, damping = dense.problem(), 1e-3
    first = np.array([0])
    problem.fix(NODES_PER_VERTEX * first + POSITION)
    axis = np.array([0.6, 0.0, 0.8])
    problem.restrict(
        NODES_PER_VERTEX * first + ORIENTATION, (np.eye(3) - np.outer(axis, axis))[None]
    )
    linear = problem.linearize(dense.states, damping)
    step = problem.solve(linear, damping)
    assert np.all(step[POSITION] == 0.0)
    assert abs(step[ORIENTATION] @ axis) <= 1e-15
    nodes = step.size
    S, g, H, _ = reduced(everything().J, everything().r, nodes, damping)
    S += damping * np.diag(np.clip(np.diag(H)[:nodes], 1e-6, 1e32))
    basis = np.eye(nodes)
    basis[3:6, 3:6] = np.linalg.svd(axis[None])[2].T  # first column: the axis
    basis = basis[:, 4:]
    wanted = -basis @ np.linalg.solve(basis.T @ S @ basis, basis.T @ g)
    for kind in range(NODES_PER_VERTEX):
        own = step.reshape(-1, NODES_PER_VERTEX, 3)[:, kind]
        assert_close(own, wanted.reshape(-1, NODES_PER_VERTEX, 3)[:, kind])
    assert np.all(problem.projected_gradient(linear)[0] == 0.0)


@pytest.mark.parametrize("damping", [1e-8, 1.0, 1e8, 1e16, 1e24])
def test_however_heavy_the_damping_the_system_can_be_solved(damping: float) -> None:
    dense = everything().dense
    problem = dense.problem()
    first = np.array([0])
    problem.fix(NODES_PER_VERTEX * first + POSITION)
    axis = np.array([1.0, -2.0, 3.0]) / np.sqrt(14.0)
    problem.restrict(
        NODES_PER_VERTEX * first + ORIENTATION, (np.eye(3) - np.outer(axis, axis))[None]
    )
    step = problem.solve(problem.linearize(dense.states, damping), damping)
    assert np.isfinite(step).all()
    assert abs(step[ORIENTATION] @ axis) <= 1e-12


@pytest.mark.parametrize("loss", [loss for loss in Loss if loss is not Loss.NONE])
def test_robust_gradient_is_that_of_the_cost(loss: Loss) -> None:
    dense = dense_problem(small(), loss=loss, loss_scale=1.3, include_inertial=False)
    T_I_S = np.broadcast_to(se3.identity(), (1, 7))
    term = pose.AbsolutePoseTerm(
        residual_kernel("absolute_pose", absolute_pose),
        np.array([1]),
        T_I_S,
        se3.retract(dense.states.T_G_I[1:2], np.full(6, 0.02)),
        50.0 * np.eye(6)[None],
        loss=(loss, 1.3),
    )
    dense.factors.append(term)
    problem = Problem(dense.states, dense.visual, dense.factors)
    linear = problem.linearize(dense.states, 0.0)
    assert dense.visual is not None

    def cost(d: np.ndarray) -> float:
        states = dense.states.moved(d.reshape(-1, 5, 3), dense.states.p_G)
        assert dense.visual is not None
        seen = dense.visual.cost(states)
        return seen + factor_terms.cost(term, states)

    # with landmarks damped to a standstill the reduced gradient is that by the poses
    gradient = problem.linearize(dense.states, 1e20).gradient.reshape(-1)
    assert linear.cost == pytest.approx(cost(np.zeros_like(gradient)), rel=1e-12)
    rng = np.random.default_rng(0)
    size = np.abs(gradient)
    for _ in range(5):
        d = 1e-5 * rng.normal(size=len(gradient)) * (size > 0.0)
        slope = (8 * (cost(d) - cost(-d)) - cost(2 * d) + cost(-2 * d)) / 12.0
        assert gradient @ d == pytest.approx(slope, rel=1e-5, abs=1e-6 * size @ np.abs(d))


def test_terms_of_the_same_name_all_count() -> None:
    dense = everything().dense
    once = Problem(dense.states, None, dense.factors)
    twice = Problem(dense.states, None, [*dense.factors, *dense.factors])
    linear, doubled = (problem.linearize(dense.states, 0.0) for problem in (once, twice))
    assert doubled.cost == pytest.approx(2.0 * linear.cost, rel=1e-12)
    step = once.try_step(dense.states, linear, 1.0)
    assert twice.try_step(dense.states, doubled, 1.0).cost == pytest.approx(
        2.0 * step.cost, rel=1e-9
    )


def region(schedule: Schedule) -> TrustRegion:
    return TrustRegion(100.0, 1e-3, 1e4, schedule)


def test_the_schedule_of_ceres() -> None:
    it = region(Schedule.CERES)
    it.accept(1.0)
    assert it.radius == pytest.approx(300.0)  # 1 / max(1/3, 1 - 1)
    it.accept(0.5)
    assert it.radius == pytest.approx(300.0)  # 1 / (1 - 0)
    it.accept(0.25)
    assert it.radius == pytest.approx(300.0 / 1.125)
    before = it.radius
    for divisor in (2, 8, 64):  # 2, then 2 * 4, then 2 * 4 * 8
        it.reject()
        assert it.radius == pytest.approx(before / divisor)
    it.accept(0.5)
    it.reject()
    assert it.radius == pytest.approx(before / 128)  # begins again with 2


@pytest.mark.parametrize(
    ("gain", "factor"),
    [
        (0.5, 1.0),
        (0.97, 3.0),
        (0.99, 1.0 / (1.0 - 0.98**3)),
        (1.0, 100.0),
        (1.01, 1.0 / (1.0 - 0.98**3)),
        (1.5, 3.0),
    ],
)
def test_steps_as_good_as_promised_widen_most(gain: float, factor: float) -> None:
    it = region(Schedule.STEP_QUALITY)
    it.accept(gain)
    assert it.radius == pytest.approx(factor * 100.0, rel=1e-3)
    before = it.radius
    it.reject()
    assert it.radius == pytest.approx(before / 2.0)


@pytest.mark.parametrize("schedule", list(Schedule))
def test_the_radius_keeps_its_limits(schedule: Schedule) -> None:
    it = region(schedule)
    for _ in range(20):
        it.accept(1.0)
    assert it.radius == 1e4
    assert not it.is_exhausted
    while not it.is_exhausted:
        it.reject()
    assert it.radius < 1e-3


def test_descent_only() -> None:
    judge = StepJudge(10.0)
    assert judge.gain(9.0, 2.0) == pytest.approx(0.5)
    assert judge.gain(11.0, 2.0) == pytest.approx(-0.5)
    assert judge.gain(9.0, 0.0) == -1.0


def test_uphill_steps_count_from_the_reference() -> None:
    judge = StepJudge(10.0, max_uphill=2)
    assert judge.accept(4.0, 6.0)  # the least so far
    assert judge.gain(5.0, 1.0) == pytest.approx((10.0 - 5.0) / 7.0)
    assert not judge.accept(5.0, 1.0)
    assert judge.gain(6.0, 1.0) == pytest.approx((10.0 - 6.0) / 8.0)
    assert not judge.accept(6.0, 1.0)  # the second: the reference comes down to the highest, 6
    assert judge.gain(7.0, 1.0) < 0.0
    assert judge.gain(5.0, 1.0) == pytest.approx(1.0)


def test_a_changed_problem_begins_anew() -> None:
    judge = StepJudge(10.0, max_uphill=3)
    judge.accept(2.0, 8.0)
    judge.restart(50.0)
    assert judge.gain(60.0, 1.0) < 0.0
    assert judge.accept(49.0, 1.0)


def test_a_problem_known_better_shifts_all_costs() -> None:
    known, shifted = StepJudge(10.0, max_uphill=2), StepJudge(10.0, max_uphill=2)
    for judge in (known, shifted):
        judge.accept(4.0, 6.0)
        judge.accept(5.0, 1.0)
    shifted.shift(3.0)
    assert shifted.gain(9.0, 1.0) == pytest.approx(known.gain(6.0, 1.0))
    assert shifted.accept(6.5, 1.0)  # less than the least was, with the difference


def test_more_iterations_never_give_a_higher_cost() -> None:
    start = corrupted(
        Scene(vertices=4, landmarks=20, seen_share=0.8).make(),
        np.random.default_rng(7),
        position_m=0.2,
        quaternion=0.03,
        landmark_m=0.2,
        velocity_mps=0.5,
        gyro_bias=1e-3,
        accel_bias=0.02,
        keep=0,
    )
    dense = dense_problem(start)
    costs = []
    for iterations in range(1, 7):  # a step goes uphill
        problem = dense.problem()
        options = SolverOptions(num_iterations=iterations, max_uphill_steps=3)
        states, summary = optimize_states(problem, dense.states, options, SILENT)
        costs.append(sum(summary.final_costs.values()))
        assert sum(problem.linearize(states, 1e-9).costs.values()) == pytest.approx(
            costs[-1], rel=1e-9
        )
    # inertial edges are integrated anew at the states that are returned to: the cost is known better
    assert np.all(costs[1:] <= 1.05 * np.minimum.accumulate(costs)[:-1])
    assert costs[3] == pytest.approx(costs[2], rel=0.05)
    assert costs[-1] < 0.1 * costs[2]
