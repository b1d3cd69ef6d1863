"""Each check alone on made signals, the doctor on planted faults, and recordings that are mended."""

import dataclasses
import functools
from collections.abc import Callable

import cv2
import numpy as np
import pytest

from maplab_py.algorithms.recording_check import doctor
from maplab_py.algorithms.recording_check.correction import correct
from maplab_py.algorithms.recording_check.findings import Finding, Verdict, cause
from maplab_py.algorithms.recording_check.image_checks import check_images
from maplab_py.algorithms.recording_check.image_samples import CameraSampler, PointPairs
from maplab_py.algorithms.recording_check.inertial import allan_densities, quiet_figures
from maplab_py.algorithms.recording_check.mending import mended
from maplab_py.algorithms.recording_check.signals import CameraSignal, ImuSignal, Signals
from maplab_py.algorithms.recording_check.stereo import fit_stereo
from maplab_py.algorithms.recording_check.timing_checks import check_times
from maplab_py.errors import UserError
from maplab_py.frontend.checked_run import run_checked
from maplab_py.frontend.finishing import finish
from maplab_py.frontend.mapping import Mapping
from maplab_py.frontend.odometry_options import OdometryOptions
from maplab_py.frontend.run_options import RunOptions
from maplab_py.geometry import se3, so3
from maplab_py.interop.device import RecordedSensors, make_device
from maplab_py.interop.recordings import map_replay, protocol
from maplab_py.interop.recordings.options import StreamOptions
from maplab_py.sensors import Camera, Distortion, Imu, Projection
from maplab_py.sensors.projection import project
from maplab_py.simulation.scenario import MotionOptions
from tests.algorithms.recording_check import faults
from tests.algorithms.recording_check.faults import focal
from tests.frontend.simulated import replayed

CAMERA = Camera(
    "0" * 32, Projection.PINHOLE, Distortion.NONE, np.array([200.0, 200.0, 160.0, 120.0]),
    np.zeros(0), 320, 240,
)  # fmt: skip
T_1_2 = np.concatenate([so3.exp([0.01, -0.02, 0.03]), [0.1, 0.0, 0.01]])
SECOND_NS = 1_000_000_000


def device(cameras: int = 1) -> RecordedSensors:
    return make_device([CAMERA] * cameras, np.tile(se3.identity(), (cameras, 1)), Imu(""))


def signals(
    imu_s: tuple[float, float, float] = (0.0, 10.0, 200.0),
    images_s: tuple[float, float, float] = (0.0, 10.0, 20.0),
    **more: object,
) -> Signals:
    """Return signals of a device at rest: begin, end and rate of samples and of images."""
    times_ns, image_ns = (
        np.round(np.arange(begin, end, 1.0 / rate) * 1e9).astype(np.int64)
        for begin, end, rate in (imu_s, images_s)
    )
    values = np.tile([0.0, 0.0, 9.81, 0.0, 0.0, 0.0], (len(times_ns), 1))
    imu = ImuSignal(times_ns, values, np.zeros(len(times_ns), dtype=np.bool_))
    camera = CameraSignal(image_ns, (), PointPairs.stack([]), 0, 0)
    made = Signals(device(), 0, imu, (camera,), ())
    return dataclasses.replace(made, **more)  # type: ignore[arg-type]


def grave(findings: list[Finding]) -> dict[str, Verdict]:
    return {f.check: f.verdict for f in findings if f.verdict not in (Verdict.OK, Verdict.UNKNOWN)}


TIMES: dict[str, tuple[Signals, dict[str, Verdict]]] = {
    "sound": (signals(), {}),
    "no samples": (signals(imu_s=(0.0, 0.0, 1.0)), {"IMU and images": Verdict.HOPELESS}),
    "no images": (signals(images_s=(0.0, 0.0, 1.0)), {"IMU and images": Verdict.HOPELESS}),
    "no overlap": (signals(imu_s=(60.0, 70.0, 200.0)), {"IMU and images": Verdict.HOPELESS}),
    "half covered": (signals(imu_s=(0.0, 5.0, 200.0)), {"IMU and images": Verdict.WRONG}),
    "slow IMU": (signals(imu_s=(0.0, 10.0, 50.0)), {"rate of the IMU": Verdict.NOTE}),
    "gaps": (
        signals(imu_s=(0.0, 10.0, 8.0)),
        {"rate of the IMU": Verdict.NOTE, "gaps of the IMU": Verdict.WRONG},
    ),
    "slow images": (signals(images_s=(0.0, 10.0, 3.0)), {"rate of camera 0": Verdict.NOTE}),
    "restart": (signals(restart="again"), {"clock": Verdict.WRONG}),
}


@pytest.mark.parametrize("name", TIMES)
def test_times(name: str):
    recorded, expected = TIMES[name]
    assert grave(list(check_times(recorded, StreamOptions(), is_whole=True))) == expected


def test_images_without_partners():
    alone = CameraSignal(
        np.arange(0, 10 * SECOND_NS, SECOND_NS // 20) + 9_000_000, (), PointPairs.stack([]), 200, 0
    )
    first = dataclasses.replace(alone, times_ns=alone.times_ns - 9_000_000)
    both = signals(device=device(2), cameras=(first, alone))
    findings = list(check_times(both, StreamOptions(), is_whole=True))
    assert grave(findings) == {"partners of images": Verdict.WRONG}
    assert "9 ms away" in findings[-1].observed


def picture(count: int) -> np.ndarray:
    """Return a picture (240, 320) of squares that moves by a pixel with every count."""
    grey = np.random.default_rng(0).integers(90, 200, (12, 16), dtype=np.uint8)
    square = np.zeros((20, 20), dtype=np.uint8)
    square[5:14, 5:14] = 1
    image = np.maximum(np.kron(grey, square), 60).astype(np.uint8)
    return np.asarray(cv2.GaussianBlur(np.roll(image, count, axis=1), (0, 0), 0.8), dtype=np.uint8)


def blurred(image: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 2.0), dtype=np.uint8)


IMAGES: dict[str, tuple[Callable[[int], np.ndarray], dict[str, Verdict]]] = {
    "sound": (picture, {}),
    "frozen": (lambda count: picture(0), {"change of camera 0": Verdict.HOPELESS}),
    "repeated": (lambda count: picture(count // 2), {"change of camera 0": Verdict.WRONG}),
    "dark": (
        lambda count: picture(count) // 12,
        {"light of camera 0": Verdict.WRONG, "texture of camera 0": Verdict.WRONG},
    ),
    "bright": (
        lambda count: np.where(picture(count) < 110, 255, picture(count)).astype(np.uint8),
        {"light of camera 0": Verdict.WRONG},
    ),
    "bare": (
        lambda count: np.full((240, 320), 100 + count, dtype=np.uint8),
        {"texture of camera 0": Verdict.WRONG},
    ),
    "blurred": (
        lambda count: blurred(picture(count)),
        {"sharpness of camera 0": Verdict.NOTE},
    ),
}


@pytest.mark.parametrize("name", IMAGES)
def test_images(name: str):
    make, expected = IMAGES[name]
    sampler = CameraSampler(CAMERA, 0)
    for count in range(20):
        sampler.add(round(0.1 * count * SECOND_NS), make(count))
    turning = signals()
    turning.imu.accel_gyro[:, 3] = np.where(np.arange(len(turning.imu)) % 100 < 50, 0.5, -0.5)
    camera = dataclasses.replace(turning.cameras[0], figures=tuple(sampler.figures))
    assert grave(list(check_images(dataclasses.replace(turning, cameras=(camera,))))) == expected


def test_a_device_that_rests_may_show_the_same_image_again():
    sampler = CameraSampler(CAMERA, 0)
    for count in range(20):
        sampler.add(round(0.1 * count * SECOND_NS), picture(0))
    at_rest = signals()
    camera = dataclasses.replace(at_rest.cameras[0], figures=tuple(sampler.figures))
    assert not grave(list(check_images(dataclasses.replace(at_rest, cameras=(camera,)))))


def test_noise_densities_of_white_noise():
    rng, density = np.random.default_rng(1), np.array([0.01] * 3 + [1e-3] * 3)
    samples = density * np.sqrt(200.0) * rng.standard_normal((30, 200, 6))
    median = np.median(allan_densities(samples, 1.0 / 200.0), axis=0)
    np.testing.assert_allclose(median, [0.01, 1e-3], rtol=0.3)


def test_rest_is_told_from_motion_in_any_unit():
    times_ns = np.arange(0, 10 * SECOND_NS, SECOND_NS // 200)
    rest = np.tile([0.0, 0.0, 1.0, 0.0, 0.0, 0.0], (len(times_ns), 1))
    quiet = quiet_figures(times_ns, rest)
    assert quiet is not None
    assert quiet.is_at_rest
    moving = rest + 0.3 * np.sin(times_ns * 2e-8)[:, None]
    quiet = quiet_figures(times_ns, moving)
    assert quiet is not None
    assert not quiet.is_at_rest
    assert quiet_figures(times_ns[:5], rest[:5]) is None


def seen_by_both(first: Camera, second: Camera) -> np.ndarray:
    """Return points (M, 2, 2) that both cameras see, with noise of a fifth of a pixel."""
    rng = np.random.default_rng(2)
    p_1 = rng.uniform([-3.0, -2.0, 2.0], [3.0, 2.0, 8.0], (600, 3))
    p_2 = so3.rotate(so3.inverse(T_1_2[:4]), p_1 - T_1_2[4:])
    (uv_1, is_in_1), (uv_2, is_in_2) = project(first, p_1), project(second, p_2)
    uv = np.stack([uv_1, uv_2], axis=1)[is_in_1 & is_in_2]
    return uv + 0.2 * rng.standard_normal(uv.shape)


def test_stereo_tells_sound_turned_swapped_and_unlike_cameras():
    uv = seen_by_both(CAMERA, CAMERA)
    sound = fit_stereo(uv, (CAMERA, CAMERA), T_1_2)
    assert sound is not None
    assert sound.as_is < 0.3
    turned = fit_stereo(
        uv, (CAMERA, CAMERA), se3.compose(T_1_2, np.append(so3.exp([0.05, 0.0, 0.0]), [0, 0, 0]))
    )
    assert turned is not None
    assert turned.as_is > 3.0
    assert turned.moved < 0.3
    assert turned.turn_deg == pytest.approx(np.degrees(0.05), abs=0.2)
    swapped = fit_stereo(uv[:, ::-1], (CAMERA, CAMERA), T_1_2)
    assert swapped is not None
    assert swapped.swapped < 0.3 < swapped.as_is
    unlike = fit_stereo(uv, (CAMERA, focal(1.1)(CAMERA)), T_1_2)
    assert unlike is not None
    assert unlike.moved > 0.7
    assert fit_stereo(uv[:20], (CAMERA, CAMERA), T_1_2) is None


def test_the_first_of_the_gravest_findings_is_the_cause():
    note, wrong = (Finding(str(v), "a", "b", v) for v in (Verdict.NOTE, Verdict.WRONG))
    assert cause([note, wrong, dataclasses.replace(wrong, check="later")]) is wrong
    assert cause([note]) is note
    assert cause([Finding("x", "a", "b", Verdict.OK)]) is None


EYE = np.eye(3)
MOTION = (
    MotionOptions(kind="stationary", duration_s=2.0),
    MotionOptions(kind="room_scan", duration_s=8.0, turns=0.4, shake_m=0.03, shake_rad=0.06),
)
MIRRORED = "axes of the gyroscope"
MOUNTING = "rotation of the extrinsics"
FAULTS: dict[str, tuple[Callable[[protocol.Recording], protocol.Recording], str, str]] = {
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
def mission() -> map_replay.MapRecording:
    return map_replay.MapRecording(replayed(MOTION)[0], 0)


@pytest.mark.parametrize("name", FAULTS)
def test_a_planted_fault_is_named_first_with_its_remedy(name: str):
    plant, check, word = FAULTS[name]
    first = doctor.first_cause(doctor.diagnose(plant(mission())))
    assert first is not None
    assert first.check.startswith(check)
    assert word in first.line


def test_nothing_is_wrong_with_a_sound_mission():
    diagnosis = doctor.diagnose(mission())
    assert [f for f in diagnosis.findings if f.verdict in (Verdict.WRONG, Verdict.HOPELESS)] == []
    checked = doctor.report(diagnosis, mission())
    assert not checked.failure
    assert "rovioli" in checked.advice
    assert len({finding.check for finding in checked.findings}) == len(checked.findings)


@pytest.mark.parametrize(
    ("explained", "error_px", "agrees"),
    [
        (0.9, 0.1, True),
        (0.45, 0.07, True),
        (0.45, 0.9, False),
        (0.6, 0.9, True),
        (0.25, 0.1, False),
    ],
)
def test_a_gyroscope_agrees_by_its_rates_or_by_the_points(
    explained: float, error_px: float, agrees: bool
):
    (camera, *_) = doctor.diagnose(mission()).cameras
    assert camera.rate_map is not None
    assert camera.hand_eye is not None
    changed = dataclasses.replace(
        camera,
        rate_map=dataclasses.replace(camera.rate_map, explained=explained),
        hand_eye=dataclasses.replace(camera.hand_eye, error_px=error_px),
    )
    assert changed.agrees is agrees


def test_a_corrected_calibration_passes_the_check():
    wrong = faults.with_rig(faults.with_clock(mission(), 0.02), turn_deg=(0.0, 8.0, 0.0))
    diagnosis = doctor.diagnose(wrong)
    device, notes = correct(diagnosis)
    assert any("time offset 20" in note for note in notes)
    offset_ns = device.cameras[0].time_offset_ns
    mended = dataclasses.replace(wrong, device=device, imu_shift_ns=wrong.imu_shift_ns - offset_ns)
    assert doctor.first_cause(doctor.diagnose(mended)) is None


def test_units_are_told_but_not_put_into_the_calibration():
    device = mission().device
    corrected, notes = correct(doctor.diagnose(faults.with_imu(mission(), EYE, np.degrees(EYE))))
    assert "not of the calibration: unit of the gyroscope" in notes[0]
    np.testing.assert_array_equal(corrected.T_I_C, device.T_I_C)
    assert correct(doctor.diagnose(mission()))[1] == ("nothing to correct",)


def test_the_first_seconds_are_refused_noted_or_passed():
    stream = StreamOptions()
    assert doctor.check_first_seconds(mission(), stream) == ()
    with pytest.raises(UserError, match=r"no time in common.*--time_unit"):
        doctor.check_first_seconds(faults.with_clock(mission(), 3600.0), stream)
    lines = doctor.check_first_seconds(faults.with_imu(mission(), EYE / 9.81, EYE), stream)
    assert len(lines) == 1
    assert "unit of the accelerometer" in lines[0]


def test_a_refused_start_is_explained_by_its_cause():
    assert doctor.explain_refusal(doctor.diagnose(mission()), "walk", "move more") == "move more"
    assert doctor.explain_refusal(None, "walk", "move more") == "move more"
    wrong = doctor.diagnose(faults.with_imu(mission(), EYE, np.degrees(EYE)))
    reason = doctor.explain_refusal(wrong, "walk", "move more")
    assert "walk: the odometry has not started: unit of the gyroscope" in reason


def test_a_map_tells_what_contradicts_its_calibration():
    vi_map, device = replayed(MOTION)[0], mission().device
    assert doctor.check_map(vi_map) == ()
    turned = faults.with_rig(mission(), turn_deg=(0.0, 8.0, 0.0)).device
    found = doctor.check_map(vi_map.replace(sensors=turned.sensors))[0]
    assert found.check.startswith("rotation of the extrinsics")
    assert "--vio_estimate=extrinsics" in found.remedy
    alone = dataclasses.replace(device.sensors, sensors={device.rig_id: device.rig})
    assert doctor.check_map(vi_map.replace(sensors=alone)) == ()


def test_a_recording_without_imu_cannot_work():
    plain = mission()
    none = dataclasses.replace(faults.sound(plain), edit_imu=lambda values: 0.0 * values)
    first = doctor.first_cause(doctor.diagnose(none))
    assert first is not None
    assert first.verdict is Verdict.HOPELESS
    assert "--imu_topic" in first.remedy


STREAM = StreamOptions()


def test_units_axes_clock_and_mounting_are_mended_together() -> None:
    axes = faults.AXES["swap xy"]
    wrong = faults.with_imu(mission(), EYE / 9.81, np.degrees(axes))
    wrong = faults.with_rig(faults.with_clock(wrong, 0.02), turn_deg=(0.0, 6.0, 0.0))
    read = mended(wrong, doctor.diagnose(wrong), STREAM)
    assert read is not None
    assert doctor.first_cause(doctor.diagnose(read)) is None
    np.testing.assert_allclose(read.accel, 9.81 * EYE)
    np.testing.assert_allclose(read.gyro, np.radians(axes), atol=1e-12)
    off = np.abs(se3.local(mission().device.T_I_C, read.device.T_I_C))[:, 3:]
    assert np.degrees(off.max()) < 1.0
    assert "accelerations times 9.81, rates times 0.0174533, axes (y, x, z)" in read.notes[-1]
    assert "time offset 20" in read.notes[-1]
    # the clock is the rig's: images taken together stay together
    assert len({camera.time_offset_ns for camera in read.device.cameras}) == 1


def test_left_handed_axes_of_the_whole_imu_are_mended() -> None:
    axes = faults.AXES["flip z"]
    wrong = faults.with_imu(mission(), axes, axes)
    read = mended(wrong, doctor.diagnose(wrong), STREAM)
    assert read is not None
    assert doctor.first_cause(doctor.diagnose(read)) is None
    np.testing.assert_allclose(read.accel, axes)
    np.testing.assert_allclose(read.gyro, axes)


def test_a_sound_recording_and_a_hopeless_one_stay() -> None:
    for recording in (mission(), faults.with_clock(mission(), 3600.0)):
        assert mended(recording, doctor.diagnose(recording), STREAM) is None


def test_a_run_that_is_lost_is_mended_or_noted() -> None:
    short = (MOTION[0], dataclasses.replace(MOTION[1], duration_s=4.0, turns=0.2))
    wrong = faults.with_imu(map_replay.MapRecording(replayed(short)[0], 0), EYE / 9.81, EYE)
    mapping = run_checked(Mapping, wrong)
    notes = finish(mapping, wrong.name).report.notes
    assert any(
        "does not fit its calibration; read with what check_recording finds: accelerations times 9.81"
        in note
        for note in notes
    )
    assert any("optimised with the calibration of the cameras free" in note for note in notes)
    refusing = RunOptions(odometry=dataclasses.replace(OdometryOptions(), apply_calibration=False))
    lost = run_checked(lambda read: Mapping(read, refusing), wrong)
    assert lost.statistics.estimated_frames < 0.5 * lost.statistics.frames
    assert "unit of the accelerometer" in lost.statistics.notes[-1]


def test_a_map_that_contradicts_its_calibration_is_made_again() -> None:
    wrong = faults.with_rig(mission(), turn_deg=(0.0, 5.0, 0.0))
    plain = Mapping(wrong)
    plain.run()
    assert plain.builder is not None
    found = doctor.check_map(plain.builder.make_map())
    assert found[0].check == "rotation of the extrinsics, camera 0"
    for is_repeatable in (True, False):
        mapping = run_checked(Mapping, wrong, is_repeatable=is_repeatable)
        assert mapping.doubts == ()
        assert "camera 0: turned by" in mapping.recording_notes[-1]
        assert mapping.odometry.calibration_estimate is not None
        off = np.abs(se3.local(mission().device.T_I_C, mapping.odometry.device.T_I_C))[:, 3:]
        assert np.degrees(off.max()) < 1.0


def test_a_sound_recording_is_read_once_and_keeps_its_calibration() -> None:
    made: list[Mapping] = []

    def make(read: protocol.Recording) -> Mapping:
        made.append(Mapping(read))
        return made[-1]

    mapping = run_checked(make, mission())
    assert made == [mapping]
    assert mapping.doubts == ()
    assert mapping.odometry.calibration_estimate is None
