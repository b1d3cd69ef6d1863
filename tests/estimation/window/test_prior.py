"""Marginalisation: the same as solving jointly, and no information where there is none."""

import numpy as np
import pytest

from maplab_py.array_types import F64
from maplab_py.estimation.window.options import WindowOptions
from maplab_py.estimation.window.prior import WindowPrior, schur_complement
from maplab_py.estimation.window.smoother import FixedLagSmoother
from maplab_py.estimation.window.states import WindowStates
from maplab_py.geometry import so3
from tests.estimation.window.recordings import SimulatedTracks, scenario, simulated


@pytest.fixture(scope="module")
def tracks() -> SimulatedTracks:
    return simulated(scenario(duration_s=3.0, keypoints=60))


def random_states(frames: int, rng: np.random.Generator) -> WindowStates:
    T_M_I = np.concatenate(
        [so3.normalize(rng.standard_normal((frames, 4))), rng.standard_normal((frames, 3))], axis=1
    )
    return WindowStates(T_M_I, rng.standard_normal((frames, 9)), np.zeros((0, 3)))


def linear_system(frames: int, rng: np.random.Generator) -> tuple[F64, F64]:
    J, r = rng.standard_normal((40 * frames, 15 * frames)), rng.standard_normal(40 * frames)
    J *= 10.0 ** rng.uniform(-3, 3, 15 * frames)  # units differ
    return J.T @ J, J.T @ r


def test_prior_has_the_information_it_was_made_of() -> None:
    rng = np.random.default_rng(2)
    H, g = linear_system(3, rng)
    states = random_states(3, rng)
    prior = WindowPrior.of_information(H, g, states, np.ones(3, dtype=np.bool_))
    scale = np.sqrt(np.diagonal(H))
    unit = scale[:, None] * scale
    np.testing.assert_allclose(prior.information / unit, H / unit, atol=1e-12)
    np.testing.assert_allclose(prior.root.T @ prior.residual, g, rtol=1e-9)
    residual, information, gradient = prior.linearized(states)
    np.testing.assert_allclose(information, prior.information)
    np.testing.assert_allclose(gradient, g, rtol=1e-9)
    np.testing.assert_allclose(residual, prior.evaluate(states))


def test_marginalising_step_by_step_equals_all_at_once() -> None:
    rng = np.random.default_rng(3)
    H, g = linear_system(4, rng)
    states = random_states(4, rng)
    prior = WindowPrior.of_information(H, g, states, np.ones(4, dtype=np.bool_))
    stepwise = prior.without_frame(2).without_frame(0)
    rows = np.concatenate([np.arange(15), np.arange(30, 45)])
    H_once, g_once = schur_complement(H, g, rows)
    unit = np.sqrt(np.diagonal(H_once))
    error = (stepwise.information - H_once) / (unit[:, None] * unit)
    assert np.abs(error).max() < 1e-9
    np.testing.assert_allclose(stepwise.root.T @ stepwise.residual, g_once, rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(stepwise.x0.T_M_I, states.T_M_I[[1, 3]])


def test_cost_of_the_prior_is_the_least_of_the_joint_cost() -> None:
    """Up to a constant: differences between states agree."""
    rng = np.random.default_rng(4)
    H, g = linear_system(2, rng)
    reduced, gradient = schur_complement(H, g, np.arange(15))
    states = random_states(1, rng)
    prior = WindowPrior.of_information(reduced, gradient, states, np.ones(1, dtype=np.bool_))

    def joint(later: F64) -> float:
        first = np.linalg.solve(H[:15, :15], -g[:15] - H[:15, 15:] @ later)
        x = np.concatenate([first, later])
        return float(0.5 * x @ H @ x + g @ x)

    moves = [rng.standard_normal(15) * 1e-3 for _ in range(2)]
    costs = []
    for move in moves:
        residual = prior.evaluate(states.moved(move, states.h))
        costs.append(0.5 * float(residual @ residual))
    assert costs[0] - costs[1] == pytest.approx(joint(moves[0]) - joint(moves[1]), rel=1e-9)


def test_unknown_directions_stay_unknown() -> None:
    rng = np.random.default_rng(5)
    J = rng.standard_normal((20, 30))
    J[:, :3] = J[:, 15:18] = 0.0
    prior = WindowPrior.of_information(
        J.T @ J, np.zeros(30), random_states(2, rng), np.ones(2, dtype=np.bool_)
    )
    assert len(prior.root) == 20
    assert not prior.root[:, :3].any()
    assert prior.touched.all()


ROUNDING = 1e5 * np.finfo(np.float64).eps
"""Relative information that rounding leaves: Schur complements subtract numbers up to 1e5 times
larger, and how BLAS rounds them differs between processors (3e-13 to 2e-12 were seen)."""


def gauge_directions(states: WindowStates) -> F64:
    """Return the tangents (15 F, 4) that move all frames together: position, and yaw about M's origin."""
    frames = len(states)
    result = np.zeros((frames, 15, 4))
    up = np.array([0.0, 0.0, 1.0])
    result[:, :3, :3] = np.eye(3)
    result[:, :3, 3] = np.cross(up, states.T_M_I[:, 4:])
    result[:, 3:6, 3] = so3.rotate(so3.inverse(states.T_M_I[:, :4]), np.tile(up, (frames, 1)))
    result[:, 6:9, 3] = np.cross(up, states.motion[:, :3])
    return result.reshape(-1, 4)


def run_without_gauge(tracks: SimulatedTracks) -> tuple[WindowPrior, F64]:
    """Return prior and share of its information along the gauge; the start knows biases only.

    A known velocity in M would tell yaw.
    """
    options = WindowOptions(num_keyframes=4)
    smoother = FixedLagSmoother(tracks.cameras, tracks.T_I_C, tracks.imu, options)
    sigma = np.repeat([np.inf, np.inf, np.inf, 1e-3, 0.05], 3)
    start = tracks.start_state(
        np.repeat([0.0, 2e-3, 0.05, 1e-3, 0.05], 3), np.random.default_rng(6)
    )
    smoother.start(tracks.frames[0], type(start)(**{**vars(start), "sigma": sigma}))
    first_ns = set()
    for frame in tracks.frames[1:]:
        smoother.add(frame)
        first_ns.add(int(smoother.times_ns[0]))
    assert len(first_ns) > 4  # so many less one have been marginalised
    prior = smoother.prior
    x0 = prior.x0
    gauge = gauge_directions(x0)
    scale = np.sqrt(np.maximum(np.diagonal(prior.information), 1e-300))
    along = np.linalg.norm(prior.root @ gauge, axis=0)
    return prior, along / np.linalg.norm(scale[:, None] * gauge, axis=0)


def test_gauge_directions_of_the_prior_stay_free(tracks: SimulatedTracks) -> None:
    prior, share = run_without_gauge(tracks)
    assert np.all(share**2 < ROUNDING)
    values = np.linalg.svd(prior.root[:, np.diagonal(prior.information) > 0.0], compute_uv=False)
    assert len(values) <= np.count_nonzero(np.diagonal(prior.information) > 0.0) - 4
