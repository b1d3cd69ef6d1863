"""This project's optimiser on the benchmark problems."""

import numpy as np

from benchmarks.problems import (
    CENTRE_PX,
    F64,
    FOCAL_PX,
    GRAVITY_MPS2,
    I64,
    NUM_KNOWN_POSES,
    InertialProblem,
    VisualProblem,
)
from benchmarks.solution import Effort, Solution, StoppingRule, effort
from maplab_py.estimation.codegen.kernels import residual_kernel, visual_kernels
from maplab_py.estimation.imu import inertial_data
from maplab_py.estimation.loss import Loss
from maplab_py.estimation.problem import gauge, iterative
from maplab_py.estimation.problem.problem import Problem
from maplab_py.estimation.problem.solver import SolverOptions, optimize_states
from maplab_py.estimation.states import States
from maplab_py.estimation.symbolic.sources import inertial
from maplab_py.estimation.terms.cameras import Cameras
from maplab_py.estimation.terms.inertial import BiasWalkTerm, InertialTerm
from maplab_py.estimation.terms.protocol import FactorTerm
from maplab_py.estimation.terms.visual import Observations, VisualTerms
from maplab_py.geometry import se3
from maplab_py.progress import SILENT
from maplab_py.sensors import Imu


def solve_visual(problem: VisualProblem, rule: StoppingRule) -> tuple[Solution, Effort]:
    """Minimise the reprojection errors; the analysis of the structure counts as effort."""
    observed = _observations(problem)
    states = _initial_states(problem)
    with effort() as spent:
        solution = _solve(states, _visual_terms(problem, observed), [], rule)
    return solution, spent


def solve_inertial(problem: InertialProblem, rule: StoppingRule) -> tuple[Solution, Effort]:
    """Minimise reprojection and inertial errors; preintegration counts as effort."""
    observed, data = _observations(problem.visual), _inertial_data(problem)
    states = _initial_states(problem.visual, problem)
    with effort() as spent:
        factors = _inertial_terms(data, problem.first_keyframe)
        solution = _solve(states, _visual_terms(problem.visual, observed), factors, rule)
    return solution, spent


def inertial_parts(problem: InertialProblem) -> tuple[States, VisualTerms, list[FactorTerm]]:
    """Return initial states and terms of a problem."""
    visual = _visual_terms(problem.visual, _observations(problem.visual))
    factors = _inertial_terms(_inertial_data(problem), problem.first_keyframe)
    return _initial_states(problem.visual, problem), visual, factors


def cost_of(problem: VisualProblem | InertialProblem, solution: Solution) -> float:
    """Return this project's cost of states that any solver found."""
    visual = problem.visual if isinstance(problem, InertialProblem) else problem
    factors: list[FactorTerm] = []
    count = len(visual.T_G_I)
    nothing = np.zeros((count, 3))
    v_G, gyro_bias, accel_bias = nothing, nothing, nothing
    if isinstance(problem, InertialProblem):
        factors = _inertial_terms(_inertial_data(problem), problem.first_keyframe)
        assert solution.v_G is not None
        assert solution.gyro_bias is not None
        assert solution.accel_bias is not None
        v_G, gyro_bias, accel_bias = solution.v_G, solution.gyro_bias, solution.accel_bias
    states = States(solution.T_G_I, v_G, gyro_bias, accel_bias, solution.p_G)
    terms = _visual_terms(visual, _observations(visual))
    return Problem(states, terms, factors).linearize(states, 1.0).cost


def _solve(
    states: States, visual: VisualTerms, factors: list[FactorTerm], rule: StoppingRule
) -> Solution:
    if rule.forcing:
        forcing = iterative.IterativeOptions(forcing=rule.forcing)
        problem: Problem = iterative.IterativeProblem(states, visual, factors, None, forcing)
    else:
        problem = Problem(states, visual, factors)
    gauge.fix_pose(problem, np.arange(NUM_KNOWN_POSES))
    if not factors:
        every = np.arange(problem.num_nodes)
        problem.fix(every[every % 5 >= 2])  # velocities and biases
    options = SolverOptions(
        num_iterations=rule.max_iterations,
        function_tolerance=rule.function_tolerance,
        initial_radius=1.0 / rule.initial_damping,
        schedule=rule.schedule,
        gradient_tolerance=0.0,
        parameter_tolerance=0.0,
    )
    final, summary = optimize_states(problem, states, options, SILENT)
    return Solution(
        final.T_G_I, final.p_G, sum(summary.final_costs.values()), summary.iterations,
        final.v_G, final.gyro_bias, final.accel_bias,
    )  # fmt: skip


def _observations(problem: VisualProblem) -> Observations:
    count = len(problem.keyframe)
    return Observations(
        start=problem.start.astype(np.int64),
        vertex=problem.keyframe.astype(np.int32),
        camera=np.zeros(count, dtype=np.int32),
        uv_px=problem.uv_px,
        inverse_sigma=np.ones(count),
        loss_scale=np.ones(count),
    )


def _visual_terms(problem: VisualProblem, observed: Observations) -> VisualTerms:
    kernels = visual_kernels()
    parameters = np.array([[0.0, FOCAL_PX, FOCAL_PX, *CENTRE_PX]])
    cameras = Cameras(se3.identity(1), parameters)
    return VisualTerms(kernels, observed, cameras, len(problem.T_G_I), loss=Loss.NONE)


def _inertial_data(problem: InertialProblem) -> inertial_data.InertialData:
    edges, samples = problem.timestamp_ns.shape
    noise = problem.noise
    imu = Imu(
        id="0" * 32,
        gyro_noise_density=noise.gyro,
        gyro_bias_random_walk_noise_density=noise.gyro_walk,
        acc_noise_density=noise.accel,
        acc_bias_random_walk_noise_density=noise.accel_walk,
    )
    return inertial_data.InertialData(
        sample_start=np.arange(edges + 1) * samples,
        timestamp_ns=problem.timestamp_ns.reshape(-1),
        accel_gyro=problem.accel_gyro.reshape(-1, 6),
        imus=(imu,),
        imu_of_edge=np.zeros(edges, dtype=np.int64),
    )


def _inertial_terms(data: inertial_data.InertialData, first: I64) -> list[FactorTerm]:
    kernel = residual_kernel("inertial", inertial)
    gravity = np.tile([0.0, 0.0, -GRAVITY_MPS2], (len(data), 1))
    walk = data.walk_variance_density[data.imu_of_edge] * data.duration_s[:, None]
    return [
        InertialTerm(kernel, data, first, first + 1, gravity),
        BiasWalkTerm(first, first + 1, walk[:, 0], walk[:, 1]),
    ]


def _initial_states(visual: VisualProblem, problem: InertialProblem | None = None) -> States:
    count = len(visual.T_G_I)
    v_G, gyro_bias, accel_bias = (np.zeros((count, 3)) for _ in range(3))
    if problem is not None:
        v_G = problem.initial_v_G
        gyro_bias = _repeated(problem.initial_gyro_bias, count)
        accel_bias = _repeated(problem.initial_accel_bias, count)
    return States(visual.initial_T_G_I, v_G, gyro_bias, accel_bias, visual.initial_p_G)


def _repeated(vector: F64, count: int) -> F64:
    return np.tile(vector, (count, 1))
