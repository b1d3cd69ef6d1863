"""Calibrations in which something is missing, misspelt, contradicts, or stands in several files."""

import re
from pathlib import Path

import numpy as np
import pytest

from maplab_py.errors import MaplabError, UserError
from maplab_py.frontend.odometry import Odometry
from maplab_py.interop.calibration_import import import_calibration, read_calibration
from maplab_py.interop.recordings import reader_choice, summary
from maplab_py.interop.recordings.options import SourceOptions
from maplab_py.sensors import Distortion, Projection
from tests.interop.recordings.written import make_content, write_bag, write_folder
from tests.interop.test_calibration_import import IMU

IDENTITY = "[[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1.0]]"
CAMERA = f"""cam0:
  T_cam_imu: {IDENTITY}
  cam_overlaps: []
  camera_model: pinhole
  distortion_coeffs: [0.1, -0.2, 0.001, -0.002]
  distortion_model: radtan
  intrinsics: [60.0, 61.0, 32.0, 24.0]
  resolution: [64, 48]
  rostopic: /cam0/image_raw
"""
SECOND = CAMERA.replace("cam0", "cam1")
EUROC = """%YAML:1.0
sensor_type: camera
comment: left
T_BS: {rows: 4, cols: 4, data: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}
rate_hz: 20
resolution: [64, 48]
camera_model: pinhole
intrinsics: [60.0, 61.0, 32.0, 24.0]
distortion_model: radial-tangential
distortion_coefficients: [0.1, -0.2, 0.001, -0.002]
"""
NCAMERA = """label: old rig
id: 0a5a4b1c0d5e4f6a8b9c0d1e2f3a4b5c
cameras:
- camera:
    label: cam0
    id: 1a5a4b1c0d5e4f6a8b9c0d1e2f3a4b5c
    line-delay-nanoseconds: 0
    image_height: 48
    image_width: 64
    type: pinhole
    intrinsics: {rows: 4, cols: 1, data: [60.0, 61.0, 32.0, 24.0]}
    distortion: {type: equidistant, parameters: {rows: 4, cols: 1, data: [0.1, 0.2, 0.3, 0.4]}}
  T_B_C: {rows: 4, cols: 4, data: [1, 0, 0, 0.5, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}
"""
OLD_IMU = """hardware_id: imu0
id: 2a5a4b1c0d5e4f6a8b9c0d1e2f3a4b5c
sensor_type: IMU
sigmas:
  gyro_noise_density: 0.0001
  gyro_bias_random_walk_noise_density: 0.0002
  acc_noise_density: 0.003
  acc_bias_random_walk_noise_density: 0.004
"""
OKVIS = f"""cameras:
- T_SC: {IDENTITY}
  image_dimension: [64, 48]
  focal_length: [60, 60]
  principal_point: [32, 24]
imu_parameters: {{sigma_g_c: 1, sigma_a_c: 1, sigma_gw_c: 1, sigma_aw_c: 1}}
"""


def written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def moved(key: str, x_m: float, angle_deg: float = 0.0) -> str:
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    return f"  {key}: [[{c}, {-s}, 0, {x_m}], [{s}, {c}, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n"


@pytest.mark.parametrize(
    ("key", "line_delay_ns", "offset_ns", "note"),
    [
        ("line_delay: 1.5e-05", 15_000, 0, ""),
        ("line_delay: -1.5e-05", -15_000, 0, "line delay is negative"),
        ("timeshift_cam_imu: -0.012", 0, -12_000_000, ""),
        ("timeshift_cam_imuu: -0.012", 0, 0, "timeshift_cam_imuu (timeshift_cam_imu?)"),
        ("lineDelay: 1.5e-05", 0, 0, "lineDelay (line_delay?)"),
        ("colour: red", 0, 0, "not understood: .*colour"),
    ],
)
@pytest.mark.parametrize("form", ["kalibr", "euroc"])
def test_keys_are_read_or_named(
    form: str, key: str, line_delay_ns: int, offset_ns: int, note: str, tmp_path: Path
) -> None:
    text = f"{CAMERA}  {key}\n" if form == "kalibr" else f"{EUROC}{key}\n"
    result = import_calibration(written(tmp_path / "camera.yaml", text))
    (camera,) = result.cameras
    assert (camera.line_delay_ns, camera.time_offset_ns) == (line_delay_ns, offset_ns)
    assert len(result.notes) == bool(note)
    if note:
        found = " ".join(result.notes)
        assert note.removeprefix("not understood: .*") in found


@pytest.mark.parametrize(
    ("key", "message"),
    [
        ("line_delay: abc", "'line_delay' must be a finite number"),
        ("line_delay: 30", "30 s"),
        ("line_delay: 0.1", "a line delay of 0.1 s is 4.8 s for 48 rows"),
        ("timeshift_cam_imu: 4000000", "'timeshift_cam_imu': 4e.06 s: it must be below 10 s"),
        ("timeshift_cam_imu: 1e300", "must be a finite number below 1e.100"),
    ],
)
@pytest.mark.parametrize("form", ["kalibr", "euroc"])
def test_delays_that_cannot_be_are_refused(
    form: str, key: str, message: str, tmp_path: Path
) -> None:
    text = f"{CAMERA}  {key}\n" if form == "kalibr" else f"{EUROC}{key}\n"
    with pytest.raises(MaplabError, match=message):
        import_calibration(written(tmp_path / "camera.yaml", text))


@pytest.mark.parametrize(
    ("text", "note"),
    [
        (
            CAMERA + moved("T_imu_cam", 0.012, 3.0),
            "'T_imu_cam' contradicts 'T_cam_imu' by 12 mm and 3",
        ),
        (
            CAMERA + SECOND + moved("T_cn_cnm1", 0.1),
            "cam1: 'T_cn_cnm1' contradicts .* by 100 mm and 0",
        ),
        (CAMERA + SECOND + moved("T_cam1_cam0", 0.0, 5.0)[2:], "'T_cam1_cam0' .* 0 mm and 5 deg"),
        (CAMERA + moved("T_imu_cam", 1e-7), ""),
    ],
)
def test_poses_that_contradict_are_compared(text: str, note: str, tmp_path: Path) -> None:
    path = written(tmp_path / "chain.yaml", text)
    result = import_calibration(path, written(tmp_path / "imu.yaml", IMU))
    np.testing.assert_allclose(result.T_I_C[:, 4:], 0.0, atol=1e-12)  # T_cam_imu counts
    assert len(result.notes) == bool(note)
    if note:
        assert re.search(note, result.notes[0])
        assert "'T_cam_imu' is used" in result.notes[0]


@pytest.mark.parametrize(
    ("projection", "distortion", "intrinsics", "coefficients", "wanted"),
    [
        ("pinhole", "radtan", "[60, 61, 32, 24]", "[0.1, 0, 0, 0, 0.3]", "RADTAN5"),
        ("pinhole", "plumb_bob", "[60, 61, 32, 24]", "[0.1, 0, 0, 0, 0.0]", "RADTAN"),
        (
            "pinhole",
            "rational_polynomial",
            "[60, 61, 32, 24]",
            "[.1, 0, 0, 0, 0, 0, 0, .2]",
            "RATIONAL",
        ),
        ("ds", "none", "[-0.2, 0.6, 60, 61, 32, 24]", "[]", "NONE"),
        ("eucm", "none", "[0.6, 1.1, 60, 61, 32, 24]", "[]", "NONE"),
        ("omni", "none", "[1.1, 60, 61, 32, 24]", "[]", "NONE"),
    ],
)
def test_models_of_kalibr(
    projection: str,
    distortion: str,
    intrinsics: str,
    coefficients: str,
    wanted: str,
    tmp_path: Path,
) -> None:
    text = CAMERA.replace("pinhole", projection).replace("radtan", distortion)
    text = text.replace("[60.0, 61.0, 32.0, 24.0]", intrinsics)
    text = text.replace("[0.1, -0.2, 0.001, -0.002]", coefficients)
    (camera,) = import_calibration(written(tmp_path / "chain.yaml", text)).cameras
    assert camera.distortion is Distortion[wanted]
    assert (camera.projection is Projection.PINHOLE) == (projection == "pinhole")


@pytest.mark.parametrize("coefficients", ["[0.1, 0.2]", "[.1, 0, 0, 0, 0, 0, 0, .2, .3, 0, 0, 0]"])
def test_other_counts_of_coefficients_are_refused(coefficients: str, tmp_path: Path) -> None:
    text = CAMERA.replace("[0.1, -0.2, 0.001, -0.002]", coefficients)
    with pytest.raises(MaplabError, match="needs 4 or 5 or 8 distortion parameters"):
        import_calibration(written(tmp_path / "chain.yaml", text))


def test_sizes_are_compared_with_the_first_images(tmp_path: Path) -> None:
    folder = write_folder(make_content(frames=1), tmp_path / "room")
    bag = write_bag(make_content(frames=1), tmp_path / "room.bag")
    both = CAMERA + SECOND.replace("/cam0", "/cam1")
    swapped = written(tmp_path / "swapped.yaml", both.replace("[64, 48]", "[48, 64]"))
    other = written(tmp_path / "other.yaml", CAMERA + SECOND.replace("[64, 48]", "[32, 24]"))
    imu = written(tmp_path / "imu.yaml", IMU)
    for path in (folder, bag):
        with pytest.raises(
            MaplabError,
            match=r"camera 0: the image is 64 x 48, the calibration is of 48 x 64: does the",
        ):
            reader_choice.open_recording(path, SourceOptions(swapped, imu))
    with pytest.raises(MaplabError, match=r"camera 1: the image is 64 x 48, .* of 32 x 24"):
        reader_choice.open_recording(folder, SourceOptions(other, imu))


@pytest.mark.parametrize(
    ("matrix", "note"),
    [
        ("[[0.4, 0, 0], [0, 0.4, 0], [0, 0, 0.4]]", "matrix of the gyroscope scales by 0.4"),
        ("[[57.3, 0, 0], [0, 57.3, 0], [0, 0, 57.3]]", "scales by 57.3"),
        ("[[1.02, 0, 0], [0, 1, 0], [0, 0, 0.99]]", ""),
    ],
)
def test_matrices_far_from_1_are_noted(matrix: str, note: str, tmp_path: Path) -> None:
    text = IMU + f"model: calibrated\nTw: {matrix}\n"
    chain = written(tmp_path / "chain.yaml", CAMERA)
    imu = written(tmp_path / "imu.yaml", text)
    result = import_calibration(chain, imu)
    assert len(result.notes) == bool(note)
    assert not note or (note in result.notes[0] and result.notes[0].startswith(str(imu)))


@pytest.mark.parametrize(
    ("old", "new", "note"),
    [
        (
            "60.0, 61.0",
            "0.7, 0.9",
            "camera 0: the focal length is 0.7: is it in pixels of 64 x 48?",
        ),
        ("rostopic", "timeshift_cam_imu: 5.3\n  rostopic", "camera 0: the time shift is 5.3 s"),
    ],
)
def test_numbers_of_another_unit_are_noted(old: str, new: str, note: str, tmp_path: Path) -> None:
    chain = written(tmp_path / "chain.yaml", CAMERA.replace(old, new))
    (said,) = import_calibration(chain, written(tmp_path / "imu.yaml", IMU)).notes
    assert note in said


def test_noise_that_no_imu_has_is_noted_with_its_file(tmp_path: Path) -> None:
    chain = written(tmp_path / "chain.yaml", CAMERA)
    imu = written(tmp_path / "imu.yaml", IMU.replace("density: 0.001", "density: 57.3"))
    (note,) = import_calibration(chain, imu).notes
    assert note.startswith(f"{imu}: noise of 57.3 rad/s/√Hz is far above that of any gyroscope")


def test_files_of_the_first_maplab_are_joined(tmp_path: Path) -> None:
    rig = written(tmp_path / "ncamera.yaml", NCAMERA)
    imu = written(tmp_path / "imu.yaml", OLD_IMU)
    result = import_calibration(rig, imu)
    assert (result.format, result.notes) == ("maplab", ())
    assert (result.rig_id[:2], result.imu_id[:2]) == ("0a", "2a")
    assert result.sensors.imu(result.imu_id).acc_noise_density == 0.003
    np.testing.assert_allclose(result.T_I_C[0, 4:], [0.5, 0.0, 0.0])
    folder = write_folder(make_content(frames=1), tmp_path / "room")
    options = SourceOptions(rig, imu, rovio_active_camera_indices="0")
    assert reader_choice.open_recording(folder, options).device.imu_id == result.imu_id
    assert import_calibration(rig).imu_id == ""
    assert import_calibration(imu).rig_id == ""
    kalibr = written(tmp_path / "kalibr.yaml", IMU)
    mixed = import_calibration(rig, kalibr)
    np.testing.assert_allclose(mixed.T_I_C, result.T_I_C)
    chain = written(tmp_path / "chain.yaml", CAMERA)
    assert import_calibration(chain, imu).sensors.imu(import_calibration(chain, imu).imu_id)
    misspelt = written(tmp_path / "n2.yaml", NCAMERA.replace("line-delay-nano", "line_delay_nano"))
    assert (
        "line_delay_nanoseconds (line-delay-nanoseconds?)" in import_calibration(misspelt).notes[0]
    )


def test_the_error_without_imu_names_the_flag(tmp_path: Path) -> None:
    folder = write_folder(make_content(frames=1), tmp_path / "room")
    chain = written(tmp_path / "chain.yaml", CAMERA)
    options = SourceOptions(chain, rovio_active_camera_indices="0")
    recording = reader_choice.open_recording(folder, options)
    with pytest.raises(UserError, match="--imu_calibration_file=FILE"):
        Odometry(recording.device)
    assert "--imu_calibration_file" in recording.notes[0]
    with pytest.raises(UserError, match="has an IMU and no cameras: give it as --imu_calibration"):
        read_calibration(written(tmp_path / "imu.yaml", IMU))
    both = written(tmp_path / "okvis.yaml", OKVIS)
    with pytest.raises(UserError, match="has cameras, too"):
        import_calibration(chain, both)
    with pytest.raises(UserError, match="has no IMU"):
        import_calibration(chain, chain)


def test_notes_of_the_calibration_reach_the_reports(tmp_path: Path) -> None:
    folder = write_folder(make_content(frames=2), tmp_path / "room")
    chain = written(tmp_path / "chain.yaml", CAMERA + moved("T_imu_cam", 0.012, 3.0))
    options = SourceOptions(chain, rovio_active_camera_indices="0")
    notes = summary.summarise(reader_choice.open_recording(folder, options)).notes
    assert any("12 mm and 3 deg" in note for note in notes)


def test_a_chain_with_a_gap_names_the_missing_camera(tmp_path: Path) -> None:
    text = CAMERA + CAMERA.replace("cam0", "cam1") + CAMERA.replace("cam0", "cam3")
    with pytest.raises(MaplabError, match="has cam3, but no cam2: number the cameras from cam0 on"):
        import_calibration(written(tmp_path / "chain.yaml", text))
    relative = CAMERA.replace("T_cam_imu", "T_unknown") + SECOND
    with pytest.raises(MaplabError, match="cam0: key 'T_cam_imu' is missing"):
        import_calibration(written(tmp_path / "chain.yaml", relative))


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        (
            "oak.json",
            '{"cameraData": [], "boardName": "OAK-D"}',
            r"calibrations of DepthAI \(OAK\)",
        ),
        ("any.json", '{"cameras": {}}', "the format is not known: files of kalibr"),
        (
            "SN1.conf",
            "[LEFT_CAM_HD]\nfx=700\n[STEREO]\nBaseline=120\n",
            "calibrations of ZED cameras",
        ),
        ("calib.txt", "P0: 718 0 607 0 0 718 185 0 0 0 1 0\n", "projections of KITTI"),
        ("intrinsics.yml", "M1: {rows: 3, cols: 3, data: []}\nD1: {}\n", "OpenCV's stereo sample"),
        (
            "results.txt",
            "Calibration results\n====\nCamera-system parameters:\n",
            "kalibr's report",
        ),
        ("calib.xml", '<?xml version="1.0"?>\n<opencv_storage/>\n', "is XML of OpenCV"),
        ("ost.txt", "# oST version 5.0\n\n\n[image]\n\nwidth\n640\n", "is an ini file of ROS"),
        ("rovio.info", "Common\n{\n\tdoVECalibration true;\n}\n", "settings of ROVIO are not read"),
        ("rs.txt", 'Device info:\n Name: D435i\n Intrinsic of "Depth" / 640x480\n', "rs-enumerate"),
        (
            "april.yaml",
            "target_type: 'aprilgrid'\ntagCols: 6\n",
            "is a calibration target of kalibr",
        ),
        ("imu.yaml", "%YAML:1.0\n---\ntype: IMU\nGyr:\n   unit: rad/s\n", "report of imu_utils"),
        ("unknown.yaml", "rig: {cameras: 2}\n", "format is not known: files of kalibr"),
        ("empty.yaml", "# nothing\n", "key-value pairs are expected"),
    ],
)
def test_files_that_are_no_calibrations_are_refused_by_name(
    name: str, text: str, message: str, tmp_path: Path
) -> None:
    with pytest.raises(MaplabError, match=message) as error:
        import_calibration(written(tmp_path / name, text))
    assert name in str(error.value)
    assert "\n" not in str(error.value)


def test_the_format_follows_from_the_content(tmp_path: Path) -> None:
    assert import_calibration(written(tmp_path / "chain.json", CAMERA)).format == "kalibr"
    stream = '{"width": 64, "height": 48, "fx": 60, "fy": 61, "ppx": 32, "ppy": 24}'
    assert import_calibration(written(tmp_path / "stream.yaml", stream)).format == "RealSense"
    dso = "Pinhole 60 61 32 24 0\n64 48\n"
    assert import_calibration(written(tmp_path / "calib.cfg", dso)).format == "DM-VIO"


def test_frames_of_files_of_two_programs_are_kept_apart(tmp_path: Path) -> None:
    imu_text = "T_BS: {rows: 4, cols: 4, data: [1, 0, 0, 7, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}\n"
    imu_text += IMU.replace("rostopic: /imu0\n", "").replace("update_rate", "rate_hz")
    euroc_imu = written(tmp_path / "imu0.yaml", imu_text)
    chain = written(tmp_path / "chain.yaml", CAMERA)
    camera = written(tmp_path / "cam0.yaml", EUROC)
    np.testing.assert_allclose(import_calibration(chain, euroc_imu).T_I_C[0, 4:], [0, 0, 0])
    np.testing.assert_allclose(import_calibration(camera, euroc_imu).T_I_C[0, 4:], [-7, 0, 0])
    mixed = import_calibration(camera, written(tmp_path / "imu.yaml", IMU))
    assert "does not say where it is: it is taken as the body" in mixed.notes[0]


@pytest.mark.parametrize(
    ("old", "new", "note"),
    [
        ("[60.0, 61.0, 32.0, 24.0]", "[60.0, 32.0, 61.0, 24.0]", "60 and 32 differ: is the order"),
        ("[60.0, 61.0, 32.0, 24.0]", "[60.0, 61.0, 320.0, 240.0]", "centre 320, 240 is outside"),
        ("[1.0, 0, 0, 0]", "[1.0, 0, 0, 65.0]", "is 65 m from the body: are the poses in metres"),
    ],
)
def test_cameras_that_no_device_has_are_noted(
    old: str, new: str, note: str, tmp_path: Path
) -> None:
    chain = written(tmp_path / "chain.yaml", CAMERA.replace(old, new))
    result = import_calibration(chain, written(tmp_path / "imu.yaml", IMU))
    assert note in " ".join(result.notes)
