"""GTSAM's Levenberg-Marquardt on the visual-inertial benchmark problems."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks import problems
from benchmarks.solution import Effort, Solution, StoppingRule, effort

_KNOWN_POSE_SIGMA = 1e-6
"""GTSAM's priors on the known poses: so tight that they add nothing to the cost [m, rad]."""


def solve_inertial(
    problem: problems.InertialProblem, rule: StoppingRule
) -> tuple[Solution, Effort]:
    """Minimise reprojection and inertial errors.

    Preintegration and filling the factor graph do not count as effort: through Python they take
    longer than the solution.
    """
    import gtsam

    graph, values = _graph(problem), _initial_values(problem)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setlambdaInitial(rule.initial_damping)
    iterations = 0
    with effort() as spent:
        optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
        before = optimizer.error()
        while iterations < rule.max_iterations:
            optimizer.iterate()
            iterations += 1
            cost = optimizer.error()
            if before - cost <= rule.function_tolerance * before:
                break
            before = cost
    return _solution(optimizer.values(), problem, optimizer.error(), iterations), spent


def cost_of(problem: problems.InertialProblem, solution: Solution) -> float:
    """Return GTSAM's cost of states that any solver found."""
    return float(_graph(problem).error(_values(solution)))


def _graph(problem: problems.InertialProblem) -> Any:
    import gtsam
    from gtsam.symbol_shorthand import B, L, V, X

    graph, visual, noise = gtsam.NonlinearFactorGraph(), problem.visual, problem.noise
    calibration = gtsam.Cal3_S2(problems.FOCAL_PX, problems.FOCAL_PX, 0.0, *problems.CENTRE_PX)
    pixel = gtsam.noiseModel.Isotropic.Sigma(2, 1.0)
    observed = zip(visual.uv_px, visual.keyframe.tolist(), visual.landmark.tolist(), strict=True)
    for uv, k, landmark in observed:
        graph.add(gtsam.GenericProjectionFactorCal3_S2(uv, pixel, X(k), L(landmark), calibration))
    known = gtsam.noiseModel.Isotropic.Sigma(6, _KNOWN_POSE_SIGMA)
    for k in range(problems.NUM_KNOWN_POSES):
        graph.add(gtsam.PriorFactorPose3(X(k), _pose(visual.initial_T_G_I[k]), known))
    duration_s = (problem.timestamp_ns[:, -1] - problem.timestamp_ns[:, 0]) * 1e-9
    for k, measured in enumerate(_preintegrated(problem)):
        graph.add(gtsam.ImuFactor(X(k), V(k), X(k + 1), V(k + 1), B(k), measured))
        densities = np.repeat([noise.accel_walk, noise.gyro_walk], 3)
        walk = gtsam.noiseModel.Diagonal.Sigmas(densities * np.sqrt(duration_s[k]))
        nothing = gtsam.imuBias.ConstantBias()
        graph.add(gtsam.BetweenFactorConstantBias(B(k), B(k + 1), nothing, walk))
    return graph


def _preintegrated(problem: problems.InertialProblem) -> Iterator[Any]:
    """Preintegrate with the mean angular velocity and force of each interval.

    GTSAM takes values that are constant during an interval. It is given those that change the
    velocity as both ends do: with turn E between them, (f_0 + E f_1) / 2 in the frame of the first.
    The position then lacks (f_0 - E f_1) / 12 dt^2 in each interval (see
    `maplab_py.estimation.kernels.imu`); a little more force in the first interval of an edge, and
    as much less in its last, makes up for the sum.
    """
    import gtsam

    parameters = gtsam.PreintegrationParams.MakeSharedU(problems.GRAVITY_MPS2)
    parameters.setGyroscopeCovariance(np.eye(3) * problem.noise.gyro**2)
    parameters.setAccelerometerCovariance(np.eye(3) * problem.noise.accel**2)
    parameters.setIntegrationCovariance(np.zeros((3, 3)))
    b_a, b_g = problem.initial_accel_bias, problem.initial_gyro_bias
    bias = gtsam.imuBias.ConstantBias(b_a, b_g)
    step_s = np.diff(problem.timestamp_ns, axis=1) * 1e-9
    accel, gyro = problem.accel_gyro[..., :3] - b_a, problem.accel_gyro[..., 3:] - b_g
    w = 0.5 * (gyro[:, :-1] + gyro[:, 1:])
    turn = Rotation.from_rotvec((w * step_s[..., None]).reshape(-1, 3))
    second = turn.apply(accel[:, 1:].reshape(-1, 3)).reshape(w.shape)
    f = 0.5 * (accel[:, :-1] + second) + _for_the_position(turn, (accel[:, :-1] - second) / 6.0)
    for k in range(len(w)):
        measured = gtsam.PreintegratedImuMeasurements(parameters, bias)
        for sample in range(w.shape[1]):
            measured.integrateMeasurement(f[k, sample] + b_a, w[k, sample] + b_g, step_s[k, sample])
        yield measured


def _for_the_position(turn: Rotation, lacking: problems.F64) -> problems.F64:
    """Return forces (E, N, 3) that add dt^2 / 2 of what is lacking in each interval (E, N, 3)."""
    edges, intervals, _ = lacking.shape
    turns = turn.as_matrix().reshape(edges, intervals, 3, 3)
    R_A_k = np.tile(np.eye(3), (edges, intervals, 1, 1))
    for k in range(1, intervals):
        R_A_k[:, k] = R_A_k[:, k - 1] @ turns[:, k - 1]
    total = np.einsum("ekij,ekj->ei", R_A_k, lacking) / (2.0 * (intervals - 1))
    added = np.zeros_like(lacking)
    added[:, 0] = total
    added[:, -1] = -np.einsum("eji,ej->ei", R_A_k[:, -1], total)
    return added


def _initial_values(problem: problems.InertialProblem) -> Any:
    visual, count = problem.visual, len(problem.visual.T_G_I)
    biases = (
        np.tile(b, (count, 1)) for b in (problem.initial_gyro_bias, problem.initial_accel_bias)
    )
    start = Solution(visual.initial_T_G_I, visual.initial_p_G, 0.0, 0, problem.initial_v_G, *biases)
    return _values(start)


def _values(states: Solution) -> Any:
    import gtsam
    from gtsam.symbol_shorthand import B, L, V, X

    assert states.v_G is not None
    assert states.gyro_bias is not None
    assert states.accel_bias is not None
    values = gtsam.Values()
    for k, T_G_I in enumerate(states.T_G_I):
        values.insert(X(k), _pose(T_G_I))
        values.insert(V(k), states.v_G[k])
        values.insert(B(k), gtsam.imuBias.ConstantBias(states.accel_bias[k], states.gyro_bias[k]))
    for landmark, p_G in enumerate(states.p_G):
        values.insert(L(landmark), p_G)
    return values


def _pose(T_G_I: problems.F64) -> Any:
    import gtsam

    x, y, z, w = T_G_I[:4]
    return gtsam.Pose3(gtsam.Rot3.Quaternion(w, x, y, z), T_G_I[4:])


def _solution(
    values: Any, problem: problems.InertialProblem, cost: float, iterations: int
) -> Solution:
    from gtsam.symbol_shorthand import B, L, V, X

    count, landmarks = len(problem.visual.T_G_I), len(problem.visual.p_G)
    poses = [values.atPose3(X(k)) for k in range(count)]
    rotations = np.array([pose.rotation().matrix() for pose in poses])
    positions = np.array([pose.translation() for pose in poses])
    biases = [values.atConstantBias(B(k)) for k in range(count)]
    return Solution(
        T_G_I=np.concatenate([Rotation.from_matrix(rotations).as_quat(), positions], axis=1),
        p_G=np.array([values.atPoint3(L(landmark)) for landmark in range(landmarks)]),
        cost=cost,
        iterations=iterations,
        v_G=np.array([values.atVector(V(k)) for k in range(count)]),
        gyro_bias=np.array([bias.gyroscope() for bias in biases]),
        accel_bias=np.array([bias.accelerometer() for bias in biases]),
    )
