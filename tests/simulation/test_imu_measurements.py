"""The IMU's model, its noise, and that an integrator gets back to the motion."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from maplab_py.estimation.imu.inertial_data import InertialData
from maplab_py.estimation.imu.propagation import propagate
from maplab_py.geometry import so3
from maplab_py.sensors import Imu, ImuIntrinsics
from maplab_py.simulation.imu import intrinsics_of, measure
from maplab_py.simulation.motion import motion_spline
from maplab_py.simulation.scenario import ImuOptions, SessionOptions, WorldOptions
from maplab_py.simulation.spline import MotionState
from tests.support.imu_model import correct_imu

GRAVITY = np.array([0.0, 0.0, -9.81])
QUIET = ImuOptions(
    gyro_noise_density=0.0,
    accel_noise_density=0.0,
    gyro_bias_walk=0.0,
    accel_bias_walk=0.0,
    gyro_bias_sigma=0.0,
    accel_bias_sigma=0.0,
)
IDEAL = ImuIntrinsics()
SKEWED = dataclasses.replace(
    QUIET,
    gyro_scale=(1.01, 0.99, 1.02),
    accel_scale=(0.98, 1.0, 1.03),
    gyro_misalignment=(0.01, -0.02, 0.005),
    accel_misalignment=(-0.01, 0.0, 0.02),
    accel_rotation_rad=(0.01, 0.02, -0.03),
)


def _motion(rate_hz: float, duration_s: float = 4.0) -> MotionState:
    options = SessionOptions(duration_s=duration_s, turns=0.15 * duration_s / 4.0)
    spline = motion_spline(options, WorldOptions(), np.random.default_rng(1))
    return spline.evaluate(np.arange(int(duration_s * rate_hz) + 1) / rate_hz)


def _prediction_errors(rate_hz: float) -> tuple[float, float, float]:
    """Return the largest position, velocity and angle error of edges of 0.1 s."""
    motion = _motion(rate_hz)
    imu = measure(
        dataclasses.replace(QUIET, rate_hz=rate_hz), IDEAL, motion, np.random.default_rng(0)
    )
    stride = int(0.1 * rate_hz)
    first = np.arange(0, len(motion.v_G) - stride, stride)
    rows = (first[:, None] + np.arange(stride + 1)).ravel()
    data = InertialData(
        np.arange(len(first) + 1) * (stride + 1),
        np.round(rows / rate_hz * 1e9).astype(np.int64),
        imu.accel_gyro[rows],
        (Imu("0" * 32),),
        np.zeros(len(first), dtype=np.int64),
    )
    zero = np.zeros(3)
    T, v = propagate(data, motion.T_G_I[first], motion.v_G[first], zero, zero, GRAVITY)
    ends, last = np.arange(1, len(first) + 1) * (stride + 1) - 1, first + stride
    turn = so3.multiply(so3.inverse(T[ends, :4]), motion.T_G_I[last, :4])
    return (
        float(np.linalg.norm(T[ends, 4:] - motion.T_G_I[last, 4:], axis=1).max()),
        float(np.linalg.norm(v[ends] - motion.v_G[last], axis=1).max()),
        float(np.linalg.norm(so3.log(turn), axis=1).max()),
    )


def _reference_errors(rate_hz: float) -> tuple[float, float, float]:
    """Return the same errors when the samples, joined by straight lines, are integrated by RK4."""
    motion = _motion(rate_hz)
    samples = measure(
        dataclasses.replace(QUIET, rate_hz=rate_hz), IDEAL, motion, np.random.default_rng(0)
    ).accel_gyro
    stride, dt = int(0.1 * rate_hz), 1.0 / rate_hz
    first = np.arange(0, len(motion.v_G) - stride, stride)
    q, v, p = motion.T_G_I[first, :4], motion.v_G[first], motion.T_G_I[first, 4:]
    for step in range(stride):
        before, after = samples[first + step], samples[first + step + 1]

        def slope(state: list[np.ndarray], s: float) -> list[np.ndarray]:
            q, v = state[0], state[1]
            reading = before + s * (after - before)  # noqa: B023
            rate = np.concatenate([reading[:, 3:], np.zeros((len(q), 1))], axis=1)
            force = so3.rotate(so3.normalize(q), reading[:, :3])
            return [0.5 * so3.multiply(q, rate), force + GRAVITY, v]

        state = [q, v, p]
        a = slope(state, 0.0)
        b = slope([x + 0.5 * dt * d for x, d in zip(state, a, strict=True)], 0.5)
        c = slope([x + 0.5 * dt * d for x, d in zip(state, b, strict=True)], 0.5)
        d = slope([x + dt * d for x, d in zip(state, c, strict=True)], 1.0)
        q, v, p = (
            x + dt / 6.0 * (ka + 2.0 * kb + 2.0 * kc + kd)
            for x, ka, kb, kc, kd in zip(state, a, b, c, d, strict=True)
        )
        q = so3.normalize(q)
    last = first + stride
    turn = so3.multiply(so3.inverse(q), motion.T_G_I[last, :4])
    return (
        float(np.linalg.norm(p - motion.T_G_I[last, 4:], axis=1).max()),
        float(np.linalg.norm(v - motion.v_G[last], axis=1).max()),
        float(np.linalg.norm(so3.log(turn), axis=1).max()),
    )


def test_what_a_prediction_misses_is_sampling() -> None:
    coarse, fine = _reference_errors(200.0), _reference_errors(400.0)
    assert coarse[0] < 1e-6
    assert coarse[1] < 2e-5
    assert coarse[2] < 5e-5
    for slow, fast in zip(coarse, fine, strict=True):
        assert slow >= 3.99 * fast


def test_the_estimators_prediction_errors_are_small_and_fall_with_the_rate() -> None:
    coarse, fine = _prediction_errors(200.0), _prediction_errors(400.0)
    assert coarse[0] < 1e-6
    assert coarse[1] < 2e-5
    assert coarse[2] < 5e-5
    for slow, fast in zip(coarse, fine, strict=True):
        assert slow >= 3.99 * fast


def test_correcting_the_reports_gives_force_and_rate() -> None:
    motion = _motion(100.0)
    recording = measure(SKEWED, intrinsics_of(SKEWED) or IDEAL, motion, np.random.default_rng(0))
    back = correct_imu(intrinsics_of(SKEWED), recording.accel_gyro, np.zeros(3), np.zeros(3))
    force = so3.rotate(so3.inverse(motion.T_G_I[:, :4]), motion.a_G - GRAVITY)
    np.testing.assert_allclose(back[:, :3], force, atol=1e-12)
    np.testing.assert_allclose(back[:, 3:], motion.w_I, atol=1e-12)


def test_ideal_imu_needs_no_intrinsics() -> None:
    assert intrinsics_of(QUIET) is None
    skewed = intrinsics_of(SKEWED)
    assert skewed is not None
    assert np.all(np.tril(skewed.T_g, -1) == 0.0)


@pytest.mark.parametrize(
    ("columns", "density"),
    [(slice(0, 3), "accel_noise_density"), (slice(3, 6), "gyro_noise_density")],
)
def test_noise_has_its_density(columns: slice, density: str) -> None:
    options = dataclasses.replace(QUIET, **{density: 1e-3})
    motion = _motion(200.0, 60.0)
    noisy = measure(options, IDEAL, motion, np.random.default_rng(5)).accel_gyro
    clean = measure(QUIET, IDEAL, motion, np.random.default_rng(5)).accel_gyro
    sigma = np.std((noisy - clean)[:, columns])
    # 36000 values: the standard deviation is known to 0.4 %
    assert sigma == pytest.approx(1e-3 * np.sqrt(200.0), rel=0.015)


def test_biases_walk_as_told() -> None:
    options = dataclasses.replace(QUIET, accel_bias_walk=0.01, accel_bias_sigma=0.5)
    motion = _motion(200.0, 60.0)
    bias = measure(options, IDEAL, motion, np.random.default_rng(2)).accel_bias
    per_second = bias[200:] - bias[:-200]
    steps = np.diff(bias, axis=0)
    assert np.std(steps) == pytest.approx(0.01 / np.sqrt(200.0), rel=0.015)
    assert np.std(per_second) == pytest.approx(0.01, rel=0.25)
    assert np.abs(bias[0]).max() > 0.05
