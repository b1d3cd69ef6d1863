"""Sensors that fail are found and left out; whole ones are not."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from maplab_py.estimation.window.frame import ImuPart
from maplab_py.frontend.failures.images import ImageWatch
from maplab_py.frontend.failures.motion import pose_by_rays
from maplab_py.frontend.failures.samples import SampleWatch
from maplab_py.frontend.failures.watch import replaced
from maplab_py.frontend.mapping import Mapping
from maplab_py.frontend.odometry_options import OdometryOptions
from maplab_py.frontend.run_options import RunOptions
from maplab_py.geometry import se3, so3
from maplab_py.interop.recordings.map_replay import MapRecording
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


@pytest.mark.parametrize("kind", ["constant", "at its limit", "whole", "resting"])
def test_signs_of_samples(kind: str) -> None:
    rng = np.random.default_rng(1)
    times_ns = np.arange(0, 4_000_000_000, 5_000_000)
    wave = np.sin(2e-9 * np.pi * times_ns[:, None] * np.linspace(0.3, 0.8, 6))
    samples = np.round(wave + rng.normal(0.0, 0.01, wave.shape), 3)  # quantised
    if kind == "constant":
        samples[400:, 4] = samples[400, 4]
    elif kind == "at its limit":
        samples[400:, 4] = np.minimum(samples[400:, 4], 0.6)
    elif kind == "resting":
        samples[400:] = samples[400]
    watch, told = SampleWatch(), set[str]()
    for rows in np.split(np.arange(len(times_ns)), 80):
        watch.push(times_ns[rows], samples[rows])
        told |= {words for words, _ in watch.signs.values()}
        assert set(watch.signs) <= {ImuPart.GYROSCOPE}
    said = {"y axis repeats one value, stuck or at a limit"}
    assert told == (said if kind in ("constant", "at its limit") else set())


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
    from maplab_py.frontend.failures.watch import SensorFailure

    failure = SensorFailure("camera 1", "covered", 5_000_000_000, 5_400_000_000)
    assert failure.words(0) == "camera 1 left out from 5.0 s on: covered"
    back = dataclasses.replace(failure, until_ns=8_000_000_000)
    assert back.words(10**9) == "camera 1 left out from 4.0 s to 7.0 s: covered"
    used = dataclasses.replace(failure, is_used=True)
    assert used.words(0) == "camera 1 used for want of another from 5.0 s on: covered"
