"""Calibrations of single cameras and devices: DM-VIO's text, ROS' CameraInfo, RealSense's json."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from maplab_py.errors import MaplabError
from maplab_py.geometry import se3
from maplab_py.interop.calibration_import import import_calibration
from maplab_py.sensors import Distortion
from tests.interop.calibrations.small_files import (
    CAMERA_INFO,
    ECHOED,
    POSE,
    T_I_C0,
    cameras,
    check_poses,
    noise,
    realsense,
    written,
)

FISHEYE = ECHOED.replace("rational_polynomial", "equidistant").replace(
    ", 0.03, 0.01, 0.02, 0.005", ""
)
OPENCV = "%YAML:1.0\n---\n" + CAMERA_INFO.replace(
    "camera_matrix:", "camera_matrix: !!opencv-matrix"
)


@pytest.mark.parametrize(
    ("text", "intrinsics", "distortion"),
    [
        (
            "RadTan 458 457 320 240 -0.28 0.07 0 0\n640 480\ncrop\n640 480\n",
            [458, 457, 320, 240],
            "RADTAN",
        ),
        ("FOV 0.5 0.6 0.5 0.5 0.9\n640 480\nfull\n640 480\n", [320, 288, 319.5, 239.5], "FOV"),
        ("0.5 0.6 0.5 0.5 0\n640 480\nnone\n", [320, 288, 319.5, 239.5], "NONE"),
        ("EquiDistant 458 457 320 240 .1 .2 .3 .4\n640 480\n", [458, 457, 320, 240], "EQUIDISTANT"),
        ("Pinhole 402 403 320 240 0\n640 480\ncrop\n640 480", [402, 403, 320, 240], "NONE"),
    ],
)
def test_cameras_of_dm_vio(
    text: str, intrinsics: list[float], distortion: str, tmp_path: Path
) -> None:
    result = import_calibration(written(tmp_path, {"camera.txt": text}))
    (camera,) = cameras(result)
    np.testing.assert_allclose(camera.intrinsics, intrinsics)
    assert (camera.distortion, result.format) == (Distortion[distortion], "DM-VIO")
    chain = f"cam0:\n  T_cam_imu: {{rows: 4, cols: 4, data: {POSE}}}\n  timeshift_cam_imu: 0.001\n"
    noise_file = "accelerometer_noise_density: 0.2\ngyroscope_noise_density: 0.01\n"
    noise_file += "accelerometer_random_walk: 0.003\ngyroscope_random_walk: 0.00002\n"
    written(
        tmp_path, {"camchain.yaml": chain, "euroc.yaml": noise_file + "integration_sigma: 0.3\n"}
    )
    both = import_calibration(tmp_path / "camchain.yaml", tmp_path / "euroc.yaml")
    check_poses(both, se3.inverse(T_I_C0))
    assert cameras(both)[0].time_offset_ns == 1_000_000
    assert noise(both) == (0.2, 0.003, 0.01, 0.00002)
    with pytest.raises(MaplabError, match="no pose on the IMU: give its camchain"):
        import_calibration(tmp_path / "camera.txt", tmp_path / "euroc.yaml")


@pytest.mark.parametrize(
    "text",
    ["RadTan 1 2 3\n640 480\n", "FTheta 1 2 3 4 5\n640 480\n", "RadTan 1 2 3 4 5 6 7 nan\n6 4\n"],
)
def test_wrong_cameras_of_dm_vio(text: str, tmp_path: Path) -> None:
    with pytest.raises(MaplabError, match=r"camera\.txt"):
        import_calibration(written(tmp_path, {"camera.txt": text}))


@pytest.mark.parametrize(
    ("text", "distortion"),
    [
        (CAMERA_INFO, Distortion.RADTAN5),
        (CAMERA_INFO.replace("0.03]", "0.0]"), Distortion.RADTAN),
        (ECHOED, Distortion.RATIONAL),
        (ECHOED + ECHOED, Distortion.RATIONAL),
        (ECHOED.replace("\nD:", "\nd:").replace("\nK:", "\nk:"), Distortion.RATIONAL),
        (FISHEYE, Distortion.EQUIDISTANT),
        (OPENCV, Distortion.RADTAN5),
    ],
)
def test_camera_info(text: str, distortion: Distortion, tmp_path: Path) -> None:
    result = import_calibration(written(tmp_path, {"camera.yaml": text}))
    (camera,) = cameras(result)
    assert camera.intrinsics.tolist() == [500.0, 501.0, 320.0, 240.0]
    assert (camera.distortion, result.format, result.notes) == (distortion, "CameraInfo", ())


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "[500.0, 0.0, 320.0, 0.0, 501.0, 240.0, 0.0, 0.0, 1.0]",
            "[0, 0, 0, 0, 0, 0, 0, 0, 0]",
            "not calibrated",
        ),
        ("plumb_bob", "thin_prism", "'thin_prism' is not supported"),
        ("image_width: 640", "image_width: -640", "must be positive"),
        ("data: [0.1, -0.2, 0.001, 0.002, 0.03]", "data: [0.1, -0.2]", "1 x 5 is declared"),
    ],
)
def test_wrong_camera_info(old: str, new: str, message: str, tmp_path: Path) -> None:
    assert old in CAMERA_INFO
    with pytest.raises(MaplabError, match=message):
        import_calibration(written(tmp_path, {"camera.yaml": CAMERA_INFO.replace(old, new)}))


def test_realsense(tmp_path: Path) -> None:
    result = import_calibration(written(tmp_path, {"t265.json": realsense()}))
    assert result.format == "RealSense"
    check_poses(result, T_I_C0)
    (camera,) = cameras(result)
    assert (camera.distortion, camera.width_px, camera.height_px) == (
        Distortion.EQUIDISTANT,
        848,
        800,
    )
    imu = result.sensors.imu(result.imu_id)
    assert imu.intrinsics is not None
    assert imu.intrinsics.T_g[0, 0] == pytest.approx(1 / 1.01)
    assert imu.gyro_noise_density == pytest.approx(2e-3)
    rectified = json.loads(realsense())
    rectified["cameras"][0]["distortion"] = {"type": "undistorted"}
    d435i = import_calibration(written(tmp_path, {"d435i.json": json.dumps(rectified)}))
    assert cameras(d435i)[0].distortion is Distortion.NONE
    alone = import_calibration(written(tmp_path, {"imu.json": realsense(cameras=[])}))
    assert (alone.rig_id, bool(alone.imu_id)) == ("", True)


def test_realsense_intrinsics(tmp_path: Path) -> None:
    stream = {"width": 640, "height": 480, "fx": 600.0, "fy": 601.0, "ppx": 320.0, "ppy": 240.0}
    zero = stream | {"model": "distortion.inverse_brown_conrady", "coeffs": [0.0] * 5}
    for value in (zero, {"color": zero}, {"color": {"intrinsics": zero}}):
        result = import_calibration(written(tmp_path, {"rs.json": json.dumps(value)}))
        assert cameras(result)[0].distortion is Distortion.NONE
    for value, message in (
        (zero | {"coeffs": [0.1, 0, 0, 0, 0]}, "undistorts by its polynomial"),
        ({"color": zero, "infra1": zero}, "streams color, infra1 without poses"),
        ({"CameraCalibrations": []}, "of Project Aria are not read"),
        (zero | {"fx": "wide"}, "'fx' must be a finite number"),
    ):
        with pytest.raises(MaplabError, match=message):
            import_calibration(written(tmp_path, {"rs.json": json.dumps(value)}))
