"""A window and the general problem have the same minimum."""

import dataclasses

import numpy as np
import pytest

from maplab_py.array_types import F64
from maplab_py.estimation.codegen.kernels import residual_kernel, visual_kernels, window_kernels
from maplab_py.estimation.imu.inertial_data import InertialData
from maplab_py.estimation.loss import Loss
from maplab_py.estimation.problem.problem import Problem
from maplab_py.estimation.problem.solver import SolverOptions, optimize_states
from maplab_py.estimation.states import ACCEL_BIAS, GYRO_BIAS, VELOCITY, States
from maplab_py.estimation.symbolic import sources
from maplab_py.estimation.terms.cameras import Cameras
from maplab_py.estimation.terms.inertial import BiasWalkTerm, InertialTerm
from maplab_py.estimation.terms.prior import PosePrior, VertexVectorPrior
from maplab_py.estimation.terms.visual import Observations, VisualTerms
from maplab_py.estimation.window import calibration, inertial
from maplab_py.estimation.window.cameras import CameraPoses
from maplab_py.estimation.window.factors import FrameFactors, Standstill
from maplab_py.estimation.window.frame import StartState
from maplab_py.estimation.window.options import WindowOptions
from maplab_py.estimation.window.prior import WindowPrior
from maplab_py.estimation.window.problem import WindowProblem
from maplab_py.estimation.window.smoother import FixedLagSmoother
from maplab_py.estimation.window.states import WindowStates
from maplab_py.geometry import se3
from maplab_py.progress import SILENT
from maplab_py.vimap.table import starts_of_counts
from tests.estimation.window.recordings import SimulatedTracks, scenario, simulated

SIGMA = np.repeat([1e-3, 2e-3, 0.05, 1e-3, 0.05], 3)
TO_THE_END = SolverOptions(num_iterations=100, function_tolerance=1e-15, parameter_tolerance=1e-14)


@pytest.fixture(scope="module")
def tracks() -> SimulatedTracks:
    """Return tracks with such deviations that few errors are in the linear part of the loss.

    Where many are, reweighted least squares takes thousands of iterations to twelve digits.
    """
    tracks = simulated(scenario(duration_s=1.0, keypoints=60))
    frames = [dataclasses.replace(f, sigma_px=2.0 * f.sigma_px) for f in tracks.frames]
    return dataclasses.replace(tracks, frames=frames)


@pytest.fixture(scope="module")
def start(tracks: SimulatedTracks) -> StartState:
    return tracks.start_state(SIGMA, np.random.default_rng(5))


@pytest.fixture(scope="module")
def smoother(tracks: SimulatedTracks, start: StartState) -> FixedLagSmoother:
    """Return a smoother that nothing has left yet."""
    options = WindowOptions(num_keyframes=20, num_recent_frames=20, num_iterations=1)
    result = FixedLagSmoother(tracks.cameras, tracks.T_I_C, tracks.imu, options)
    result.start(tracks.frames[0], start)
    for frame in tracks.frames[1:8]:
        result.add(frame)
    return result


def general_problem(
    tracks: SimulatedTracks, start: StartState, smoother: FixedLagSmoother, window: WindowStates
) -> tuple[Problem, States]:
    """State the smoother's window with landmarks in M through the general problem."""
    rows = smoother.tracks.landmark_rows
    data, _ = smoother.tracks.data(rows, smoother.options.huber_sigmas)
    cameras = Cameras.of(tracks.cameras, tracks.T_I_C)
    v_M, b_g, b_a = (np.ascontiguousarray(window.motion[:, k : k + 3]) for k in (0, 3, 6))
    states = States(window.T_M_I, v_M, b_g, b_a, places(tracks, smoother, window))
    observations = Observations(
        data.start, data.frame, data.camera, data.uv_px, data.inverse_sigma, np.sqrt(data.scale2)
    )
    frames = tracks.frames[1 : len(window)]
    count = len(frames)
    imu = InertialData(
        starts_of_counts(np.array([len(frame.imu_times_ns) for frame in frames])),
        np.concatenate([frame.imu_times_ns for frame in frames]),
        np.concatenate([frame.accel_gyro for frame in frames]),
        (tracks.imu,), np.zeros(count, dtype=np.int64),
    )  # fmt: skip
    a, first = np.arange(count), np.array([0])
    walk = imu.walk_variance_density[0] * imu.duration_s[:, None]
    g_M = np.array([0.0, 0.0, -tracks.imu.gravity_magnitude_mps2])
    motion = residual_kernel("inertial", sources.inertial)
    vectors = (
        (VELOCITY, start.v_M, SIGMA[6]),
        (GYRO_BIAS, start.gyro_bias, SIGMA[9]),
        (ACCEL_BIAS, start.accel_bias, SIGMA[12]),
    )
    terms = [
        InertialTerm(motion, imu, a, a + 1, g_M),
        BiasWalkTerm(a, a + 1, walk[:, 0], walk[:, 1]),
        PosePrior(first, start.T_M_I, np.diag(1.0 / SIGMA[:6])),
        *(VertexVectorPrior(kind, first, x, s) for kind, x, s in vectors),
    ]
    visual = VisualTerms(visual_kernels(), observations, cameras, len(window), loss=Loss.HUBER)
    return Problem(states, visual, terms), states


def window_problem(
    tracks: SimulatedTracks, start: StartState, smoother: FixedLagSmoother, window: WindowStates
) -> WindowProblem:
    """State the smoother's window at other states, inertial edges integrated there."""
    data, _ = smoother.tracks.data(smoother.tracks.landmark_rows, smoother.options.huber_sigmas)
    cameras = calibration.WindowCalibration.of(tracks.cameras, tracks.T_I_C)
    chain = inertial.InertialChain(residual_kernel("inertial", sources.inertial), tracks.imu)
    for frame, motion in zip(tracks.frames[1:], window.motion[:-1], strict=False):
        chain.append(frame.imu_times_ns, frame.accel_gyro, motion, is_resting=False)
    still = residual_kernel("relative_pose", sources.relative_pose)
    never = np.zeros(len(window), dtype=np.bool_)
    factors = FrameFactors(chain, Standstill(still, smoother.options), never, never)
    prior = WindowPrior.of_state(start.T_M_I[0], start.motion[0], SIGMA)
    for T_M_I, motion in zip(window.T_M_I[1:], window.motion[1:], strict=True):
        prior = prior.with_frame(T_M_I, motion)
    return WindowProblem(window_kernels(), data, cameras, factors, prior)


def places(tracks: SimulatedTracks, smoother: FixedLagSmoother, window: WindowStates) -> F64:
    """Return the landmarks in M."""
    smoother.tracks.h[smoother.tracks.landmark_rows] = window.h
    poses = CameraPoses.of(window.T_M_I, tracks.T_I_C)
    return smoother.tracks.points(smoother.tracks.landmark_rows, poses)


def test_minimum_equals_that_of_the_general_problem(
    tracks: SimulatedTracks, start: StartState, smoother: FixedLagSmoother
) -> None:
    states = smoother.problem()[1]
    rng = np.random.default_rng(8)
    step = rng.standard_normal((len(states), 15)) * np.repeat([0.02, 0.01, 0.05, 1e-3, 0.01], 3)
    states = states.moved(step.reshape(-1), states.h * [1.0, 1.0, 1.05])
    problem = window_problem(tracks, start, smoother, states)
    general, general_states = general_problem(tracks, start, smoother, states)
    assert len(states.h) > 30

    ours, summary = optimize_states(problem, states, TO_THE_END, SILENT)
    theirs, reference = optimize_states(general, general_states, TO_THE_END, SILENT)

    assert summary.termination != "iteration limit"
    cost, expected = (sum(s.final_costs.values()) for s in (summary, reference))
    assert cost == pytest.approx(expected, rel=1e-8)
    assert sum(summary.initial_costs.values()) > 2.0 * cost
    size = np.abs(theirs.T_G_I[:, 4:]).max()
    np.testing.assert_allclose(se3.local(theirs.T_G_I, ours.T_M_I), 0.0, atol=1e-6 * size)
    np.testing.assert_allclose(ours.motion[:, :3], theirs.v_G, atol=1e-6)
    np.testing.assert_allclose(ours.gyro_bias, theirs.gyro_bias, atol=1e-6 * 0.01)
    np.testing.assert_allclose(ours.accel_bias, theirs.accel_bias, atol=1e-6 * 0.1)
    p_M = places(tracks, smoother, ours)
    np.testing.assert_allclose(p_M, theirs.p_G, rtol=1e-6, atol=1e-6 * size)


def test_first_step_promises_what_it_keeps(smoother: FixedLagSmoother) -> None:
    """With a tiny step the model is exact: promise and decrease agree."""
    problem, states = smoother.problem()
    problem.relinearize(states)
    damping = 1e7
    linear = problem.linearize(states, damping)
    step = problem.try_step(states, linear, damping)
    before = sum(linear.costs.values())
    assert step.promised > 0.0
    assert before - step.cost == pytest.approx(step.promised, rel=1e-3)
