"""Recordings are read with what their check finds: units, axes, clock, mounting."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np

from maplab_py.algorithms.recording_check.doctor import diagnose, first_cause
from maplab_py.algorithms.recording_check.mending import mended
from maplab_py.frontend.checked_run import run_checked
from maplab_py.frontend.finishing import finish
from maplab_py.frontend.mapping import Mapping
from maplab_py.frontend.odometry_options import OdometryOptions
from maplab_py.frontend.run_options import RunOptions
from maplab_py.geometry import se3
from maplab_py.interop.recordings.map_replay import MapRecording
from maplab_py.interop.recordings.options import StreamOptions
from maplab_py.simulation.scenario import MotionOptions
from tests.algorithms.recording_check import faults
from tests.frontend.simulated import replayed

EYE, STREAM = np.eye(3), StreamOptions()
MOTION = (
    MotionOptions(kind="stationary", duration_s=2.0),
    MotionOptions(kind="room_scan", duration_s=8.0, turns=0.4, shake_m=0.03, shake_rad=0.06),
)


@functools.cache
def mission() -> MapRecording:
    return MapRecording(replayed(MOTION)[0], 0)


def test_units_axes_clock_and_mounting_are_mended_together() -> None:
    axes = faults.AXES["swap xy"]
    wrong = faults.with_imu(mission(), EYE / 9.81, np.degrees(axes))
    wrong = faults.with_rig(faults.with_clock(wrong, 0.02), turn_deg=(0.0, 6.0, 0.0))
    read = mended(wrong, diagnose(wrong), STREAM)
    assert read is not None
    assert first_cause(diagnose(read)) is None
    np.testing.assert_allclose(read.accel, 9.81 * EYE)
    np.testing.assert_allclose(read.gyro, np.radians(axes), atol=1e-12)
    off = np.abs(se3.local(mission().device.T_I_C, read.device.T_I_C))[:, 3:]
    assert np.degrees(off.max()) < 1.0
    assert "accelerations times 9.81, rates times 0.0174533, axes (y, x, z)" in read.notes[-1]
    assert "time offset 20" in read.notes[-1]


def test_a_sound_recording_and_a_hopeless_one_stay() -> None:
    for recording in (mission(), faults.with_clock(mission(), 3600.0)):
        assert mended(recording, diagnose(recording), STREAM) is None


def test_a_run_that_is_lost_is_mended_or_noted() -> None:
    wrong = faults.with_imu(mission(), EYE / 9.81, EYE)
    mapping = run_checked(Mapping, wrong)
    notes = finish(mapping, wrong.name).report.notes
    assert any(
        "does not work as it is; read with what check_recording finds: accelerations times 9.81"
        in note
        for note in notes
    )
    refusing = RunOptions(odometry=dataclasses.replace(OdometryOptions(), apply_calibration=False))
    lost = run_checked(lambda read: Mapping(read, refusing), wrong)
    assert lost.statistics.estimated_frames < 0.5 * lost.statistics.frames
    assert "unit of the accelerometer" in lost.statistics.notes[-1]
