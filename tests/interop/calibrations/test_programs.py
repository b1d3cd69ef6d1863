"""Calibrations of other programs, and of single cameras and devices."""

import json
from pathlib import Path

import numpy as np
import pytest

from maplab_py.errors import MaplabError
from maplab_py.geometry import se3, so3
from maplab_py.interop.calibration_import import import_calibration
from maplab_py.sensors import Distortion, Projection
from tests.interop.calibrations.small_files import (
    CAMERA_INFO,
    ECHOED,
    KANNALA,
    MEI,
    NEXT,
    OKVIS,
    ORB_NEW,
    ORB_OLD,
    POSE,
    SVO,
    T_I_C0,
    T_I_C1,
    VINS_FUSION,
    VINS_MONO,
    cameras,
    check_poses,
    noise,
    realsense,
    written,
)


def test_vins_mono(tmp_path: Path) -> None:
    result = import_calibration(written(tmp_path, {"euroc_config.yaml": VINS_MONO}))
    assert result.format == "VINS"
    check_poses(result, T_I_C0)
    (camera,) = cameras(result)
    assert camera.distortion_parameters.tolist() == [-0.25, 0.09, -1e-4, 2e-4]
    assert (camera.time_offset_ns, camera.line_delay_ns) == (4_000_000, 50_000)
    assert camera.topic == "/cam/image_raw"
    assert noise(result) == (0.1, 0.001, 0.01, 0.0001)
    assert result.sensors.imu(result.imu_id).gravity_magnitude_mps2 == 9.8
    assert "densities" in " ".join(result.notes)


def test_vins_fusion_with_its_files_of_cameras(tmp_path: Path) -> None:
    files = {"config.yaml": VINS_FUSION, "left.yaml": MEI, "right.yaml": KANNALA}
    result = import_calibration(written(tmp_path, files))
    check_poses(result, T_I_C0, T_I_C1)
    left, right = cameras(result)
    assert (left.projection, right.distortion) == (Projection.UNIFIED, Distortion.EQUIDISTANT)
    assert left.intrinsics.tolist() == [1.5, 800.0, 801.0, 320.0, 240.0]
    assert right.distortion_parameters.tolist() == [0.01, 0.02, 0.03, 0.04]
    assert [camera.time_offset_ns for camera in (left, right)] == [-2_000_000] * 2
    assert [camera.topic for camera in (left, right)] == ["/cam0/image_raw", "/cam1/image_raw"]
    alone = import_calibration(tmp_path / "left.yaml")
    assert (alone.imu_id, alone.format) == ("", "VINS")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("left.yaml", "absent.yaml", "cannot read .*absent.yaml"),
        ("body_T_cam1", "body_T_camera1", "'body_T_cam1' is missing; is 'body_T_camera1' misspelt"),
        ("td: -0.002", "td: abc", "key 'td' must be a finite number"),
        ("td: -0.002", "td: -2000000.0", "'td': -2e.06 s: it must be below 10 s"),
        ("num_of_cam: 2", "num_of_cam: 2000000", "'num_of_cam' must be from 1 to 16"),
        ("acc_n: 0.1", "acc_n: 0.0", "'acc_n' must be positive"),
    ],
)
def test_wrong_files_of_vins(old: str, new: str, message: str, tmp_path: Path) -> None:
    files = {"config.yaml": VINS_FUSION.replace(old, new), "left.yaml": MEI, "right.yaml": KANNALA}
    with pytest.raises(MaplabError, match=message):
        import_calibration(written(tmp_path, files))


def test_sizes_of_vins_that_contradict_are_noted(tmp_path: Path) -> None:
    files = {"config.yaml": VINS_FUSION.replace("image_width: 640", "image_width: 752")}
    result = import_calibration(
        written(tmp_path, files | {"left.yaml": MEI, "right.yaml": KANNALA})
    )
    assert "752 x 480 pixels, camera 0 640 x 480 in its file" in " ".join(result.notes)


def test_orb_slam3(tmp_path: Path) -> None:
    result = import_calibration(written(tmp_path, {"EuRoC.yaml": ORB_NEW}))
    assert result.format == "ORB-SLAM"
    check_poses(result, T_I_C0, T_I_C1)
    first, second = cameras(result)
    assert (first.distortion, second.distortion) == (Distortion.RADTAN, Distortion.RADTAN5)
    assert noise(result) == (2e-3, 3e-3, 1.7e-4, 1.9e-5)
    assert result.notes == ()


def test_orb_slam_before_the_file_version(tmp_path: Path) -> None:
    result = import_calibration(written(tmp_path, {"TUM.yaml": ORB_OLD}))
    check_poses(result, T_I_C0)
    assert cameras(result)[0].distortion_parameters.tolist() == [0.003, 0.0007, -0.002, 0.0002]
    text = ORB_OLD.replace("Camera.width: 512\n", "")
    with pytest.raises(MaplabError, match="key 'width' is missing"):
        import_calibration(written(tmp_path, {"TUM.yaml": text}))
    text = ORB_OLD.replace("IMU.NoiseGyro", "IMU.NoiseGyr")
    with pytest.raises(MaplabError, match=r"Gyro' is missing; is 'IMU\.NoiseGyr' misspelt"):
        import_calibration(written(tmp_path, {"TUM.yaml": text}))


def test_rectified_pairs_become_the_cameras_before_rectification(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    R_l, R_r = so3.to_matrix(so3.exp(rng.normal(size=(2, 3)) * 0.02))
    text = (
        "Camera.fx: 400.0\nCamera.fy: 400.0\nCamera.cx: 320.0\nCamera.cy: 240.0\nCamera.bf: 48.0\n"
    )
    text += "Camera.width: 640\nCamera.height: 480\n"
    for side, R, shift in (("LEFT", R_l, 0.0), ("RIGHT", R_r, -48.0)):
        matrices = {
            "K": [450.0, 0, 320.0, 0, 451.0, 240.0, 0, 0, 1],
            "D": [-0.28, 0.07, 0.0001, 0.0002, 0.0],
            "R": R.reshape(-1).tolist(),
            "P": [400.0, 0, 320.0, shift, 0, 400.0, 240.0, 0, 0, 0, 1, 0],
        }
        for key, values in matrices.items():
            rows, cols = {"D": (1, 5), "P": (3, 4)}.get(key, (3, 3))
            matrix = f"{{rows: {rows}, cols: {cols}, dt: d, data: {values}}}"
            text += f"{side}.{key}: !!opencv-matrix {matrix}\n"
    result = import_calibration(written(tmp_path, {"stereo.yaml": "%YAML:1.0\n" + text}))
    assert [camera.intrinsics[0] for camera in cameras(result)] == [450.0, 450.0]
    p_r = np.array([0.3, -0.2, 2.0])
    p_l = se3.transform(result.T_I_C[1], p_r)  # the first camera is the body
    np.testing.assert_allclose(R_l @ p_l, R_r @ p_r + [0.12, 0.0, 0.0], atol=1e-12)


def test_stella_vslam(tmp_path: Path) -> None:
    nested = """Camera:
  name: "fisheye"
  setup: "monocular"
  model: "fisheye"
  fx: 300.0
  fy: 301.0
  cx: 320.0
  cy: 240.0
  k1: 0.01
  k2: 0.02
  k3: 0.03
  k4: 0.04
  fps: 20.0
  cols: 640
  rows: 480
  color_order: "Gray"
Feature:
  num_levels: 8
"""
    flat = "".join(
        f"Camera.{line.strip()}\n"
        for line in nested.split("Feature", maxsplit=1)[0].splitlines()[1:]
    )
    for text in (nested, flat):
        result = import_calibration(written(tmp_path, {"stella.yaml": text}))
        assert result.format == "stella_vslam"
        (camera,) = cameras(result)
        assert camera.distortion_parameters.tolist() == [0.01, 0.02, 0.03, 0.04]
        assert (camera.width_px, camera.height_px) == (640, 480)
    text = nested.replace('model: "fisheye"', 'model: "equirectangular"')
    with pytest.raises(MaplabError, match="model 'equirectangular' is not supported"):
        import_calibration(written(tmp_path, {"stella.yaml": text}))


def test_okvis(tmp_path: Path) -> None:
    result = import_calibration(written(tmp_path, {"okvis2.yaml": OKVIS}))
    assert result.format == "OKVIS"
    check_poses(result, T_I_C0, T_I_C1)
    assert [c.distortion for c in cameras(result)] == [Distortion.RADTAN, Distortion.RATIONAL]
    assert [c.time_offset_ns for c in cameras(result)] == [-5_000_000] * 2
    assert noise(result) == (8e-3, 4e-5, 1.2e-3, 4e-6)
    assert result.sensors.imu(result.imu_id).saturation_accel_max_mps2 == 176.0
    text = OKVIS.replace("sigma_g_c", "sigma_gc")
    with pytest.raises(MaplabError, match="'sigma_g_c' is missing; is 'sigma_gc' misspelt"):
        import_calibration(written(tmp_path, {"okvis2.yaml": text}))


def test_svo(tmp_path: Path) -> None:
    result = import_calibration(written(tmp_path, {"svo.yaml": SVO}))
    assert result.format == "SVO"
    check_poses(result, T_I_C0)
    (camera,) = cameras(result)
    assert (camera.distortion, camera.time_offset_ns) == (Distortion.FOV, 3_000_000)
    assert noise(result) == (0.002, 0.003, 0.0001, 0.00002)
    atan = (
        "cam_model: ATAN\ncam_width: 752\ncam_height: 480\ncam_fx: 0.5\ncam_fy: 0.8\ncam_cx: 0.5\n"
    )
    old = import_calibration(written(tmp_path, {"old.yaml": atan + "cam_cy: 0.5\ncam_d0: 0.9\n"}))
    assert cameras(old)[0].intrinsics.tolist() == [376.0, 384.0, 375.5, 239.5]
    ocam = atan.replace("ATAN", "Ocam") + "cam_cy: 0.5\n"
    with pytest.raises(MaplabError, match="'Ocam' of SVO is not supported"):
        import_calibration(written(tmp_path, {"old.yaml": ocam}))


def test_kimera(tmp_path: Path) -> None:
    camera = f"""%YAML:1.0
camera_id: left_cam
T_BS: {{cols: 4, rows: 4, data: {POSE}}}
rate_hz: 20
resolution: [640, 480]
camera_model: pinhole
intrinsics: [458.0, 457.0, 320.0, 240.0]
distortion_model: radial-tangential
distortion_coefficients: [-0.28, 0.07, 0.0002, 1.7e-05]
"""
    imu = """%YAML:1.0
imu_preintegration_type: 1
T_BS: {cols: 4, rows: 4, data: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}
rate_hz: 200
gyroscope_noise_density: 1.7e-04
gyroscope_random_walk: 1.9e-05
accelerometer_noise_density: 2.0e-3
accelerometer_random_walk: 3.0e-2
imu_integration_sigma: 1.0e-8
imu_time_shift: 0.002
n_gravity: [0.0, 0.0, -9.8]
"""
    right = camera.replace(POSE, NEXT).replace("left_cam", "right_cam")
    written(
        tmp_path,
        {
            "LeftCameraParams.yaml": camera,
            "RightCameraParams.yaml": right,
            "ImuParams.yaml": imu,
        },
    )
    result = import_calibration(tmp_path)
    assert result.format == "Kimera"
    check_poses(result, T_I_C0, T_I_C1)
    assert [c.time_offset_ns for c in cameras(result)] == [2_000_000] * 2
    assert noise(result) == (2e-3, 3e-2, 1.7e-4, 1.9e-5)
    assert result.sensors.imu(result.imu_id).gravity_magnitude_mps2 == 9.8
    two = import_calibration(tmp_path / "LeftCameraParams.yaml", tmp_path / "ImuParams.yaml")
    check_poses(two, T_I_C0)
    assert cameras(two)[0].time_offset_ns == 2_000_000


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
