"""The tie between two missions: true, and as sure as it says."""

import numpy as np
import pytest

from maplab_py.array_types import F64, I64
from maplab_py.frontend.dead_reckoning import Tie
from maplab_py.geometry import se3, so3, yaw
from maplab_py.simulation.scenario import ImuOptions
from maplab_py.vimap.nav_state import NavState
from tests.frontend.initialization.flights import Flight, fly, lively

SIGMA = np.repeat([0.02, 0.01, 0.05, 2e-3, 0.03], 3)


def between(first: int = 5, last: int = 65) -> tuple[Flight, NavState, I64, F64]:
    """Return a flight, the true state of a frame, and the samples from it to another, 3 s later."""
    perfect = ImuOptions(
        gyro_noise_density=0.0, accel_noise_density=0.0, gyro_bias_walk=0.0, accel_bias_walk=0.0
    )
    flight = fly(lively(3, 4.0), seed=3, points=5, imu=perfect)
    frames = flight.frames[first + 1 : last + 1]
    times_ns = np.concatenate([frame.imu_times_ns for frame in frames])
    times_ns, rows = np.unique(times_ns, return_index=True)
    samples = np.concatenate([frame.accel_gyro for frame in frames])[rows]
    state = NavState.single(
        flight.frames[first].time_ns, flight.truth.T_G_I[first], flight.truth.v_G[first],
        flight.gyro_bias[first], flight.accel_bias[first],
    )  # fmt: skip
    return flight, state, times_ns, samples


def test_samples_lead_to_the_true_pose() -> None:
    flight, state, times_ns, samples = between()
    tie = Tie.by_samples(flight.device.imu, state, 1e-8 * np.eye(15), times_ns, samples)
    truth = se3.relative(flight.truth.T_G_I[5], flight.truth.T_G_I[65])
    assert tie.duration_s == pytest.approx(3.0)
    assert np.linalg.norm(se3.local(truth, tie.T_A_B)) < 2e-3
    T_M_B = se3.compose(yaw.to_pose([1.0, -2.0, 0.5, 0.7]), flight.truth.T_G_I[65])
    T_G_M = tie.base_frame(flight.truth.T_G_I[5], T_M_B)
    assert np.linalg.norm(T_G_M[:2]) == 0.0
    np.testing.assert_allclose(se3.compose(T_G_M, T_M_B), flight.truth.T_G_I[65], atol=2e-3)
    assert tie.is_known


def test_the_covariance_is_that_of_the_errors() -> None:
    flight, state, times_ns, samples = between()
    imu = flight.device.imu
    truth = Tie.by_samples(imu, state, np.diag(SIGMA**2), times_ns, samples)
    rng, errors = np.random.default_rng(4), []
    for _ in range(200):
        p, theta, v, gyro, accel = (SIGMA * rng.standard_normal(15)).reshape(5, 3)
        q = so3.multiply(state.T_M_I[0, :4], so3.exp(theta))
        wrong = NavState.single(
            int(times_ns[0]), se3.make(q, state.T_M_I[0, 4:] + p), state.v_M[0] + v,
            state.gyro_bias[0] + gyro, state.accel_bias[0] + accel,
        )  # fmt: skip
        moved = Tie.by_samples(imu, wrong, None, times_ns, samples)
        errors.append(se3.local(truth.T_A_B, moved.T_A_B))
    squares = [error @ np.linalg.solve(truth.covariance, error) for error in errors]
    assert np.mean(squares) == pytest.approx(6.0, rel=0.15)


def test_holes_and_long_times_are_less_sure() -> None:
    flight, state, times_ns, samples = between()
    imu = flight.device.imu
    whole = Tie.by_samples(imu, state, None, times_ns, samples)
    kept = (times_ns < times_ns[200]) | (times_ns > times_ns[350])
    hole = Tie.by_samples(imu, state, None, times_ns[kept], samples[kept])
    short = Tie.by_samples(imu, state, None, times_ns[:200], samples[:200])
    assert short.position_sigma_m < whole.position_sigma_m < hole.position_sigma_m
    assert not hole.is_known
    assert hole.rotation_sigma_rad > 0.3
    assert "3.0 s of IMU samples: +- " in whole.words
