"""The doctor names planted faults of a simulated mission first, and finds nothing in a sound one."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

import numpy as np
import pytest

from maplab_py.algorithms.recording_check.correction import correct
from maplab_py.algorithms.recording_check.doctor import (
    check_first_seconds,
    check_map,
    diagnose,
    explain_refusal,
    first_cause,
    report,
)
from maplab_py.algorithms.recording_check.findings import Verdict
from maplab_py.errors import UserError
from maplab_py.interop.recordings.map_replay import MapRecording
from maplab_py.interop.recordings.options import StreamOptions
from maplab_py.interop.recordings.protocol import Recording
from maplab_py.simulation.scenario import MotionOptions
from tests.algorithms.recording_check import faults
from tests.frontend.simulated import replayed

EYE = np.eye(3)
MOTION = (
    MotionOptions(kind="stationary", duration_s=2.0),
    MotionOptions(kind="room_scan", duration_s=8.0, turns=0.4, shake_m=0.03, shake_rad=0.06),
)
MIRRORED = "axes of the gyroscope"
MOUNTING = "rotation of the extrinsics"
FAULTS: dict[str, tuple[Callable[[Recording], Recording], str, str]] = {
    "gyroscope in deg/s": (
        lambda r: faults.with_imu(r, EYE, np.degrees(EYE)),
        "unit of the gyroscope",
        "0.01745329",
    ),
    "accelerometer in g": (
        lambda r: faults.with_imu(r, EYE / 9.81, EYE),
        "unit of the accelerometer",
        "9.81",
    ),
    "accelerometer in mm/s^2": (
        lambda r: faults.with_imu(r, 1000.0 * EYE, EYE),
        "unit of the accelerometer",
        "0.001",
    ),
    "linear acceleration": (
        lambda r: faults.with_imu(r, 0.01 * EYE, EYE),
        "unit of the accelerometer",
        "gravity was removed",
    ),
    "gyroscope swapped": (
        lambda r: faults.with_imu(r, EYE, faults.AXES["swap xy"]), MIRRORED, "(y, x, z)"
    ),
    "gyroscope flipped": (
        lambda r: faults.with_imu(r, EYE, faults.AXES["flip z"]), MIRRORED, "(x, y, -z)"
    ),
    "accelerometer turned": (
        lambda r: faults.with_imu(r, faults.AXES["turn x"], EYE),
        "axes of the accelerometer",
        "(x, -z, y)",
    ),
    "clock of 30 ms": (lambda r: faults.with_clock(r, 0.03), "time offset", "30."),
    "clock of an hour": (lambda r: faults.with_clock(r, 3600.0), "IMU and images", "--time_unit"),
    "camera turned": (
        lambda r: faults.with_rig(r, turn_deg=(0.0, 10.0, 0.0)), MOUNTING, "camera 0"
    ),
    "second camera turned": (
        lambda r: faults.with_rig(r, turn_deg=(0.0, 10.0, 0.0), rows=(1,)), MOUNTING, "camera 1"
    ),
    "scale": (lambda r: faults.with_imu(r, EYE, 1.1 * EYE), "scale of the gyroscope", "T_g"),
    "noise too large": (
        lambda r: faults.with_noise_figures(r, 20.0, 1.0), "noise of the accelerometer", "too large"
    ),
    "noise too small": (
        lambda r: faults.with_noise_figures(r, 1.0, 0.1), "noise of the gyroscope", "too small"
    ),
}  # fmt: skip


@functools.cache
def mission() -> MapRecording:
    return MapRecording(replayed(MOTION)[0], 0)


@pytest.mark.parametrize("name", FAULTS)
def test_a_planted_fault_is_named_first_with_its_remedy(name: str):
    plant, check, word = FAULTS[name]
    first = first_cause(diagnose(plant(mission())))
    assert first is not None
    assert first.check.startswith(check)
    assert word in first.line


def test_nothing_is_wrong_with_a_sound_mission():
    diagnosis = diagnose(mission())
    assert [f for f in diagnosis.findings if f.verdict in (Verdict.WRONG, Verdict.HOPELESS)] == []
    checked = report(diagnosis, mission())
    assert not checked.failure
    assert "rovioli" in checked.advice
    assert len({finding.check for finding in checked.findings}) == len(checked.findings)


def test_a_corrected_calibration_passes_the_check():
    wrong = faults.with_rig(faults.with_clock(mission(), 0.02), turn_deg=(0.0, 8.0, 0.0))
    diagnosis = diagnose(wrong)
    corrected = correct(diagnosis)
    assert any("time offset 20" in note for note in corrected.notes)
    offset_ns = corrected.device.cameras[0].time_offset_ns
    mended = dataclasses.replace(
        wrong, device=corrected.device, imu_shift_ns=wrong.imu_shift_ns - offset_ns
    )
    assert first_cause(diagnose(mended)) is None


def test_units_are_told_but_not_put_into_the_calibration():
    device = mission().device
    corrected = correct(diagnose(faults.with_imu(mission(), EYE, np.degrees(EYE))))
    assert "not of the calibration: unit of the gyroscope" in corrected.notes[0]
    np.testing.assert_array_equal(corrected.device.T_I_C, device.T_I_C)
    assert correct(diagnose(mission())).notes == ("nothing to correct",)


def test_the_first_seconds_are_refused_noted_or_passed():
    stream = StreamOptions()
    assert check_first_seconds(mission(), stream) == ()
    with pytest.raises(UserError, match=r"no time in common.*--time_unit"):
        check_first_seconds(faults.with_clock(mission(), 3600.0), stream)
    lines = check_first_seconds(faults.with_imu(mission(), EYE / 9.81, EYE), stream)
    assert len(lines) == 1
    assert "unit of the accelerometer" in lines[0]


def test_a_refused_start_is_explained_by_its_cause():
    assert explain_refusal(diagnose(mission()), "walk", "move more") == "move more"
    assert explain_refusal(None, "walk", "move more") == "move more"
    wrong = diagnose(faults.with_imu(mission(), EYE, np.degrees(EYE)))
    reason = explain_refusal(wrong, "walk", "move more")
    assert "walk: the odometry has not started: unit of the gyroscope" in reason


def test_a_map_tells_what_contradicts_its_calibration():
    vi_map, device = replayed(MOTION)[0], mission().device
    assert check_map(vi_map) == ()
    turned = faults.with_rig(mission(), turn_deg=(0.0, 8.0, 0.0)).device
    (line,) = check_map(vi_map.replace(sensors=turned.sensors))
    assert line.startswith("this recording shows: rotation of the extrinsics")
    assert "--vio_estimate=extrinsics" in line
    alone = dataclasses.replace(device.sensors, sensors={device.rig_id: device.rig})
    assert check_map(vi_map.replace(sensors=alone)) == ()


def test_a_recording_without_imu_cannot_work():
    plain = mission()
    none = dataclasses.replace(faults.sound(plain), edit_imu=lambda values: 0.0 * values)
    first = first_cause(diagnose(none))
    assert first is not None
    assert first.verdict is Verdict.HOPELESS
    assert "--imu_topic" in first.remedy
