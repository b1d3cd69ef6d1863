"""Standing still, turning and moving are told apart."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from maplab_py.errors import FlagError
from maplab_py.estimation.window.frame import Motion
from maplab_py.frontend.imu_buffer import ImuInterval
from maplab_py.frontend.motion import MotionDetector
from maplab_py.frontend.odometry_options import RestOptions

STEP_NS = 5_000_000


def interval(frame: int, amplitude: float, frames_hz: float = 20.0) -> ImuInterval:
    """Return samples from one frame to the next with an oscillation along x."""
    length = round(1e9 / frames_hz)
    times_ns = np.arange(frame * length, (frame + 1) * length + 1, STEP_NS)
    accel_gyro = np.zeros((len(times_ns), 6))
    accel_gyro[:, 2] = 9.81
    accel_gyro[:, 0] = amplitude * np.sin(2 * np.pi * 10.0 * times_ns * 1e-9)
    return ImuInterval(times_ns, accel_gyro, STEP_NS, 0)


def last(
    detector: MotionDetector,
    *,
    disparity_px: float = 0.1,
    amplitude: float = 0.1,
    speed_mps: float = 0.02,
    turn_rate: float = 0.0,
    is_turn_only: bool = False,
    frames_hz: float = 20.0,
) -> Motion:
    """Return the class of the last interval of 0.6 s."""
    for frame in range(round(0.6 * frames_hz)):
        motion = detector.classify(
            interval(frame, amplitude, frames_hz),
            disparity_px,
            turn_rad=turn_rate / frames_hz,
            is_turn_only=is_turn_only,
            speed_mps=speed_mps,
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


def test_the_disparity_counts_per_tenth_of_a_second() -> None:
    assert last(MotionDetector(), disparity_px=0.45, frames_hz=10.0) is Motion.RESTING
    assert last(MotionDetector(), disparity_px=0.45, frames_hz=20.0) is Motion.MOVING


def test_rest_needs_half_a_second_of_samples() -> None:
    detector = MotionDetector()
    motions = [
        detector.classify(interval(frame, 0.1), 0.1, turn_rad=0.0, is_turn_only=True, speed_mps=0.0)
        for frame in range(12)
    ]
    assert motions[:8] == [Motion.TURNING] * 8
    assert motions[9:] == [Motion.RESTING] * 3
    assert detector.acceleration_deviation == pytest.approx(0.1 / np.sqrt(2), rel=0.05)
    detector.reset()
    assert np.isnan(detector.acceleration_deviation)


def test_turning_is_what_the_tracker_says() -> None:
    assert last(MotionDetector(), amplitude=1.0, is_turn_only=True) is Motion.TURNING
    assert last(MotionDetector(), is_turn_only=True) is Motion.RESTING


def test_motion_after_rest_is_noticed_at_once() -> None:
    detector = MotionDetector()
    assert last(detector) is Motion.RESTING
    moving = interval(12, 2.0)
    assert (
        detector.classify(moving, 0.1, turn_rad=0.0, is_turn_only=False, speed_mps=0.0)
        is Motion.MOVING
    )


@pytest.mark.parametrize("name", [field.name for field in dataclasses.fields(RestOptions)])
def test_wrong_options(name: str) -> None:
    with pytest.raises(FlagError, match=f"--vio_rest_{name}=-1"):
        MotionDetector(dataclasses.replace(RestOptions(), **{name: -1.0}))
