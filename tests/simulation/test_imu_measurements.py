"""The IMU's model, its noise by Allan deviations, and integrals that lead back to the motion."""

import dataclasses

import numpy as np
import pytest

from maplab_py.estimation.imu.inertial_data import InertialData
from maplab_py.estimation.imu.preintegration import propagate
from maplab_py.geometry import se3, so3
from maplab_py.sensors import Imu, ImuIntrinsics
from maplab_py.simulation.imu import intrinsics_of, measure
from maplab_py.simulation.motion import motion_spline
from maplab_py.simulation.scenario import ImuOptions, SessionOptions, WorldOptions
from maplab_py.simulation.simulate import simulate
from maplab_py.simulation.spline import MotionState
from maplab_py.vimap.consistency import check_consistency
from tests.simulation.small import PERFECT, SMALL, simulated
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


RATE_HZ = 100.0
NOISELESS = dataclasses.replace(QUIET, rate_hz=RATE_HZ)


def _at_rest(seconds: float, rate_hz: float = RATE_HZ) -> MotionState:
    count = int(seconds * rate_hz)
    zero = np.zeros((count, 3))
    return MotionState(np.tile(se3.identity(), (count, 1)), zero, zero, zero, zero)


def _moving() -> MotionState:
    session = SessionOptions(duration_s=10.0, turns=0.4)
    spline = motion_spline(session, WorldOptions(), np.random.default_rng(0))
    return spline.evaluate(np.arange(1000) / RATE_HZ)


def _measured(options: ImuOptions, motion: MotionState, seed: int = 0) -> np.ndarray:
    return measure(options, IDEAL, motion, np.random.default_rng(seed)).accel_gyro


def _allan_deviation(signal: np.ndarray, cluster: int) -> np.ndarray:
    """Return the overlapping Allan deviation (3,) of a signal (N, 3); IEEE Std 952, annex C."""
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(signal, axis=0)])
    means = (total[cluster:] - total[:-cluster]) / cluster
    change = means[cluster:] - means[:-cluster]
    return np.sqrt(0.5 * np.mean(change**2, axis=0))


@pytest.mark.parametrize(("first", "name"), [(0, "accel"), (3, "gyro")])
def test_white_noise_falls_with_the_root_of_the_time(first: int, name: str) -> None:
    density = 2e-3
    options = dataclasses.replace(NOISELESS, **{f"{name}_noise_density": density})
    signal = _measured(options, _at_rest(2000.0))[:, first : first + 3]
    clusters = np.array([1, 10, 100, 1000])
    deviation = np.array([_allan_deviation(signal, n) for n in clusters])
    time = clusters / RATE_HZ
    slope = np.polyfit(np.log(time), np.log(deviation), 1)[0]
    np.testing.assert_allclose(slope, -0.5, atol=0.03)
    np.testing.assert_allclose(deviation[:3] * np.sqrt(time[:3, None]), density, rtol=0.08)


@pytest.mark.parametrize(("first", "name"), [(0, "accel"), (3, "gyro")])
def test_bias_walk_grows_with_the_root_of_the_time(first: int, name: str) -> None:
    walk, rate_hz = 1e-3, 20.0
    options = dataclasses.replace(NOISELESS, rate_hz=rate_hz, **{f"{name}_bias_walk": walk})
    signal = _measured(options, _at_rest(20_000.0, rate_hz))[:, first : first + 3]
    clusters = np.array([20, 200, 2000])
    deviation = np.array([_allan_deviation(signal, n) for n in clusters])
    time = clusters / rate_hz
    slope = np.polyfit(np.log(time), np.log(deviation), 1)[0]
    np.testing.assert_allclose(slope, 0.5, atol=0.05)
    np.testing.assert_allclose(deviation[:2] / np.sqrt(time[:2, None] / 3.0), walk, rtol=0.1)


def test_gyroscope_that_feels_acceleration() -> None:
    difference = _measured(dataclasses.replace(NOISELESS, g_sensitivity=1e-3), _moving())
    difference = difference - _measured(NOISELESS, _moving())
    assert not difference[:, :3].any()
    np.testing.assert_allclose(difference[:, 3:], 1e-3 * _measured(NOISELESS, _moving())[:, :3])


def test_accelerometer_away_from_the_centre() -> None:
    arm = np.array([0.05, -0.03, 0.02])
    options = dataclasses.replace(NOISELESS, lever_arm_m=tuple(arm.tolist()))
    session = SessionOptions(duration_s=10.0, turns=0.4)
    spline = motion_spline(session, WorldOptions(), np.random.default_rng(0))
    step, time = 1e-3, np.arange(1.03, 9.0, 0.1)
    there = [se3.transform(spline.evaluate(time + k * step).T_G_I, arm) for k in (-1, 0, 1)]
    a_G = (there[0] - 2.0 * there[1] + there[2]) / step**2
    motion = spline.evaluate(time)
    force = so3.rotate(so3.inverse(motion.T_G_I[:, :4]), a_G - GRAVITY)
    np.testing.assert_allclose(_measured(options, motion)[:, :3], force, atol=1e-4)


def test_scales_grow_while_the_device_warms_up() -> None:
    options = dataclasses.replace(NOISELESS, warming_scale=0.02, warming_time_s=2.0)
    with np.errstate(invalid="ignore"):
        ratio = _measured(options, _moving()) / _measured(NOISELESS, _moving())
    assert ratio[0] == pytest.approx(np.ones(6))
    np.testing.assert_allclose(ratio[-1], 1.0 + 0.02 * (1.0 - np.exp(-5.0)), atol=1e-4)


def test_saturation_cuts_off() -> None:
    options = dataclasses.replace(NOISELESS, saturation_accel_mps2=9.0, saturation_gyro_radps=0.2)
    samples = _measured(options, _moving())
    assert np.abs(samples[:, :3]).max() == 9.0
    assert np.abs(samples[:, 3:]).max() == 0.2


def test_late_time_stamps_show_the_motion_of_before() -> None:
    imu = dataclasses.replace(PERFECT.imu, time_offset_s=0.02)
    late = simulate(dataclasses.replace(PERFECT, imu=imu))
    on_time = simulated(PERFECT)
    # the session begins 20 ms into its motion, and the samples show what was 20 ms before
    first = [
        data.maps[0].imu_samples.accel_gyro[0]
        - np.concatenate([data.maps[0].vertices.accel_bias[0], data.maps[0].vertices.gyro_bias[0]])
        for data in (late, on_time)
    ]
    np.testing.assert_allclose(first[0], first[1], atol=1e-9)
    shift = late.truth.T_G_I[0, 4:] - on_time.truth.T_G_I[0, 4:]
    np.testing.assert_allclose(shift, 0.02 * on_time.truth.v_G[0], atol=1e-3)


def test_lost_samples_and_uneven_stamps_leave_a_consistent_map() -> None:
    imu = dataclasses.replace(SMALL.imu, dropped_share=0.2, time_jitter_s=3e-4)
    vi_map = simulate(dataclasses.replace(SMALL, imu=imu)).maps[0]
    assert check_consistency(vi_map).errors == ()
    whole = simulated().maps[0]
    share = len(vi_map.imu_samples) / len(whole.imu_samples)
    assert share == pytest.approx(0.81, abs=0.03)
    time_ns = vi_map.imu_samples.timestamp_ns
    np.testing.assert_array_equal(
        time_ns[vi_map.sample_start[:-1]], vi_map.vertices.timestamp_ns[:-1]
    )
    inside = np.diff(time_ns)[np.diff(time_ns) > 0]
    assert inside.min() > 2_000_000
    assert 50_000 < np.std(inside % 5_000_000) < 3_000_000
