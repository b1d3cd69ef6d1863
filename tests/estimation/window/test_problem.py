"""The normal equations of a window against differences and against a dense elimination."""

from collections.abc import Callable

import numpy as np
import pytest

from maplab_py.array_types import F64
from maplab_py.estimation.linear.protocol import NotPositiveDefinite
from maplab_py.estimation.window.options import WindowOptions
from maplab_py.estimation.window.problem import WindowProblem
from maplab_py.estimation.window.smoother import FixedLagSmoother
from maplab_py.estimation.window.states import WindowStates
from tests.estimation.window.recordings import SimulatedTracks, scenario, simulated

SIGMA = np.repeat([1e-3, 2e-3, 0.02, 1e-3, 0.02], 3)


@pytest.fixture(scope="module")
def tracks() -> SimulatedTracks:
    return simulated(scenario(duration_s=2.0, keypoints=30))


@pytest.fixture(scope="module")
def smoother(tracks: SimulatedTracks) -> FixedLagSmoother:
    """Return a smoother after some marginalisations."""
    options = WindowOptions(num_keyframes=3, num_recent_frames=2)
    result = FixedLagSmoother(tracks.cameras, tracks.T_I_C, tracks.imu, options)
    result.start(tracks.frames[0], tracks.start_state(SIGMA, np.random.default_rng(1)))
    for frame in tracks.frames[1:16]:
        result.add(frame)
    assert result.prior.touched.any()
    return result


def moved(states: WindowStates, move: F64) -> WindowStates:
    frames = 15 * len(states)
    return states.moved(move[:frames], states.h + move[frames:].reshape(-1, 3))


def differences(function: Callable[[F64], float], steps: F64) -> F64:
    result = np.empty(len(steps))
    for k, step in enumerate(steps):
        move = np.zeros(len(steps))
        move[k] = step
        result[k] = (function(move) - function(-move)) / (2.0 * step)
    return result


def cost(problem: WindowProblem, states: WindowStates) -> float:
    linear = problem.linearize(states, 1e-6)
    return sum(linear.costs.values())


def at_first_estimates(smoother: FixedLagSmoother) -> tuple[WindowProblem, WindowStates]:
    """Return the problem and states where fixed frames are at their linearisation points."""
    problem, states = smoother.problem()
    prior, fixed = smoother.prior, smoother.prior.is_fixed
    T_M_I, motion = states.T_M_I.copy(), states.motion.copy()
    T_M_I[fixed], motion[fixed] = prior.x0.T_M_I[fixed], prior.x0.motion[fixed]
    return problem, WindowStates(T_M_I, motion, states.h)


def test_gradient_is_the_derivative_of_the_cost(smoother: FixedLagSmoother) -> None:
    problem, states = at_first_estimates(smoother)
    linear = problem.linearize(states, 1e-6)
    gradient = np.concatenate([linear.system.gradient, linear.kept.gradient.reshape(-1)])
    per_frame = np.repeat([1e-6, 1e-6, 1e-6, 1e-7, 1e-6], 3)
    steps = np.concatenate([np.tile(per_frame, len(states)), np.full(states.h.size, 1e-6)])
    numeric = differences(lambda move: cost(problem, moved(states, move)), steps)
    scale = np.sqrt(np.concatenate([linear.system.diagonal, _diagonals(linear.kept.square)]))
    np.testing.assert_allclose(gradient / scale, numeric / scale, atol=2e-4)


def test_expected_depths_are_part_of_the_cost(smoother: FixedLagSmoother) -> None:
    tracks = smoother.tracks
    rows = tracks.landmark_rows[::2]
    before = tracks.expected.copy()
    tracks.expected[rows, 0] = 1.3 * tracks.h[rows, 2]
    tracks.expected[rows, 1] = 1.0 / (0.5 * tracks.h[rows, 2])
    try:
        with_depths, states = at_first_estimates(smoother)
    finally:
        tracks.expected[:] = before
    without, _ = at_first_estimates(smoother)
    # 1.3 h is 0.6 deviations of 0.5 h away
    added = cost(with_depths, states) - cost(without, states)
    assert added == pytest.approx(0.5 * 0.6**2 * len(rows), rel=1e-6)
    gradients = [p.linearize(states, 1e-6).kept.gradient for p in (with_depths, without)]
    difference = gradients[0] - gradients[1]
    changed = np.flatnonzero(np.isin(tracks.landmark_rows, rows))
    np.testing.assert_allclose(difference[changed, 2] * states.h[changed, 2], -0.6 / 0.5, rtol=1e-6)
    np.testing.assert_allclose(np.delete(difference, changed, axis=0), 0.0, atol=1e-9)
    trial = with_depths.try_step(states, with_depths.linearize(states, 1e-6), 1e-6)
    expected = cost(with_depths, trial.states)
    assert sum(trial.costs.values()) == pytest.approx(expected, rel=1e-9)


def _diagonals(square: F64) -> F64:
    return square[:, [0, 2, 5]].reshape(-1)


def test_fixed_frames_keep_their_jacobians(smoother: FixedLagSmoother) -> None:
    """The second derivatives do not change when frames that were marginalised upon move."""
    problem, states = at_first_estimates(smoother)
    fixed = np.repeat(smoother.prior.is_fixed, 15)
    move = np.where(fixed, 1e-3, 0.0)
    there = states.moved(move, states.h)
    before, after = (problem.linearize(s, 1e-6).system for s in (states, there))
    rows = np.ix_(fixed, fixed)
    unit = np.sqrt(before.diagonal[fixed])
    change = (after.matrix - before.matrix)[rows] / (unit[:, None] * unit)
    weights_changed = 0.05  # Huber weights follow the residuals
    assert np.abs(np.tril(change)).max() < weights_changed
    assert np.abs(after.gradient - before.gradient).max() > 0.0


def test_step_solves_the_whole_system(smoother: FixedLagSmoother) -> None:
    """Landmarks eliminated and substituted solve what solving for everything at once does."""
    problem, states = smoother.problem()
    damping = 1e-3
    linear = problem.linearize(states, damping)
    kept, size = linear.kept, 15 * len(states)
    whole = np.zeros((size + states.h.size, size + states.h.size))
    whole[:size, :size] = np.tril(linear.system.matrix)
    whole[:size, :size] += np.tril(linear.system.matrix, -1).T
    lower = np.array([[0, -1, -1], [1, 2, -1], [3, 4, 5]])
    for n in range(len(states.h)):
        rows = size + 3 * n + np.arange(3)
        f = kept.factor[n]
        L = np.array([[1.0 / f[0], 0, 0], [f[1], 1.0 / f[2], 0], [f[3], f[4], 1.0 / f[5]]])
        W = np.zeros((3, size))
        for slot in range(kept.num_slots[n]):
            first = 15 * kept.slots[n, slot]
            W[:, first : first + 6] = L @ kept.Y[n, slot]
        H = L @ L.T
        expected = kept.square[n][lower] * (lower >= 0)
        added = damping * np.diag(np.clip(np.diagonal(expected), 1e-6, 1e32))
        np.testing.assert_allclose(np.tril(H), expected + added, rtol=1e-9, atol=1e-6)
        whole[rows[:, None], rows] = H
        whole[rows[:, None], np.arange(size)] = W
        whole[np.arange(size)[:, None], rows] = W.T
        whole[:size, :size] += W.T @ np.linalg.solve(H, W)
    whole[np.arange(size), np.arange(size)] += damping * np.maximum(linear.system.diagonal, 1e-6)
    gradient = np.concatenate([linear.system.gradient, kept.gradient.reshape(-1)])
    unit = np.sqrt(np.diagonal(whole))
    solution = -np.linalg.solve(whole / (unit[:, None] * unit), gradient / unit) / unit
    step = problem.try_step(states, linear, damping)
    expected_states = moved(states, solution)
    np.testing.assert_allclose(step.states.T_M_I, expected_states.T_M_I, atol=1e-9)
    np.testing.assert_allclose(step.states.motion, expected_states.motion, atol=1e-8)
    np.testing.assert_allclose(step.states.h, expected_states.h, atol=1e-8)


def test_covariance_is_the_inverse_of_the_information(smoother: FixedLagSmoother) -> None:
    problem, states = smoother.problem()
    linear = problem.linearize(states, 1e-12)
    lower = linear.system.matrix
    matrix = np.tril(lower) + np.tril(lower, -1).T
    unit = np.sqrt(np.diagonal(matrix))
    inverse = np.linalg.inv(matrix / (unit[:, None] * unit)) / (unit[:, None] * unit)
    last = slice(15 * len(states) - 15, None)
    rows = 15 * (len(states) - 1) + np.arange(15)
    covariance = problem.covariance(states, rows)
    assert problem.undamped_near(states) is linear
    problem.linearize(states, 1.0)
    again = problem.covariance(states, rows)
    np.testing.assert_allclose(again, covariance)
    deviation = np.sqrt(np.diagonal(covariance))
    scaled = (covariance - inverse[last, last]) / (deviation[:, None] * deviation)
    assert np.abs(scaled).max() < 1e-6
    np.testing.assert_array_equal(covariance, covariance.T)


def test_singular_equations_name_the_frame(smoother: FixedLagSmoother) -> None:
    problem, states = smoother.problem()
    linear = problem.linearize(states, 1e-6)
    linear.system.matrix[20, 20] = -1.0
    with pytest.raises(NotPositiveDefinite) as caught:
        problem.try_step(states, linear, 1e-6)
    assert caught.value.node == 1
