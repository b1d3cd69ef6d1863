"""Standing still, turning and moving are told apart."""

import numpy as np
import pytest

from maplab_py.estimation.window.frame import Motion
from maplab_py.frontend.imu_buffer import ImuInterval
from maplab_py.frontend.motion import MotionDetector
from maplab_py.vision.tracking.tracks import CameraTracks, TrackedImages

STEP_NS = 5_000_000
FOCAL_PX = 460.0


def images(
    samples: ImuInterval, disparity_px: float, *, is_turn_only: bool = False
) -> TrackedImages:
    """Return what a tracker says that has too few tracks for comparisons over a longer time."""
    return TrackedImages(
        int(samples.times_ns[-1]), (CameraTracks.empty(),), disparity_px, is_turn_only, {}
    )


def interval(frame: int, amplitude: float, frames_hz: float = 20.0) -> ImuInterval:
    """Return samples from one frame to the next with an oscillation along x."""
    length = round(1e9 / frames_hz)
    times_ns = np.arange(frame * length, (frame + 1) * length + 1, STEP_NS)
    accel_gyro = np.zeros((len(times_ns), 6))
    accel_gyro[:, 2] = 9.81
    accel_gyro[:, 0] = amplitude * np.sin(2 * np.pi * 10.0 * times_ns * 1e-9)
    return ImuInterval(times_ns, accel_gyro, STEP_NS)


def last(
    detector: MotionDetector,
    *,
    disparity_px: float = 0.1,
    amplitude: float = 0.1,
    speed_mps: float = 0.02,
    turn_rate: float = 0.0,
    is_turn_only: bool = False,
    frames_hz: float = 20.0,
    visible_mps: float = np.inf,
) -> Motion:
    """Return the class of the last interval of 0.6 s."""
    for frame in range(round(0.6 * frames_hz)):
        samples = interval(frame, amplitude, frames_hz)
        motion = detector.classify(
            samples,
            images(samples, disparity_px, is_turn_only=is_turn_only),
            turn_rad=turn_rate / frames_hz,
            speed_mps=speed_mps,
            visible_mps=visible_mps,
        )
    return motion


def test_all_conditions_of_rest_are_needed() -> None:
    assert last(MotionDetector()) is Motion.RESTING
    assert last(MotionDetector(), disparity_px=0.26) is Motion.MOVING
    assert last(MotionDetector(), amplitude=0.5) is Motion.MOVING
    assert last(MotionDetector(), speed_mps=0.11) is Motion.MOVING
    assert last(MotionDetector(), turn_rate=0.009) is Motion.RESTING
    assert last(MotionDetector(), turn_rate=0.011) is Motion.MOVING
    assert last(MotionDetector(), turn_rate=0.5, is_turn_only=True) is Motion.TURNING
    assert last(MotionDetector(), disparity_px=float("nan")) is Motion.MOVING


def test_a_wrong_speed_does_not_keep_a_device_from_resting() -> None:
    """After a knock the estimate is wrong; images of near things show that there is no such speed."""
    visible_mps = MotionDetector().visible_mps(depth_m=3.0, focal_px=458.0)
    assert 0.1 < visible_mps < 0.2
    assert last(MotionDetector(), speed_mps=0.2, visible_mps=visible_mps) is Motion.RESTING
    far_mps = MotionDetector().visible_mps(depth_m=50.0, focal_px=458.0)
    assert last(MotionDetector(), speed_mps=0.2, visible_mps=far_mps) is Motion.MOVING
    assert MotionDetector().visible_mps(np.inf, 458.0) == np.inf


def test_the_disparity_counts_per_tenth_of_a_second() -> None:
    assert last(MotionDetector(), disparity_px=0.45, frames_hz=10.0) is Motion.RESTING
    assert last(MotionDetector(), disparity_px=0.45, frames_hz=20.0) is Motion.MOVING


def test_rest_needs_half_a_second_of_samples() -> None:
    detector = MotionDetector()
    motions = [
        detector.classify(
            samples, images(samples, 0.1, is_turn_only=True), turn_rad=0.0, speed_mps=0.0
        )
        for samples in (interval(frame, 0.1) for frame in range(12))
    ]
    assert motions[:8] == [Motion.TURNING] * 8
    assert motions[9:] == [Motion.RESTING] * 3
    assert detector.acceleration_deviation == pytest.approx(0.1 / np.sqrt(2), rel=0.05)
    detector.reset()
    assert np.isnan(detector.acceleration_deviation)


def test_motion_after_rest_is_noticed_at_once() -> None:
    detector = MotionDetector()
    assert last(detector) is Motion.RESTING
    moving = interval(12, 2.0)
    tracked = images(moving, 0.1)
    assert detector.classify(moving, tracked, turn_rad=0.0, speed_mps=0.0) is Motion.MOVING


def seen(
    position_m: np.ndarray, frames_hz: float, noise_px: float, tracks: int = 150, seed: int = 0
) -> list[Motion]:
    """Return the motions of a camera that looks sideways at points 2 to 6 m away.

    The accelerometer and the estimated speed do not show its motion: the tracks alone decide.

    Args:
        position_m: Along the image's x axis, of every frame.
        frames_hz: Frames per second.
        noise_px: Deviation of a keypoint's coordinates.
        tracks: Number of points.
        seed: Of their places and the noise.
    """
    rng, detector = np.random.default_rng(seed), MotionDetector()
    point = np.column_stack([rng.uniform(0, 752, tracks), rng.uniform(0, 480, tracks)])
    inverse_depth = 1.0 / rng.uniform(2.0, 6.0, tracks)
    ids, previous, motions = np.arange(tracks), None, []
    for frame, x in enumerate(position_m.tolist()):
        samples = interval(frame, 0.1, frames_hz)
        uv = point + noise_px * rng.standard_normal(point.shape)
        uv[:, 0] -= FOCAL_PX * x * inverse_depth
        moved = np.nan if previous is None else np.median(np.linalg.norm(uv - previous, axis=1))
        camera = CameraTracks(uv, ids, np.full(tracks, noise_px), ids * 1.0, ids)
        tracked = TrackedImages(int(samples.times_ns[-1]), (camera,), float(moved), False, {})
        motions.append(detector.classify(samples, tracked, turn_rad=0.0, speed_mps=0.0))
        previous = uv
    return motions


@pytest.mark.parametrize("frames_hz", [10.0, 20.0])
@pytest.mark.parametrize(("noise_px", "tracks"), [(0.15, 30), (0.8, 30), (0.8, 150)])
def test_rest_is_seen_through_the_noise_of_the_tracks(
    frames_hz: float, noise_px: float, tracks: int
) -> None:
    at_rest = np.zeros(round(20.0 * frames_hz))
    motions = seen(at_rest, frames_hz, noise_px, tracks)[round(frames_hz) :]
    share = sum(motion is Motion.RESTING for motion in motions) / len(motions)
    assert share > (0.95 if tracks == 150 or noise_px < 0.5 else 0.75)


@pytest.mark.parametrize("frames_hz", [10.0, 20.0])
@pytest.mark.parametrize("noise_px", [0.0, 0.15, 0.8])
@pytest.mark.parametrize("seed", range(3))
def test_constant_velocity_is_no_rest(frames_hz: float, noise_px: float, seed: int) -> None:
    moving = 0.2 * np.arange(round(10.0 * frames_hz)) / frames_hz
    assert Motion.RESTING not in seen(moving, frames_hz, noise_px, seed=seed)


@pytest.mark.parametrize("frames_hz", [10.0, 20.0])
@pytest.mark.parametrize("noise_px", [0.15, 0.8])
@pytest.mark.parametrize("acceleration_mps2", [0.05, 0.1, 0.2])
def test_a_slow_start_ends_the_rest(
    frames_hz: float, noise_px: float, acceleration_mps2: float
) -> None:
    """It ends before the body is faster than 7 cm/s, and within 2 cm of where it stood."""
    time_s = np.arange(round(5.0 * frames_hz)) / frames_hz - 2.0
    moving_s = np.maximum(time_s, 0.0)
    position_m = 0.5 * acceleration_mps2 * moving_s**2
    motions = seen(position_m, frames_hz, noise_px)
    last_rest = max(k for k, motion in enumerate(motions) if motion is Motion.RESTING)
    assert acceleration_mps2 * moving_s[last_rest] < 0.07
    assert position_m[last_rest] < 0.02


@pytest.mark.parametrize("noise_px", [0.0, 0.8])
def test_shaking_back_to_the_same_place_is_no_rest(noise_px: float) -> None:
    """A period of half a second brings every other comparison over half a second back to zero."""
    time_s = np.arange(100) / 20.0
    assert Motion.RESTING not in seen(0.05 * np.sin(4.0 * np.pi * time_s), 20.0, noise_px)
