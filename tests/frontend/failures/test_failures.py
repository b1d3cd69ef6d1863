"""Sensors that fail are found and left out; whole ones are not."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from maplab_py.estimation.window.calibration import WindowCalibration
from maplab_py.estimation.window.frame import ImuPart
from maplab_py.frontend.failures.images import ImageWatch
from maplab_py.frontend.failures.motion import pose_by_rays
from maplab_py.frontend.failures.samples import SampleWatch
from maplab_py.frontend.failures.watch import SensorFailure, SensorWatch, replace_failed, replaced
from maplab_py.frontend.imu_buffer import ImuInterval
from maplab_py.frontend.mapping import Mapping
from maplab_py.frontend.odometry_options import OdometryOptions
from maplab_py.frontend.recorded_mission import RecordedMission
from maplab_py.frontend.run_options import RunOptions
from maplab_py.geometry import se3, so3
from maplab_py.interop.recordings.map_replay import MapRecording
from maplab_py.sensors import Camera, Distortion, Imu, Projection
from maplab_py.vimap.nav_state import NavState
from tests.frontend.failing import blurred, covered, failing
from tests.frontend.known_start import KnownStart
from tests.frontend.simulated import REST_FIRST, position_errors, replayed

_FRAME_NS = 50_000_000


def _images(count: int, seed: int = 0) -> list[np.ndarray]:
    """Return images of blocks that move by a pixel, with noise."""
    rng = np.random.default_rng(seed)
    wide = np.kron(rng.integers(40, 200, (20, 60)), np.ones((12, 12))).astype(np.float64)
    return [
        np.clip(wide[:, k : k + 320] + rng.normal(0.0, 2.0, (240, 320)), 0, 255).astype(np.uint8)
        for k in range(count)
    ]


@pytest.mark.parametrize("sign", ["covered", "out of focus", "frozen", ""])
def test_signs_of_images_come_and_go(sign: str) -> None:
    watch, told = ImageWatch(), []
    frozen = _images(41)[-1]
    for k, image in enumerate(_images(120)):
        shown = image
        if 40 <= k < 80:
            edits = {"covered": covered, "out of focus": blurred, "frozen": lambda _: frozen}
            shown = edits[sign](image) if sign else image
        watch.push(k * _FRAME_NS, shown, is_moving=True)
        told.append(watch.sign)
    assert set(told[:40]) == {""}
    assert set(told[60:80]) == {sign}
    assert told[-1] == ""
    if sign:
        assert watch.since_ns in (40 * _FRAME_NS, 41 * _FRAME_NS)


def test_a_resting_camera_that_repeats_itself_is_not_frozen() -> None:
    watch = ImageWatch()
    for k in range(20):
        watch.push(k * _FRAME_NS, _images(1)[0], is_moving=False)
    assert watch.sign == ""


@pytest.mark.parametrize(
    "kind", ["constant", "at its limit", "at a lower limit", "whole", "resting"]
)
def test_signs_of_samples(kind: str) -> None:
    rng = np.random.default_rng(1)
    times_ns = np.arange(0, 4_000_000_000, 5_000_000)
    wave = np.sin(2e-9 * np.pi * times_ns[:, None] * np.linspace(0.3, 0.8, 6))
    samples = np.round(wave + rng.normal(0.0, 0.01, wave.shape), 3)  # quantised
    if kind == "constant":
        samples[400:, 4] = samples[400, 4]
    elif kind == "at its limit":
        samples[400:, 4] = np.minimum(samples[400:, 4], 0.6)
    elif kind == "at a lower limit":  # in short runs
        samples[:40, 4] *= 3.0
        samples[400:, 4] = np.minimum(samples[400:, 4], 0.95)
    elif kind == "resting":
        samples[400:] = samples[400]
    watch, told = SampleWatch(), set[str]()
    for rows in np.split(np.arange(len(times_ns)), 80):
        watch.push(times_ns[rows], samples[rows])
        told |= {words for words, _ in watch.signs.values()}
        assert set(watch.signs) <= {ImuPart.GYROSCOPE}
    said = {"y axis repeats one value, stuck or at a limit"}
    assert told == (said if kind not in ("whole", "resting") else set())


def test_a_pose_follows_from_rays_of_which_some_are_wrong() -> None:
    rng = np.random.default_rng(2)
    T_M_I = se3.make(so3.exp([0.1, -0.2, 0.3]), np.array([1.0, 2.0, 0.5]))
    p_I_C = rng.normal(0.0, 0.1, (80, 3))
    p_M = T_M_I[4:] + rng.normal(0.0, 3.0, (80, 3))
    ray_I = se3.transform(se3.inverse(T_M_I), p_M) - p_I_C
    ray_I /= np.linalg.norm(ray_I, axis=1, keepdims=True)
    ray_I[:15] = rng.normal(size=(15, 3))
    ray_I[:15] /= np.linalg.norm(ray_I[:15], axis=1, keepdims=True)
    start = se3.retract(T_M_I, np.array([0.01, -0.02, 0.01, 0.005, 0.004, -0.006]))
    np.testing.assert_allclose(pose_by_rays(p_M, ray_I, p_I_C, start)[4:], T_M_I[4:], atol=2e-3)


def test_samples_of_a_failed_part_are_those_of_the_states() -> None:
    q = np.stack([so3.identity(), so3.exp([0.0, 0.0, 0.1])])
    zeros = np.zeros((2, 3))
    ends = NavState(
        np.array([0, 100_000_000]), se3.make(q, zeros), np.array([[0.0, 0, 0], [0.2, 0, 0]]),
        zeros + 0.01, zeros,
    )  # fmt: skip
    both = ImuPart.GYROSCOPE | ImuPart.ACCELEROMETER
    samples = replaced(ends.time_ns, np.full((2, 6), 9.0), both, ends, 9.81)
    np.testing.assert_allclose(samples[:, 3:], [[0.01, 0.01, 1.01]] * 2)
    np.testing.assert_allclose(np.linalg.norm(samples[:, :3], axis=1), np.hypot(2.0, 9.81))
    only = replaced(ends.time_ns, np.full((2, 6), 9.0), ImuPart.GYROSCOPE, ends, 9.81)
    assert (only[:, :3] == 9.0).all()


_IMU = Imu("1" * 32, gravity_magnitude_mps2=9.81)
_CAMERA = Camera(
    "2" * 32, Projection.PINHOLE, Distortion.NONE, np.array([200.0, 200, 160, 120]), np.zeros(0), 320, 240
)  # fmt: skip


def _interval(frame: int, accel_gyro: np.ndarray) -> ImuInterval:
    times_ns = np.linspace((frame - 1) * _FRAME_NS, frame * _FRAME_NS, len(accel_gyro))
    return ImuInterval(times_ns.astype(np.int64), accel_gyro, _FRAME_NS // 10)


def _resting(rng: np.random.Generator) -> np.ndarray:
    """Return samples (11, 6) of an IMU at rest."""
    return np.array([0.0, 0, 9.81, 0, 0, 0]) + rng.normal(0.0, 1e-3, (11, 6))


def _window(gyro_bias: float = 0.0, camera: Camera = _CAMERA) -> Any:
    """Return a window of two frames at rest, with a bias about z, for one or two cameras."""
    calibration = WindowCalibration.of((camera,) * 2, se3.identity(2))
    rng = np.random.default_rng(3)
    p_M, motion = rng.uniform([-2, -1, 4], [2, 1, 8], (60, 3)), np.zeros((2, 9))
    motion[:, 5] = gyro_bias
    return SimpleNamespace(
        states=SimpleNamespace(T_M_I=se3.identity(2), motion=motion), doubt_imu=lambda *_: None,
        times_ns=np.array([0, _FRAME_NS]), landmarks=lambda: (np.arange(60), p_M),
        calibration=calibration, cameras=calibration.of_kernels(calibration.mean),
    )  # fmt: skip


def _watch(cameras: int = 1) -> SensorWatch:
    device: Any = SimpleNamespace(cameras=(_CAMERA,) * cameras, T_I_C=se3.identity(cameras))
    return SensorWatch(device, _IMU)


def _frame(cameras: int = 1) -> Any:
    """Return a frame in which each camera sees the landmarks of the window."""
    p_M = _window().landmarks()[1]
    uv_px = 200.0 * p_M[:, :2] / p_M[:, 2:] + [160.0, 120.0]
    return SimpleNamespace(
        camera=np.repeat(np.arange(cameras), 60), track_id=np.tile(np.arange(60), cameras),
        uv_px=np.tile(uv_px, (cameras, 1)), delay_s=0.0,
    )  # fmt: skip


@pytest.mark.parametrize("kind", ["camera 1", "gyroscope", "gyroscope at the limit"])
def test_a_shifted_camera_is_told_from_a_wrong_gyroscope(kind: str) -> None:
    rng, watch, frame, window = np.random.default_rng(6), _watch(2), _frame(2), _window()
    for row in range(1, 100):
        samples = _resting(rng)
        if row == 81 and kind == "camera 1":
            frame.uv_px[60:] += [7.0, 0.0]  # 2 deg
        if row > 80 and kind.startswith("gyroscope"):
            samples[:, 5] += 0.05 if kind == "gyroscope" else 0.032
        if row > 80 and kind.endswith("limit"):  # for camera 1 it is just below
            turned_rad = 1e-9 * _FRAME_NS * 3e-3
            x, y = (frame.uv_px - [160.0, 120.0]).T
            is_other = np.arange(120)[:, None] >= 60
            frame.uv_px = frame.uv_px - turned_rad * is_other * np.column_stack([-y, x])
        frame.time_ns = row * _FRAME_NS
        watch.usable(_interval(row, samples), window)
        watch.compare(frame, _interval(row, samples), window)
    assert [failure.sensor for failure in watch.failures] == [kind.removesuffix(" at the limit")]
    assert watch.left_out == (frozenset([1]) if kind == "camera 1" else frozenset())


@pytest.mark.parametrize("noise_px", [0.0, 0.5])
def test_points_that_scatter_accuse_no_gyroscope(noise_px: float) -> None:
    rng, watch, frame, window = np.random.default_rng(6), _watch(), _frame(), _window()
    first_px = frame.uv_px[:24].copy()
    for row in range(1, 100):
        samples = _resting(rng)
        if row > 80:  # the last points of a view turn about the optical axis, on their own
            turned_rad = 1e-9 * _FRAME_NS * (row - 80) * 0.04
            x, y = (first_px - [160.0, 120.0]).T
            frame.uv_px = first_px + turned_rad * np.column_stack([-y, x])
            frame.uv_px += rng.normal(0.0, noise_px, frame.uv_px.shape)
            frame.camera, frame.track_id = frame.camera[:24], frame.track_id[:24]
        frame.time_ns = row * _FRAME_NS
        watch.usable(_interval(row, samples), window)
        watch.compare(frame, _interval(row, samples), window)
    assert [failure.sensor for failure in watch.failures] == (["gyroscope"] if not noise_px else [])


@pytest.mark.parametrize("is_known", [True, False])
def test_a_rolling_shutter_that_is_known_contradicts_no_sample(*, is_known: bool) -> None:
    rolling = dataclasses.replace(_CAMERA, line_delay_ns=60_000, image_delay_s=-0.0072)
    rng, watch, frame = np.random.default_rng(5), _watch(), _frame()
    largest = 0.0
    window = _window(camera=rolling if is_known else _CAMERA)
    p_M = window.landmarks()[1]

    def angle(time_s: Any) -> Any:
        return 0.2 * np.sin(10.0 * np.maximum(time_s - 3.0, 0.0))  # about y

    def turn(time_s: Any) -> np.ndarray:
        return so3.exp(np.multiply.outer(angle(time_s), [0.0, 1.0, 0.0]))

    for row in range(1, 120):
        time_s = 1e-9 * row * _FRAME_NS
        samples, sample_s = _resting(rng), np.linspace(time_s - 0.05, time_s, 11)
        samples[:, :3] += so3.rotate(so3.inverse(turn(sample_s)), np.array([0.0, 0, 9.81])) - [
            0,
            0,
            9.81,
        ]
        samples[:, 4] += (angle(sample_s + 1e-5) - angle(sample_s - 1e-5)) / 2e-5
        for _ in range(4):  # the row of a point tells when it is seen, and that where
            late_s = rolling.image_delay_s + 60e-6 * frame.uv_px[:, 1]
            p_C = so3.rotate(so3.inverse(turn(time_s + late_s)), p_M)
            frame.uv_px = 200.0 * p_C[:, :2] / p_C[:, 2:] + [160.0, 120.0]
        frame.time_ns = row * _FRAME_NS
        window.states.T_M_I[-1, :4] = turn(time_s)
        watch.usable(_interval(row, samples), window)
        watch.compare(frame, _interval(row, samples), window)
        compared = watch._comparison.compared(frozenset([0]))
        largest = largest if compared is None else max(largest, np.linalg.norm(compared.rate))
    assert (largest > 0.03) != is_known
    assert not watch.failures  # the points scatter, too, where it is not known


def test_a_gyroscope_with_another_bias_comes_back_and_stays() -> None:
    rng, watch, frame = np.random.default_rng(4), _watch(), _frame()
    for row in range(1, 200):
        samples = _resting(rng)
        samples[:, 5] += 0.1 if row > 80 else 0.0
        # the window knows the bias as soon as the samples count again
        frame.time_ns = row * _FRAME_NS
        has_returned = bool(watch.failures) and not watch.failed
        window = _window(0.1 if has_returned else 0.0)
        interval, _ = watch.usable(_interval(row, samples), window)
        assert bool(watch.failed) == (interval.accel_gyro[5, 5] != samples[5, 5])
        watch.compare(frame, _interval(row, samples), window)
    (failure,) = watch.failures
    assert failure.sensor == "gyroscope"
    assert failure.since_ns <= 80 * _FRAME_NS < failure.detected_ns < 100 * _FRAME_NS
    assert failure.until_ns < 140 * _FRAME_NS
    assert watch.notes(0)[0].endswith("the motion of the images; used with another bias since")


def test_a_restart_ends_failures_of_the_imu() -> None:
    rng, watch = np.random.default_rng(5), _watch()
    for row in range(1, 40):
        samples = _resting(rng)
        if row >= 20:
            samples[:, 4] = 0.05
        used, failed = watch.usable(_interval(row, samples), _window())
    assert failed == ImuPart.GYROSCOPE
    np.testing.assert_allclose(used.accel_gyro[:, 3:], 0.0, atol=1e-12)
    assert watch.status().startswith("gyroscope left out: y axis repeats")
    watch.restart(40 * _FRAME_NS)
    assert watch.failures[0].until_ns == 40 * _FRAME_NS
    assert not watch.failed_between(41 * _FRAME_NS, 50 * _FRAME_NS)


@pytest.mark.parametrize("has_new_bias", [True, False])
def test_biases_of_a_map_go_on_after_a_failure(*, has_new_bias: bool) -> None:
    mission, watch = RecordedMission(), _watch()
    watch.failures.append(
        SensorFailure("gyroscope", "biased", 25, 28, until_ns=40, has_new_bias=has_new_bias)
    )
    for row in range(
        8
    ):  # edges 2 and 3 have failed; from vertex 4 on the bias is known to be another
        bias = np.array([0.0, 0.0, 0.01 if row < 3 else 0.05 if row < 4 else 0.11])
        state = NavState.single(10 * row, se3.identity(), np.zeros(3), bias, np.full(3, 0.2 + row))
        rate = 0.01 if row < 3 else 0.11
        samples = np.array([[0.0, 0, 9.81, 0, 0, rate]] * 2)
        if row:
            mission.add_imu(np.array([10 * row - 10, 10 * row]), samples)
        mission.add_vertex(state, (), ())
    replace_failed(mission, watch, 9.81)
    gyro_bias = [state.gyro_bias[0, 2] for state in mission.states]
    after = 0.01 if has_new_bias else 0.11
    np.testing.assert_allclose(gyro_bias, [0.01] * 5 + [after] * 3)
    rates = [samples[:, 5].mean() for _, samples in mission.edges]
    np.testing.assert_allclose(rates, [0.01] * 4 + [after] * 3)  # the device rests
    accel_bias = [state.accel_bias[0, 0] for state in mission.states]
    np.testing.assert_array_equal(accel_bias, 0.2 + np.arange(8))


@pytest.mark.parametrize("kind", ["", "gyroscope biased", "accelerometer biased"])
def test_an_imu_that_fails_does_not_bend_the_map(kind: str) -> None:
    vi_map, truth = replayed(REST_FIRST)
    recording, from_ns = MapRecording(vi_map, 0), int(truth.times_ns[0]) + 5_000_000_000
    used = failing(recording, kind, from_ns) if kind else recording
    options = RunOptions(odometry=OdometryOptions(estimate="none"))
    start = KnownStart(truth, with_biases=True)
    mapping = Mapping(used, options, make_starter=start)  # type: ignore[arg-type]
    mapping.run()
    failures = mapping.odometry.watch.failures
    assert [f.sensor for f in failures[:1]] == ([kind.split(maxsplit=1)[0]] if kind else [])
    trajectory = mapping.trajectory()
    errors = position_errors(truth, trajectory.times_ns, trajectory.T_R_B)
    assert errors[-10:].max() < 0.03  # also where it was wrong until the failure was found
    if not kind:
        return
    assert 0 < failures[0].detected_ns - from_ns < 3_000_000_000
    assert "it differs by" in failures[0].words(0)
    assert mapping.builder is not None
    samples = mapping.builder.make_map().imu_samples
    after = samples.timestamp_ns > failures[0].detected_ns + 200_000_000
    after &= samples.timestamp_ns < (failures[0].until_ns or truth.times_ns[-1])
    column, offset = (5, 0.1) if "gyro" in kind else (2, 0.6)
    given = np.interp(
        samples.timestamp_ns[after], vi_map.imu_samples.timestamp_ns,
        vi_map.imu_samples.accel_gyro[:, column],
    )  # fmt: skip
    mean = float(np.mean(samples.accel_gyro[after, column] - given))
    assert abs(mean) < 0.5 * offset  # the map does not have the failing samples


def test_the_notes_tell_it() -> None:
    failure = SensorFailure("camera 1", "covered", 5_000_000_000, 5_400_000_000)
    assert failure.words(0) == "camera 1 left out from 5.0 s on: covered"
    back = dataclasses.replace(failure, until_ns=8_000_000_000)
    assert back.words(10**9) == "camera 1 left out from 4.0 s to 7.0 s: covered"
    used = dataclasses.replace(failure, is_used=True)
    assert used.words(0) == "camera 1 used for want of another from 5.0 s on: covered"


def test_many_failures_are_counted() -> None:
    watch = _watch()
    watch.failures += [SensorFailure("gyroscope", "stuck", k, k, k + 1) for k in range(50)]
    assert watch.notes(0)[-1] == "sensors were left out 42 more times"
    assert len(watch.notes(0)) == 9
