"""Calibration files of other programs, with poses and noise that tests know; fuzzing starts from them."""

import json
from pathlib import Path

import numpy as np

from maplab_py.geometry import se3, so3
from maplab_py.interop.calibration_import import CalibrationFile
from maplab_py.sensors import Camera

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
