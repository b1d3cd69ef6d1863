"""When the estimator starts, how well, and why it does not."""

import dataclasses

import numpy as np
import pytest

from maplab_py.estimation.window.frame import StartState, WindowFrame
from maplab_py.frontend.initialization.initializer import Initializer
from maplab_py.frontend.initialization.motion import Attempt, MotionStart
from maplab_py.frontend.initialization.options import InitializationOptions
from maplab_py.frontend.initialization.segment import History
from maplab_py.geometry import so3
from maplab_py.interop.recordings.protocol import RecordedSensors
from maplab_py.simulation.scenario import ImuOptions
from tests.frontend.initialization.flights import (
    Flight,
    body_velocity,
    creeping,
    fly,
    lively,
    resting,
    tilt_error_deg,
)


@dataclasses.dataclass(frozen=True, eq=False)
class Start:
    state: StartState | None
    frame: int  # whose state it is
    seconds: float  # until the state was known
    reasons: list[str]
    attempt: Attempt | None


def start(flight: Flight, options: InitializationOptions | None = None) -> Start:
    initializer = Initializer(flight.device, options)
    reasons = [initializer.reason]
    found, number = None, -1
    while found is None and number + 1 < len(flight.frames):
        number += 1
        found = initializer.push(flight.frames[number])
        if initializer.reason != reasons[-1]:
            reasons.append(initializer.reason)
    seconds = (flight.frames[number].time_ns - flight.frames[0].time_ns) * 1e-9
    if found is None:
        return Start(None, number, seconds, reasons, initializer.attempt)
    of_state = number - len(found.later)
    assert found.frame is flight.frames[of_state]
    assert [frame.time_ns for frame in found.later] == [
        frame.time_ns for frame in flight.frames[of_state + 1 : number + 1]
    ]
    return Start(found.state, of_state, seconds, reasons, initializer.attempt)


def assert_state_is_true(flight: Flight, result: Start) -> None:
    """Check the state against the truth, in units of the deviations that it has."""
    state, k = result.state, result.frame
    assert state is not None
    assert state.T_M_I[0, 4:].tolist() == [0.0, 0.0, 0.0]
    assert tilt_error_deg(state.T_M_I[0], flight.truth.T_G_I[k]) < 1.0
    velocity = body_velocity(state.T_M_I[0], state.v_M[0])
    truth = body_velocity(flight.truth.T_G_I[k], flight.truth.v_G[k])
    assert np.linalg.norm(velocity - truth) < 0.015 + 0.02 * np.linalg.norm(truth)
    assert np.linalg.norm(state.gyro_bias - flight.gyro_bias[k]) < 3e-3
    assert np.isfinite(state.sigma).all()
    assert (state.sigma > 0.0).all()
    tilt_deg = tilt_error_deg(state.T_M_I[0], flight.truth.T_G_I[k])
    assert tilt_deg < 3.5 * np.degrees(state.sigma[3:6].max())
    for error, sigma in (
        (state.gyro_bias - flight.gyro_bias[k], state.sigma[9:12]),
        (state.accel_bias - flight.accel_bias[k], state.sigma[12:15]),
    ):
        assert np.all(np.abs(error) < 4.0 * sigma)


@pytest.mark.parametrize("seed", [0, 2, 8])
def test_a_single_camera_in_motion_starts_within_four_seconds(seed: int) -> None:
    flight = fly(lively(seed, 4.2), seed=seed, points=1500)
    result = start(flight)
    assert result.seconds <= 4.0
    assert_state_is_true(flight, result)


@pytest.mark.slow
@pytest.mark.parametrize("cameras", [1, 2])
def test_scale_and_gravity_over_many_flights(cameras: int) -> None:
    """Two cameras start within 2 s, one within 4 s; gravity is right to 1 deg in most flights.

    A start is allowed from a standard deviation of 1.5 deg on: with a smaller limit MH_01 takes 3 to 7 s.
    """
    tilts_deg = []
    for seed in range(10):
        flight = fly(lively(seed, 4.2), seed=seed, cameras=cameras, points=1500)
        result = start(flight)
        assert result.state is not None
        assert result.seconds <= (2.0 if cameras == 2 else 4.0)
        tilts_deg.append(tilt_error_deg(result.state.T_M_I[0], flight.truth.T_G_I[result.frame]))
        assert result.attempt is not None
        refined = result.attempt.refined
        assert refined is not None
        times_ns = [frame.time_ns for frame in flight.frames]
        p_G = flight.truth.T_G_I[np.searchsorted(times_ns, refined.time_ns), 4:]
        p_M = refined.states.T_M_I[:, 4:]
        spread = [np.sum((p - p.mean(axis=0)) ** 2) for p in (p_M, p_G)]
        assert np.sqrt(spread[0] / spread[1]) == pytest.approx(1.0, abs=0.03)
    assert np.quantile(tilts_deg, 0.8) < 1.0
    assert max(tilts_deg) < InitializationOptions().max_tilt_sigma_deg


@pytest.mark.parametrize("noise_px", [0.05, 0.8])
@pytest.mark.parametrize("cameras", [1, 2])
def test_at_rest_it_starts_after_a_second(cameras: int, noise_px: float) -> None:
    flight = fly(resting(3, 1.5), seed=3, cameras=cameras, points=800, outlier_share=0.0)
    quiet = [with_pixels(frame, flight.frames[0], noise_px) for frame in flight.frames]
    result = start(dataclasses.replace(flight, frames=quiet))
    state = result.state
    assert state is not None
    assert result.seconds == pytest.approx(1.0, abs=0.06)
    assert state.v_M[0].tolist() == [0.0, 0.0, 0.0]
    truth = flight.truth.T_G_I[result.frame]
    tilt_deg = tilt_error_deg(state.T_M_I[0], truth)
    bias = flight.accel_bias[0]
    across = bias - so3.to_matrix(truth[:4])[2] * (so3.to_matrix(truth[:4])[2] @ bias)
    # what cannot be told apart: the part of the bias across gravity
    assert tilt_deg == pytest.approx(np.degrees(np.linalg.norm(across)) / 9.81, abs=0.1)
    assert tilt_deg < 3.0 * np.degrees(state.sigma[3])
    assert np.abs(state.gyro_bias - flight.gyro_bias[0]).max() < 3.0 * state.sigma[9]
    up = so3.rotate(so3.inverse(state.T_M_I[0, :4]), [0.0, 0.0, 1.0])
    assert state.accel_bias[0] @ up == pytest.approx(bias @ up, abs=0.02)


def test_a_slow_turn_does_not_become_bias_of_the_gyroscope() -> None:
    """A wide lens: 0.4 px in 0.1 s are 0.04 rad/s about the optical axis, and 1.5 cm/s."""
    flight = fly(creeping(3, 2.0, 0.015, 0.04), seed=3, points=800, focal_px=90.0)
    assert start(flight).state is None


@pytest.mark.parametrize("rate_radps", [0.0, 0.01])
def test_what_hardly_moves_starts_with_the_deviations_that_it_has(rate_radps: float) -> None:
    flight = fly(creeping(3, 1.6, rate_radps, rate_radps), seed=3, points=800, focal_px=90.0)
    result = start(flight)
    state = result.state
    assert state is not None
    errors = np.abs(state.gyro_bias - flight.gyro_bias[result.frame])
    assert errors.max() < 3.0 * state.sigma[9]
    assert np.linalg.norm(flight.truth.v_G[result.frame]) < 3.0 * state.sigma[6]
    assert state.sigma[9] < 0.008 + rate_radps


def test_motion_after_a_short_rest_does_not_pass_for_rest() -> None:
    flight = fly(lively(1, 2.2), seed=1, cameras=2, points=1500)
    result = start(flight)
    assert result.state is not None
    assert np.linalg.norm(result.state.v_M) > 0.1


def with_pixels(frame: WindowFrame, other: WindowFrame, noise_px: float = 0.05) -> WindowFrame:
    """Return a frame with the keypoints of another, slightly noisy as tracked ones at rest are."""
    rng = np.random.default_rng(frame.time_ns % 2**32)
    return dataclasses.replace(
        frame,
        camera=other.camera,
        track_id=other.track_id,
        uv_px=other.uv_px + noise_px * rng.standard_normal(other.uv_px.shape),
        sigma_px=other.sigma_px,
    )


def test_shaking_is_no_rest() -> None:
    """The image stands still, the accelerometer does not: a device in a vehicle."""
    flight = fly(
        resting(3, 1.5), seed=3, points=400, imu=ImuOptions(accel_noise_density=0.04)
    )  # 0.57 m/s^2 at 200 Hz
    quiet = [with_pixels(frame, flight.frames[0]) for frame in flight.frames]
    assert start(dataclasses.replace(flight, frames=quiet)).state is None


def test_a_single_camera_that_only_turns_is_refused() -> None:
    flight = fly(lively(2, 4.0, metres=0.0, turn_rad=0.4), seed=2, points=1500)
    result = start(flight)
    assert result.state is None
    assert any("sideways" in reason or "the scale is known" in reason for reason in result.reasons)


def test_two_cameras_that_only_turn_are_enough() -> None:
    flight = fly(lively(2, 2.5, metres=0.0, turn_rad=0.4), seed=2, cameras=2, points=1500)
    result = start(flight)
    assert result.state is not None
    assert np.linalg.norm(result.state.v_M) < 0.02
    assert tilt_error_deg(result.state.T_M_I[0], flight.truth.T_G_I[result.frame]) < 1.5


def test_constant_velocity_of_a_single_camera_has_no_scale() -> None:
    flight = fly(uniform(), seed=6, points=1500)
    result = start(flight)
    assert result.state is None
    assert "of speed and direction" in result.reasons[-1] or "the scale is" in result.reasons[-1]


def test_refused_attempts_become_rarer() -> None:
    flight = fly(lively(0, 9.0), seed=0, points=600)
    never = InitializationOptions(
        max_scale_sigma=1e-9, max_tilt_sigma_deg=1e-9, provisional_s=1e3, promising_s=1e3
    )
    initializer = Initializer(flight.device, never)
    attempts_s, last = [], None
    for frame in flight.frames:
        assert initializer.push(frame) is None
        if initializer.attempt is not last:
            last = initializer.attempt
            attempts_s.append((frame.time_ns - flight.frames[0].time_ns) * 1e-9)
    waits_s = np.diff(attempts_s)
    assert 1.5 <= attempts_s[0] <= 1.7
    assert waits_s.min() > 0.24
    assert np.median(waits_s) > 0.9


@pytest.mark.parametrize(("factor", "least", "most"), [(1.0, 1.0, 6.0), (12.0, 8.5, 16.0)])
def test_the_noise_of_the_imu_is_estimated_for_a_single_camera(
    factor: float, least: float, most: float
) -> None:
    """As multiples of the data sheet's: 4 (gyroscope) and 8 (accelerometer) are assumed at first."""
    sheet = fly(resting(0, 0.2), points=10).device.imu
    assert sheet is not None
    noisy = ImuOptions(
        gyro_bias_sigma=0.03,
        gyro_noise_density=0.5 * factor * sheet.gyro_noise_density,
        accel_noise_density=factor * sheet.acc_noise_density,
    )
    flight = fly(lively(2, 3.0), seed=2, points=1500, imu=noisy)
    attempt = attempt_with_all(flight)
    assert attempt.refined is not None
    assert least < attempt.refined.imu.acc_noise_density / sheet.acc_noise_density < most


def test_the_noise_of_the_imu_is_assumed_for_two_cameras() -> None:
    flight = fly(lively(2, 2.0), seed=2, cameras=2, points=800)
    attempt = attempt_with_all(flight)
    assert attempt.refined is not None
    options = InitializationOptions()
    assert attempt.refined.imu.acc_noise_density == options.least_accel_noise_density


def attempt_with_all(flight: Flight) -> Attempt:
    assert flight.device.imu is not None
    history = History(10.0)
    for frame in flight.frames:
        history.push(frame)
    device = flight.device
    solver = MotionStart(device.cameras, device.T_I_C, device.imu, InitializationOptions())
    return solver.solve(history.segment(solver.imu, 0.1))


def uniform():
    spline = lively(6, 4.0, metres=0.0, turn_rad=0.0)
    control = spline.control.copy()
    control[:, 4:] += 0.04 * np.arange(len(control))[:, None] * np.array([0.5, 0.8, 0.1])
    return dataclasses.replace(spline, control=control)


def test_no_tracks_are_refused_in_plain_words() -> None:
    flight = fly(lively(1, 3.0), points=10)
    result = start(flight)
    assert result.state is None
    assert result.reasons[0] == "no images yet"
    assert "of 1.5 s of images" in result.reasons[1]
    assert "too few points are seen in several images: give more light" in result.reasons[-1]


def test_images_that_do_not_fit_the_imu_are_refused() -> None:
    """The camera is turned on the IMU by 12 degrees more than the calibration says."""
    flight = fly(lively(0, 3.0), seed=0, cameras=2, points=1500)
    sensors, rig = flight.device.sensors, flight.device.rig
    T_B_C = rig.T_B_C.copy()
    T_B_C[:, :4] = so3.multiply(T_B_C[:, :4], so3.exp(np.array([0.0, 0.2, 0.1])))
    turned = dataclasses.replace(rig, T_B_C=T_B_C)
    wrong = dataclasses.replace(sensors, sensors={**sensors.sensors, rig.id: turned})
    device = RecordedSensors(wrong, rig.id, flight.device.imu_id)
    result = start(dataclasses.replace(flight, device=device))
    assert result.state is None


def test_a_gap_in_the_samples_starts_the_clock_again() -> None:
    flight = fly(lively(0, 3.2), seed=0, cameras=2, points=1500)
    frames = flight.frames[:20] + flight.frames[24:]
    result = start(dataclasses.replace(flight, frames=frames))
    assert result.state is not None
    since = (frames[result.frame].time_ns - frames[20].time_ns) * 1e-9
    assert since > 1.45
    assert since + result.seconds - (frames[result.frame].time_ns - frames[0].time_ns) * 1e-9 <= 2.0


def test_a_gap_ends_an_attempt_that_is_under_way() -> None:
    flight = fly(lively(0, 2.2), seed=0, cameras=2, points=1500)
    whole = start(flight)
    assert whole.state is not None
    assert whole.attempt is not None
    # the attempt begins with the frame of the state; the frame after it does not join on to it
    frames = flight.frames[: whole.frame + 1] + flight.frames[whole.frame + 2 :]
    result = start(dataclasses.replace(flight, frames=frames))
    assert result.state is None
    assert result.attempt is None


@pytest.mark.parametrize("cameras", [1, 2])
def test_an_attempt_is_spread_over_frames_and_finds_the_same_state(cameras: int) -> None:
    flight = fly(lively(0, 4.2), seed=0, cameras=cameras, points=1500)
    result = start(flight)
    assert result.state is not None
    last_s = (flight.frames[result.frame].time_ns - flight.frames[0].time_ns) * 1e-9
    assert 0.04 < result.seconds - last_s < 0.26
    history = History(InitializationOptions().longest_s + 1e-3)
    for frame in flight.frames[: result.frame + 1]:
        history.push(frame)
    options, device = InitializationOptions(), flight.device
    assert device.imu is not None
    most = options.most_keyframes if cameras == 2 else options.most_mono_keyframes
    solver = MotionStart(device.cameras, device.T_I_C, device.imu, options)
    interval_s = max(options.keyframe_interval_s, history.duration_s / (most - 1))
    at_once = solver.solve(history.segment(solver.imu, interval_s))
    assert at_once.state is not None
    for field in dataclasses.fields(StartState):
        assert (
            getattr(at_once.state, field.name).tobytes()
            == getattr(result.state, field.name).tobytes()
        )
