"""Calibrations in the settings of other programs: small files of every kind, each with its pose and noise."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from maplab_py.errors import MaplabError
from maplab_py.geometry import se3, so3
from maplab_py.interop.calibration_import import CalibrationFile, import_calibration
from maplab_py.sensors import Camera, Distortion, Projection

R_I_C = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
POSE = "[0.0, -1.0, 0.0, 0.01, 1.0, 0.0, 0.0, 0.02, 0.0, 0.0, 1.0, 0.03, 0.0, 0.0, 0.0, 1.0]"
NEXT = "[0.0, -1.0, 0.0, 0.01, 1.0, 0.0, 0.0, 0.12, 0.0, 0.0, 1.0, 0.03, 0.0, 0.0, 0.0, 1.0]"
T_I_C0 = se3.make(so3.from_matrix(R_I_C), np.array([0.01, 0.02, 0.03]))
T_I_C1 = se3.make(so3.from_matrix(R_I_C), np.array([0.01, 0.12, 0.03]))

VINS_MONO = """%YAML:1.0

imu_topic: "/imu"
image_topic: "/cam/image_raw"
model_type: PINHOLE
camera_name: camera
image_width: 640
image_height: 480
distortion_parameters:
   k1: -2.5e-01
   k2: 9.0e-02
   p1: -1.0e-04
   p2: 2.0e-04
projection_parameters:
   fx: 4.6e+02
   fy: 4.7e+02
   cx: 3.2e+02
   cy: 2.4e+02
estimate_extrinsic: 0
extrinsicRotation: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [0.0, -1.0, 0.0,
           1.0, 0.0, 0.0,
           0.0, 0.0, 1.0]
extrinsicTranslation: !!opencv-matrix
   rows: 3
   cols: 1
   dt: d
   data: [0.01, 0.02, 0.03]
max_cnt: 150
acc_n: 0.1
gyr_n: 0.01
acc_w: 0.001
gyr_w: 0.0001
g_norm: 9.8
td: 0.004
rolling_shutter: 1
rolling_shutter_tr: 0.024
"""
VINS_FUSION = f"""%YAML:1.0
imu: 1
num_of_cam: 2
imu_topic: "/imu0"
image0_topic: "/cam0/image_raw"
image1_topic: "/cam1/image_raw"
cam0_calib: "left.yaml"
cam1_calib: "right.yaml"
image_width: 640
image_height: 480
body_T_cam0: !!opencv-matrix
   rows: 4
   cols: 4
   dt: d
   data: {POSE}
body_T_cam1: !!opencv-matrix
   rows: 4
   cols: 4
   dt: d
   data: {NEXT}
acc_n: 0.1
gyr_n: 0.01
acc_w: 0.001
gyr_w: 0.0001
g_norm: 9.81
td: -0.002
"""
MEI = """%YAML:1.0
---
model_type: MEI
camera_name: camera
image_width: 640
image_height: 480
mirror_parameters:
   xi: 1.5
distortion_parameters: {k1: 0.01, k2: 0.02, p1: 0.0, p2: 0.001}
projection_parameters: {gamma1: 800.0, gamma2: 801.0, u0: 320.0, v0: 240.0}
"""
KANNALA = """%YAML:1.0
---
model_type: KANNALA_BRANDT
image_width: 640
image_height: 480
projection_parameters: {k2: 0.01, k3: 0.02, k4: 0.03, k5: 0.04, mu: 300.0, mv: 301.0, u0: 320.0, v0: 240.0}
"""
ORB_NEW = f"""%YAML:1.0
File.version: "1.0"
Camera.type: "PinHole"
Camera1.fx: 458.0
Camera1.fy: 457.0
Camera1.cx: 320.0
Camera1.cy: 240.0
Camera1.k1: -0.28
Camera1.k2: 0.07
Camera1.p1: 0.0002
Camera1.p2: 1.7e-05
Camera2.fx: 457.0
Camera2.fy: 456.0
Camera2.cx: 330.0
Camera2.cy: 250.0
Camera2.k1: -0.28
Camera2.k2: 0.07
Camera2.p1: -0.0001
Camera2.p2: -3.0e-05
Camera2.k3: 0.01
Camera1.overlappingBegin: 0
Camera.width: 640
Camera.height: 480
Camera.newWidth: 600
Camera.fps: 20
Stereo.T_c1_c2: !!opencv-matrix
  rows: 4
  cols: 4
  dt: f
  data: [1.0, 0.0, 0.0, 0.1, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0, 0, 0, 1.0]
IMU.T_b_c1: !!opencv-matrix
   rows: 4
   cols: 4
   dt: f
   data: {POSE}
IMU.NoiseGyro: 1.7e-4
IMU.NoiseAcc: 2.0e-3
IMU.GyroWalk: 1.9e-05
IMU.AccWalk: 3.e-03
IMU.Frequency: 200.0
ORBextractor.nFeatures: 1200
"""
ORB_OLD = f"""%YAML:1.0
Camera.type: "KannalaBrandt8"
Camera.fx: 190.0
Camera.fy: 191.0
Camera.cx: 254.0
Camera.cy: 256.0
Camera.k1: 0.003
Camera.k2: 0.0007
Camera.k3: -0.002
Camera.k4: 0.0002
Camera.width: 512
Camera.height: 512
Tbc: !!opencv-matrix
   rows: 4
   cols: 4
   dt: f
   data: {POSE}
IMU.NoiseGyro: 0.00016
IMU.NoiseAcc: 0.0028
IMU.GyroWalk: 0.000022
IMU.AccWalk: 0.00086
"""
OKVIS = f"""%YAML:1.0
cameras:
     - {{T_SC:
        {POSE},
        image_dimension: [640, 480],
        distortion_coefficients: [-0.28, 0.07, 0.0002, 1.7e-05],
        distortion_type: radialtangential,
        focal_length: [458.0, 457.0],
        principal_point: [320.0, 240.0],
        camera_type: gray,
        slam_use: okvis}}
     - {{T_SC:
        {NEXT},
        image_dimension: [640, 480],
        distortion_coefficients: [17.9, 12.5, 0.0001, -0.00007, 0.7, 18.3, 18.2, 3.07],
        distortion_type: radialtangential8,
        focal_length: [310.0, 311.0],
        principal_point: [307.0, 273.0]}}
camera_parameters:
    image_delay: 0.005
    timestamp_tolerance: 0.005
imu_parameters:
    a_max: 176.0
    g_max: 7.8
    sigma_g_c: 12.0e-4
    sigma_a_c: 8.0e-3
    sigma_gw_c: 4.0e-6
    sigma_aw_c: 4.0e-5
    g: 9.81007
"""
SVO = f"""label: rig
cameras:
- camera:
    label: cam0
    type: pinhole
    image_width: 640
    image_height: 480
    line-delay-nanoseconds: 0
    intrinsics: {{cols: 1, rows: 4, data: [458.0, 457.0, 320.0, 240.0]}}
    distortion:
      type: fisheye
      parameters: {{cols: 1, rows: 1, data: [0.9]}}
  T_B_C: {{cols: 4, rows: 4, data: {POSE}}}
imu_params:
  delay_imu_cam: -0.003
  acc_max: 176.0
  omega_max: 7.8
  sigma_omega_c: 0.0001
  sigma_acc_c: 0.002
  sigma_omega_bias_c: 0.00002
  sigma_acc_bias_c: 0.003
  g: 9.8082
"""


def written(folder: Path, files: dict[str, str]) -> Path:
    """Write files and return the first one."""
    for name, text in files.items():
        (folder / name).write_text(text)
    return folder / next(iter(files))


def cameras(result: CalibrationFile) -> tuple[Camera, ...]:
    return result.rig.cameras


def check_poses(result: CalibrationFile, *poses: np.ndarray) -> None:
    for T, wanted in zip(result.T_I_C, poses, strict=True):
        distance = se3.relative(T, wanted)
        assert np.linalg.norm(distance[:3]) < 1e-9
        assert np.linalg.norm(distance[4:]) < 1e-9


def noise(result: CalibrationFile) -> tuple[float, float, float, float]:
    imu = result.sensors.imu(result.imu_id)
    return (
        imu.acc_noise_density,
        imu.acc_bias_random_walk_noise_density,
        imu.gyro_noise_density,
        imu.gyro_bias_random_walk_noise_density,
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


CAMERA_INFO = """image_width: 640
image_height: 480
camera_name: narrow
camera_matrix:
  rows: 3
  cols: 3
  data: [500.0, 0.0, 320.0, 0.0, 501.0, 240.0, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0.1, -0.2, 0.001, 0.002, 0.03]
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
projection_matrix: {rows: 3, cols: 4, data: [480, 0, 320, 0, 0, 480, 240, 0, 0, 0, 1, 0]}
"""
ECHOED = """header:
  seq: 3
  stamp: {secs: 1, nsecs: 2}
  frame_id: cam
height: 480
width: 640
distortion_model: "rational_polynomial"
D: [0.1, -0.2, 0.001, 0.002, 0.03, 0.01, 0.02, 0.005]
K: [500.0, 0.0, 320.0, 0.0, 501.0, 240.0, 0.0, 0.0, 1.0]
R: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
P: [500.0, 0.0, 320.0, 0.0, 0.0, 501.0, 240.0, 0.0, 0.0, 0.0, 1.0, 0.0]
binning_x: 0
binning_y: 0
roi: {x_offset: 0, y_offset: 0, height: 0, width: 0, do_rectify: false}
---
"""

FISHEYE = ECHOED.replace("rational_polynomial", "equidistant").replace(
    ", 0.03, 0.01, 0.02, 0.005", ""
)
OPENCV = "%YAML:1.0\n---\n" + CAMERA_INFO.replace(
    "camera_matrix:", "camera_matrix: !!opencv-matrix"
)


@pytest.mark.parametrize(
    ("text", "distortion"),
    [
        (CAMERA_INFO, Distortion.RADTAN5),
        (CAMERA_INFO.replace("0.03]", "0.0]"), Distortion.RADTAN),
        (ECHOED, Distortion.RATIONAL),
        (ECHOED + ECHOED, Distortion.RATIONAL),
        (ECHOED.replace("\nD:", "\nd:").replace("\nK:", "\nk:"), Distortion.RATIONAL),
        (
            ECHOED.replace("rational_polynomial", "equidistant").replace(
                ", 0.03, 0.01, 0.02, 0.005", ""
            ),
            Distortion.EQUIDISTANT,
        ),
        (
            "%YAML:1.0\n---\n"
            + CAMERA_INFO.replace("camera_matrix:", "camera_matrix: !!opencv-matrix"),
            Distortion.RADTAN5,
        ),
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


def realsense(**changes: object) -> str:
    camera = {
        "size_px": [848, 800],
        "center_px": [420.0, 400.0],
        "focal_length_px": [286.0, 287.0],
        "distortion": {"type": "kannalabrandt4", "k": [-0.01, 0.04, -0.04, 0.007, 0.0]},
        "extrinsics": {"T": [0.01, 0.02, 0.03], "W": [0.0, 0.0, 1.5707963267948966]},
    }
    sensor = {"scale_and_alignment": [1.01, 0, 0, 0, 1, 0, 0, 0, 1], "bias": [0, 0, 0]}
    imu = {
        "gyroscope": sensor | {"noise_variance": 4e-6, "bias_variance": 1e-7},
        "accelerometer": sensor | {"noise_variance": 1e-4, "bias_variance": 1e-4},
        "extrinsics": {"T": [0, 0, 0], "W": [0, 0, 0]},
    }
    value = {"device_type": "TM2", "device_id": "1", "cameras": [camera], "imus": [imu]}
    return json.dumps(value | changes)


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
