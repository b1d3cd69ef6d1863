"""Conjugate gradients over the whole problem, and their preconditioner."""

import dataclasses

import numba
import numpy as np
import pytest
from scipy.linalg import cho_factor, cho_solve

from maplab_py.array_types import F64, I64
from maplab_py.errors import EstimationError
from maplab_py.estimation.codegen.kernels import residual_kernel, visual_kernels
from maplab_py.estimation.loss import Loss
from maplab_py.estimation.problem.iterative import (
    IterativeOptions,
    IterativeProblem,
    ReducedOperator,
)
from maplab_py.estimation.problem.marginals import Marginals
from maplab_py.estimation.problem.problem import Problem
from maplab_py.estimation.problem.solver import SolverOptions, optimize_states
from maplab_py.estimation.states import NODES_PER_VERTEX, POSITION, States, pose_nodes
from maplab_py.estimation.symbolic.sources import relative_pose
from maplab_py.estimation.terms import pose, protocol
from maplab_py.estimation.terms.cameras import Cameras, camera_blocks
from maplab_py.estimation.terms.visual import Observations, VisualTerms
from maplab_py.geometry import se3
from maplab_py.memory import NotEnoughMemory
from maplab_py.progress import SILENT
from maplab_py.sensors import Distortion, Projection
from tests.estimation.dense import system_matrix
from tests.support.dense import DenseProblem, dense_problem
from tests.support.scene import Scene, corrupted

VERTICES = 40
SMALL_DAMPING = 1e-6


def poses(seed: int = 0) -> States:
    rng = np.random.default_rng(seed)
    T_G_I = se3.exp(rng.normal(size=(VERTICES, 6)) * [2.0, 2.0, 2.0, 0.5, 0.5, 0.5])
    zero = np.zeros((VERTICES, 3))
    return States(T_G_I, zero, zero, zero, np.zeros((0, 3)))


def edges(states: States, name: str, pairs: I64) -> pose.RelativePoseTerm:
    """Return measured relative poses that differ from those of the states."""
    first, second = pairs.T
    rng = np.random.default_rng(1)
    T = states.T_G_I
    measured = se3.retract(
        se3.relative(T[first], T[second]), 0.1 * rng.normal(size=(len(pairs), 6))
    )
    return pose.RelativePoseTerm(
        residual_kernel("relative_pose", relative_pose), name, first, second,
        se3.identity(len(pairs)), measured, pose.whitening(np.tile(1e-2 * np.eye(6), (len(pairs), 1, 1))),
    )  # fmt: skip


def iterations(pairs: I64, *loops: I64) -> int:
    """Return the iterations of one exact step, checked against the factorisation."""
    states = poses()
    terms = [edges(states, "odometry", pairs), *(edges(states, "loop", loop) for loop in loops)]
    options = IterativeOptions(forcing=1e-9)
    iterative = IterativeProblem(states, None, terms, options=options)
    direct = Problem(states, None, terms)
    unused = np.arange(direct.num_nodes)
    steps = []
    for problem in (iterative, direct):
        problem.fix(unused[unused % NODES_PER_VERTEX >= 2])
        problem.fix(np.array([0, 1]))
        steps.append(problem.solve(problem.linearize(states, SMALL_DAMPING), SMALL_DAMPING))
    np.testing.assert_allclose(steps[0], steps[1], atol=1e-5 * np.abs(steps[1]).max())
    return iterative.linear_iterations


def chain(order: I64) -> I64:
    return np.stack([order[:-1], order[1:]], axis=1)


@pytest.mark.parametrize("seed", range(3))
def test_chains_are_exact_whatever_the_order_of_their_rows(seed: int) -> None:
    order = np.random.default_rng(seed).permutation(VERTICES)
    assert iterations(chain(order)) == 1


def test_an_edge_that_joins_two_sessions_is_exact() -> None:
    first, second = np.split(np.arange(VERTICES), 2)
    sessions = np.concatenate([chain(first), chain(second)])
    assert iterations(sessions, np.array([[3, VERTICES - 4]])) == 1


def test_edges_between_near_rows_are_exact() -> None:
    rows = np.arange(VERTICES)
    skipping = np.stack([rows[:-8], rows[8:]], axis=1)
    assert iterations(np.concatenate([chain(rows), skipping])) == 1


def test_loops_are_left_to_the_iterations() -> None:
    loops = np.array([[0, 30], [35, 5], [10, 25]])
    assert 1 < iterations(chain(np.arange(VERTICES)), loops) < 60


EXACT = IterativeOptions(forcing=1e-11, max_iterations=2000)
DAMPING = 1e-4
STEREO = ((Projection.PINHOLE, Distortion.RADTAN), (Projection.PINHOLE, Distortion.NONE))


def problem_of(seed: int = 1, **options: object) -> DenseProblem:
    """Return a disturbed scene; `move_points` and `loss` go to the problem, the rest to the scene."""
    inner = {k: options.pop(k) for k in ("move_points", "loss", "include_inertial") if k in options}
    scene = Scene(**{"vertices": 9, "landmarks": 60, "seed": seed, "noise": 1.0, **options})  # type: ignore[arg-type]
    disturbed = corrupted(
        scene.make(), np.random.default_rng(seed), position_m=0.02, quaternion=0.003,
        landmark_m=0.02, velocity_mps=0.05, gyro_bias=1e-3, accel_bias=0.02, keep=0,
    )  # fmt: skip
    return dense_problem(disturbed, **inner)  # type: ignore[arg-type]


def loop_edges(dense: DenseProblem) -> protocol.FactorTerm:
    """Return edges between vertices far apart, against their rows' order too."""
    T = dense.states.T_G_I
    first, second = np.array([0, len(T) - 1, 3]), np.array([len(T) - 2, 1, 4])
    off = se3.exp(0.01 * np.arange(1.0, 7.0))
    return pose.RelativePoseTerm(
        residual_kernel("relative_pose", relative_pose), "loop closure", first, second,
        se3.identity(3), se3.compose(se3.relative(T[first], T[second]), off),
        pose.whitening(np.tile(np.eye(6) * 1e-4, (3, 1, 1))), loss=(Loss.CAUCHY, 1.0),
    )  # fmt: skip


def both(
    dense: DenseProblem, options: IterativeOptions = EXACT
) -> tuple[Problem, IterativeProblem]:
    iterative = IterativeProblem(dense.states, dense.visual, dense.factors, None, options)
    direct = dense.problem()
    for problem in (direct, iterative):
        problem.relinearize(dense.states)
    return direct, iterative


def operator(problem: IterativeProblem, linear: ReducedOperator, damping: float) -> F64:
    """Return the damped, projected matrix, column by column."""
    added = damping * np.clip(linear.diagonal, 1e-6, 1e32)
    problem.solve(linear, damping)  # takes up what is restricted
    unit = np.eye(3 * problem.num_nodes)
    columns = [
        problem._multiply(linear, added, problem._projected(c.reshape(-1, 3).copy())) for c in unit
    ]
    return np.stack([column.reshape(-1) for column in columns], axis=1)


def with_prior(dense: DenseProblem) -> DenseProblem:
    """Return the problem with priors of landmarks, and observations that do not take part."""
    assert dense.visual is not None
    data = dense.observations
    is_used = np.random.default_rng(0).random(len(data)) < 0.8
    is_used[data.start[0] + 1 : data.start[1]] = False  # one observation is left
    prior = np.concatenate([dense.states.p_G + 0.01, np.full((len(dense.states.p_G), 1), 20.0)], 1)
    visual = VisualTerms(
        dense.visual._kernels, data.switched(is_used, 1.0), dense.visual._cameras,
        len(dense.states.T_G_I), loss=Loss.CAUCHY, landmark_prior=prior,
    )  # fmt: skip
    return dataclasses.replace(dense, visual=visual)


VARIANTS = {
    "one camera": problem_of,
    "rig": lambda: problem_of(models=STEREO),
    "three sessions": lambda: problem_of(missions=3, vertices=5),
    "robust loss": lambda: problem_of(loss=Loss.CAUCHY),
    "fixed landmarks": lambda: problem_of(move_points=False, models=STEREO),
    "images alone": lambda: problem_of(include_inertial=False),
    "priors and unused observations": lambda: with_prior(problem_of()),
}


def with_loops(name: str) -> DenseProblem:
    dense = VARIANTS[name]()
    dense.factors.append(loop_edges(dense))
    return dense


def free_directions(problem: Problem) -> F64:
    """Return a basis (3 nodes, free) of the directions that may move."""
    columns = []
    for node, projector in enumerate(problem.projectors):
        values, vectors = np.linalg.eigh(projector)
        for vector in vectors.T[values > 0.5]:
            column = np.zeros((problem.num_nodes, 3))
            column[node] = vector
            columns.append(column.reshape(-1))
    return np.stack(columns, axis=1)


def restrict(problem: Problem) -> None:
    """Fix one position, one orientation to a plane, and the velocity of another vertex."""
    problem.fix(np.array([POSITION]))
    problem.restrict(np.array([1]), (np.eye(3) - np.full((3, 3), 1.0 / 3.0))[None])
    problem.fix(np.array([NODES_PER_VERTEX * 2 + 2]))


@pytest.mark.parametrize("name", VARIANTS)
def test_products_are_those_of_the_formed_system(name: str) -> None:
    direct, iterative = both(with_loops(name))
    states = with_loops(name).states
    formed, kept = (p.linearize(states, DAMPING) for p in (direct, iterative))
    assert isinstance(kept, ReducedOperator)
    assert kept.costs.keys() == formed.costs.keys()
    assert kept.cost == pytest.approx(formed.cost, rel=1e-12)
    scale = np.sqrt(formed.diagonal.reshape(-1)) + 1e-3
    error = (kept.gradient - formed.gradient).reshape(-1) / scale
    assert np.abs(error).max() <= 1e-6 * np.abs(formed.gradient.reshape(-1) / scale).max()
    np.testing.assert_allclose(kept.diagonal, formed.diagonal, rtol=1e-6, atol=1e-9)
    matrix = system_matrix(direct, formed, DAMPING)
    difference = operator(iterative, kept, DAMPING) - matrix
    assert np.abs(difference / np.outer(scale, scale)).max() <= 2e-6


@pytest.mark.parametrize("name", VARIANTS)
def test_blocks_of_the_preconditioner_are_those_of_the_products(name: str) -> None:
    dense = VARIANTS[name]()
    dense.factors.clear()
    _, iterative = both(dense)
    linear = iterative.linearize(dense.states, DAMPING)
    assert isinstance(linear, ReducedOperator)
    matrix = operator(iterative, linear, 0.1)
    added = 0.1 * np.clip(linear.diagonal, 1e-6, 1e32).reshape(-1)
    np.fill_diagonal(matrix, np.diag(matrix) - added)
    for vertex, block in enumerate(linear.pose_blocks):
        rows = slice(15 * vertex, 15 * vertex + 6)
        np.testing.assert_allclose(block, matrix[rows, rows], atol=1e-9 * np.abs(block).max())
        assert np.linalg.eigvalsh(block).min() >= -1e-10 * np.abs(block).max()


@pytest.mark.parametrize("name", VARIANTS)
@pytest.mark.parametrize("is_restricted", [False, True])
def test_steps_are_those_of_the_factorisation(name: str, is_restricted: bool) -> None:
    dense = with_loops(name)
    direct, iterative = both(dense)
    if is_restricted:
        restrict(direct)
        restrict(iterative)
    if name == "images alone":  # nothing says how fast the body moves
        every = np.arange(direct.num_nodes)
        for problem in (direct, iterative):
            problem.fix(every[every % NODES_PER_VERTEX >= 2])
    steps = [p.try_step(dense.states, p.linearize(dense.states, DAMPING), DAMPING)
             for p in (direct, iterative)]  # fmt: skip
    assert steps[1].cost == pytest.approx(steps[0].cost, rel=1e-6)
    assert steps[1].promised == pytest.approx(steps[0].promised, rel=1e-6)
    assert steps[1].norm == pytest.approx(steps[0].norm, rel=1e-4)
    if is_restricted:
        np.testing.assert_array_equal(steps[1].states.T_G_I[0, 4:], dense.states.T_G_I[0, 4:])
        np.testing.assert_array_equal(steps[1].states.v_G[2], dense.states.v_G[2])


@pytest.mark.parametrize("seed", range(30))
def test_thirty_problems_against_the_cholesky_factor_of_the_same_matrix(seed: int) -> None:
    """A third has no inertial terms, no fixed state and is rank-deficient up to its damping."""
    rng = np.random.default_rng(seed)
    is_deficient = seed % 3 == 0
    dense = problem_of(
        seed + 1, vertices=int(rng.integers(3, 8)), missions=int(rng.integers(1, 3)),
        landmarks=int(rng.integers(15, 50)), seen_share=float(rng.uniform(0.4, 1.0)),
        include_inertial=not is_deficient, models=STEREO[: 1 + seed % 2],
    )  # fmt: skip
    _, iterative = both(dense)
    if not is_deficient:
        restrict(iterative)
    linear = iterative.linearize(dense.states, DAMPING)
    assert isinstance(linear, ReducedOperator)
    A = operator(iterative, linear, DAMPING)
    b = -iterative.projected_gradient(linear).reshape(-1)
    free = free_directions(iterative)
    scale = np.sqrt(np.diag(free.T @ A @ free))
    basis = free / scale
    wanted = basis @ cho_solve(cho_factor(basis.T @ A @ basis), basis.T @ b)
    step = iterative.solve(linear, DAMPING).reshape(-1)
    energy = [float(0.5 * x @ A @ x - b @ x) for x in (step, wanted)]
    assert energy[0] == pytest.approx(energy[1], rel=1e-8)
    assert energy[0] < 0.0


def test_the_step_that_ends_a_run_is_solved_again_more_exactly() -> None:
    dense = problem_of(missions=2)
    _, iterative = both(dense, IterativeOptions())
    iterative.fix(np.array([0, 1]))
    _, summary = optimize_states(
        iterative, dense.states, SolverOptions(function_tolerance=1e-3), SILENT
    )
    assert summary.termination == "cost has converged"
    assert len(iterative.iterations) == summary.iterations + 1
    first = iterative.try_step(dense.states, iterative.linearize(dense.states, DAMPING), DAMPING)
    assert first.refine is not None
    again = first.refine()
    assert again.refine is None
    assert again.promised > first.promised


def test_results_do_not_depend_on_the_number_of_threads() -> None:
    steps = []
    for threads in (1, min(2, numba.config.NUMBA_NUM_THREADS)):
        numba.set_num_threads(threads)
        try:
            dense = problem_of(models=STEREO, missions=2)
            _, iterative = both(dense)
            linear = iterative.linearize(dense.states, DAMPING)
            steps.append(iterative.solve(linear, DAMPING).tobytes())
        finally:
            numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)
    assert steps[0] == steps[1]


def test_the_direct_solver_takes_over_when_iterations_exceed_the_budget() -> None:
    dense, lines = problem_of(missions=2), []
    problem = IterativeProblem(
        dense.states, dense.visual, dense.factors, None,
        IterativeOptions(budget=0, max_overruns=2), lines.append,
    )  # fmt: skip
    problem.fix(np.array([0, 1]))
    options = SolverOptions(num_iterations=30, function_tolerance=1e-10)
    final, summary = optimize_states(problem, dense.states, options, SILENT)
    assert problem.linear_solver == "pcg, then multifrontal"
    assert len(problem.iterations) == 2
    assert lines == ["conjugate gradients take too many iterations: the direct solver takes over"]
    direct = dense.problem()
    direct.fix(np.array([0, 1]))
    _, wanted = optimize_states(direct, dense.states, options, SILENT)
    assert sum(summary.final_costs.values()) == pytest.approx(
        sum(wanted.final_costs.values()), rel=1e-8
    )
    np.testing.assert_array_equal(final.T_G_I[0], dense.states.T_G_I[0])


def refuse() -> Problem:
    raise NotEnoughMemory("the factor")


def test_truncated_steps_go_on_where_the_direct_solver_does_not_fit() -> None:
    dense, lines = problem_of(missions=2), []
    problem = IterativeProblem(
        dense.states, dense.visual, dense.factors, refuse,
        IterativeOptions(budget=0, max_overruns=1), lines.append,
    )  # fmt: skip
    problem.fix(np.array([0, 1]))
    _, summary = optimize_states(problem, dense.states, SolverOptions(), SILENT)
    assert problem.linear_solver == "pcg"
    assert lines == [
        "conjugate gradients take too many iterations: the factorisation does not fit, steps stay "
        "truncated"
    ]
    assert sum(summary.final_costs.values()) < sum(summary.initial_costs.values())


def test_covariances_by_columns_are_those_of_the_factor() -> None:
    dense = problem_of(missions=2, vertices=6, landmarks=120)
    direct = dense.problem()
    fits = IterativeProblem(dense.states, dense.visual, dense.factors)
    too_large = IterativeProblem(dense.states, dense.visual, dense.factors, refuse)
    covariances = []
    for problem in (direct, fits, too_large):
        restrict(problem)
        covariances.append(Marginals(problem, dense.states).nodes(pose_nodes(np.array([4, 1]))))
    np.testing.assert_array_equal(covariances[1], covariances[0])
    size = np.sqrt(np.diag(covariances[0]))
    assert np.abs((covariances[2] - covariances[0]) / np.outer(size, size)).max() < 1e-3


def test_covariances_that_do_not_converge_are_an_error() -> None:
    dense = problem_of()
    problem = IterativeProblem(
        dense.states, dense.visual, dense.factors, refuse,
        IterativeOptions(covariance_iterations=2),
    )  # fmt: skip
    restrict(problem)
    with pytest.raises(EstimationError, match="conjugate gradients do not converge for node 5"):
        Marginals(problem, dense.states).nodes([5])


def test_estimated_cameras_are_refused() -> None:
    one = np.zeros(1, dtype=np.int32)
    observations = Observations(
        np.array([0, 1]), one, one, np.zeros((1, 2)), np.ones(1), np.ones(1)
    )
    cameras = Cameras(se3.identity(1), np.array([[0.0, 100.0, 100.0, 50.0, 50.0]]))
    states = problem_of().states.with_blocks(*camera_blocks(cameras, np.zeros(1)))
    visual = VisualTerms(
        visual_kernels(), observations, cameras, len(states.T_G_I), estimate_cameras=True
    )
    with pytest.raises(ValueError, match="cameras that are estimated"):
        IterativeProblem(states, visual, [])
