"""Marginals against the dense inverse, and costs against Ceres and GTSAM."""

import numpy as np
import pytest
from scipy.stats import chi2

from benchmarks import maplab_solver
from benchmarks.problems import make_inertial, make_visual
from benchmarks.solution import Solution, StoppingRule
from maplab_py.algorithms.vi_optimization.map_problem import build
from maplab_py.algorithms.vi_optimization.optimization import solver_options
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.array_types import F64
from maplab_py.errors import EstimationError
from maplab_py.estimation.problem.marginals import Marginals
from maplab_py.estimation.problem.problem import Problem
from maplab_py.estimation.problem.solver import optimize_states
from maplab_py.estimation.problem.trust_region import Schedule
from maplab_py.estimation.states import States, pose_nodes
from maplab_py.estimation.terms.cameras import EXTRINSICS, INTRINSICS
from maplab_py.geometry import se3, so3
from maplab_py.progress import SILENT
from tests.estimation.dense import system_matrix
from tests.support.scene import Scene

EXACT = VIOptimizationOptions(
    loss="none",
    use_visual_outlier_rejection_solver=False,
    gate_reprojection_error_px=1e9,
    function_tolerance=1e-10,
)
CALIBRATING = VIOptimizationOptions(
    loss="none",
    fix_ncamera_intrinsics=False,
    fix_ncamera_extrinsics_rotation=False,
    fix_ncamera_extrinsics_translation=False,
    function_tolerance=1e-10,
)


def test_blocks_are_those_of_the_dense_inverse() -> None:
    posed = build(Scene(vertices=5, landmarks=60, noise=1.0).make(), EXACT)
    linear = posed.problem.linearize(posed.states, 1e-12)
    H = system_matrix(posed.problem, linear, 0.0)
    marginals = Marginals(posed.problem, posed.states)
    P = np.zeros_like(H)
    for node, projector in enumerate(posed.problem.projectors):
        P[3 * node : 3 * node + 3, 3 * node : 3 * node + 3] = projector
    scale = np.sqrt(np.diag(H))
    wanted = P @ (np.linalg.pinv((P @ H @ P) / np.outer(scale, scale)) / np.outer(scale, scale)) @ P
    nodes = pose_nodes(np.array([3, 1])).reshape(-1)
    rows = (3 * nodes[:, None] + np.arange(3)).reshape(-1)
    found = marginals.nodes(nodes)
    np.testing.assert_allclose(found, wanted[np.ix_(rows, rows)], atol=1e-5 * found.max())


def test_what_is_held_is_certain() -> None:
    posed = build(Scene(vertices=5, landmarks=60, noise=1.0).make(), EXACT)
    covariance = Marginals(posed.problem, posed.states).nodes(pose_nodes(np.array([0])))
    assert np.abs(covariance[:3]).max() == 0.0
    up_I = so3.rotate(so3.inverse(posed.states.T_G_I[0, :4]), np.array([0.0, 0.0, 1.0]))
    assert abs(up_I @ covariance[3:, 3:] @ up_I) < 1e-15
    assert covariance[3:, 3:].max() > 0.0


def relative_covariance(problem: Problem, states: States, first: int, second: int) -> F64:
    """Return the covariance (6, 6) of T_A_B: position in A, rotation in B."""
    joint = Marginals(problem, states).nodes(pose_nodes(np.array([first, second])))
    T_A_B = se3.relative(states.T_G_I[first], states.T_G_I[second])
    R_A_G = so3.to_matrix(states.T_G_I[first, :4]).T
    J = np.zeros((6, 12))
    J[:3, :3], J[:3, 6:9] = -R_A_G, R_A_G
    J[:3, 3:6] = so3.skew(T_A_B[4:])
    J[3:, 3:6], J[3:, 9:] = -so3.to_matrix(T_A_B[:4]).T, np.eye(3)
    return np.asarray(J @ joint @ J.T)


def test_relative_poses_do_not_depend_on_the_gauge() -> None:
    posed = build(Scene(vertices=6, landmarks=80, noise=1.0).make(), EXACT)
    first = relative_covariance(posed.problem, posed.states, 2, 4)
    other = Problem(posed.states, posed.problem.visual, posed.problem.factors)
    other.fix(pose_nodes(np.array([5]))[:, 0])
    up_I = so3.rotate(so3.inverse(posed.states.T_G_I[5, :4]), np.array([0.0, 0.0, 1.0]))
    other.restrict(pose_nodes(np.array([5]))[:, 1], (np.eye(3) - np.outer(up_I, up_I))[None])
    second = relative_covariance(other, posed.states, 2, 4)
    np.testing.assert_allclose(first, second, atol=1e-5 * np.abs(first).max())


def test_undetermined_states_are_named() -> None:
    posed = build(Scene(vertices=4, landmarks=40).make(), EXACT)
    free = Problem(posed.states, posed.problem.visual, ())
    with pytest.raises(EstimationError, match=r"do not determine the \w+( bias)? of vertex \d"):
        Marginals(free, posed.states)


@pytest.mark.slow
def test_errors_of_poses_are_as_large_as_announced() -> None:
    """NEES of a free pose over 50 runs lies within the 95 % band of chi-square."""
    total = freedom = 0.0
    for seed in range(50):
        scene = Scene(vertices=8, interval_s=0.25, landmarks=120, noise=1.0, seed=100 + seed)
        truth = scene.make()
        posed = build(truth, EXACT)
        final, _ = optimize_states(posed.problem, posed.states, solver_options(EXACT), SILENT)
        true = se3.relative(truth.T_G_I[0], truth.T_G_I[7])
        found = se3.relative(final.T_G_I[0], final.T_G_I[7])
        turned = so3.log(so3.multiply(so3.inverse(true[:4]), found[:4]))
        error = np.concatenate([found[4:] - true[4:], turned])
        covariance = relative_covariance(posed.problem, final, 0, 7)
        # errors of neighbours are correlated: one pose a run
        total += float(error @ np.linalg.solve(covariance, error))
        freedom += 6
    low, high = chi2.ppf([0.025, 0.975], freedom)
    assert low <= total <= high, total / freedom


@pytest.mark.slow
def test_errors_of_calibrations_are_as_large_as_announced() -> None:
    total = freedom = 0.0
    for seed in range(20):
        scene = Scene(vertices=12, interval_s=0.25, landmarks=200, noise=1.0, seed=300 + seed)
        posed = build(scene.make(), CALIBRATING)
        final, _ = optimize_states(posed.problem, posed.states, solver_options(CALIBRATING), SILENT)
        marginals = Marginals(posed.problem, final)
        for name in (INTRINSICS, EXTRINSICS):
            error = final.blocks[name].difference(posed.states.blocks[name].values).reshape(-1)
            total += float(error @ np.linalg.solve(marginals.block(name), error))
            freedom += len(error)
    low, high = chi2.ppf([0.025, 0.975], freedom)
    assert low <= total <= high, total / freedom


TIGHT = StoppingRule(function_tolerance=1e-12)
NO_PEER = "the extra [bench] is not installed"


def relative(a: float, b: float) -> float:
    return abs(a - b) / b


def pose_errors(one: Solution, two: Solution) -> tuple[float, float]:
    """Return the largest difference of positions [m] and of orientations [rad]."""
    difference = se3.local(one.T_G_I, two.T_G_I)
    return tuple(np.linalg.norm(part, axis=1).max() for part in np.split(difference, 2, axis=1))


def test_visual_optimum_is_that_of_ceres() -> None:
    pytest.importorskip("pycolmap", "4.2", reason=NO_PEER)
    from benchmarks import ceres_solver

    problem = make_visual("tiny")
    ours, _ = maplab_solver.solve_visual(problem, TIGHT)
    theirs, _ = ceres_solver.solve_visual(problem, TIGHT)
    assert relative(ours.cost, theirs.cost) <= 1e-10
    assert relative(maplab_solver.cost_of(problem, theirs), theirs.cost) <= 1e-10
    position_m, orientation_rad = pose_errors(ours, theirs)
    assert position_m <= 1e-5
    assert orientation_rad <= 1e-6
    assert np.linalg.norm(ours.p_G - theirs.p_G, axis=1).max() <= 1e-4


def test_inertial_optimum_is_that_of_gtsam() -> None:
    pytest.importorskip("gtsam", reason=NO_PEER)
    from benchmarks import gtsam_solver

    problem = make_inertial("tiny")
    ours, _ = maplab_solver.solve_inertial(problem, TIGHT)
    theirs, _ = gtsam_solver.solve_inertial(problem, TIGHT)
    assert relative(ours.cost, theirs.cost) <= 1e-6
    assert relative(maplab_solver.cost_of(problem, theirs), ours.cost) <= 1e-6
    assert relative(gtsam_solver.cost_of(problem, ours), theirs.cost) <= 1e-6
    position_m, orientation_rad = pose_errors(ours, theirs)
    assert position_m <= 1e-4
    assert orientation_rad <= 1e-5
    assert np.linalg.norm(ours.v_G - theirs.v_G, axis=1).max() <= 1e-4
    assert np.abs(ours.gyro_bias - theirs.gyro_bias).max() <= 1e-6
    assert np.abs(ours.accel_bias - theirs.accel_bias).max() <= 1e-4


def test_ceres_schedule_goes_the_way_of_ceres() -> None:
    """With the same schedule and damping the costs of each iteration are the same, too.

    Not to the last digit: Ceres scales by other tangents (camera from world), which damps otherwise.
    """
    pytest.importorskip("pycolmap", "4.2", reason=NO_PEER)
    from benchmarks import ceres_solver

    problem = make_visual("tiny")
    for iterations in (1, 2, 3):
        rule = StoppingRule(0.0, iterations, 1e-4, schedule=Schedule.CERES)
        ours, _ = maplab_solver.solve_visual(problem, rule)
        theirs, _ = ceres_solver.solve_visual(problem, rule)
        assert relative(ours.cost, theirs.cost) <= 1e-4
