"""kalibr's results: the camera chain, and the IMU file of kalibr, OpenVINS and their relatives.

Poses `T_cam_imu` (or OpenVINS' inverse, `T_imu_cam`) refer to a frame i of the IMU. Its
measurements are w = W w_i + b_g and a = A f_i + b_a. Ours are in the frame I in which W becomes
upper triangular: W = T_g R_I_i and A = T_a R_A_I R_I_i; both are RQ decompositions.
"""

import dataclasses
import re

import numpy as np

from maplab_py.array_types import F64
from maplab_py.errors import MapError
from maplab_py.geometry import se3, so3
from maplab_py.interop.calibrations import models
from maplab_py.interop.calibrations.parts import Parts, compare_poses, note_unknown_keys
from maplab_py.sensors import Camera, Imu, ImuIntrinsics, yaml_entry

_IDENTITY_TOLERANCE = 1e-9
_NOT_OF_THE_CALIBRATION = ("cam_overlaps", "update_rate", "T_i_b", "overlaps", "rosbag")
_PAIR = re.compile(r"^T_cam([0-9]{1,2})_cam([0-9]{1,2})$")
_NO_IMU_POSE = (
    "key 'T_cam_imu' is missing: calibrate cameras and IMU together (kalibr_calibrate_imu_camera)"
)


def is_camera_chain(entry: yaml_entry.Entry) -> bool:
    """Tell whether a calibration file is kalibr's camera chain."""
    return any(_camera_number(key) is not None for key in entry)


def read_camera_chain(entry: yaml_entry.Entry) -> Parts:
    """Return the cameras of a chain, on the IMU where the chain has their poses on it.

    Raises:
        MapError: A key is missing or wrong, a model is not supported, or a camera is left out.
    """
    numbers = sorted(n for key in entry if (n := _camera_number(key)) is not None)
    if numbers != list(range(len(numbers))):
        missing = min(set(range(numbers[-1])) - set(numbers))
        raise MapError(
            f"{entry.where}: has cam{numbers[-1]}, but no cam{missing}: number the cameras from cam0 on"
        )
    cameras: list[Camera] = []
    T_cam_B: list[F64] = []
    notes: list[str] = []
    why = ""
    for number in numbers:
        part = entry.child(f"cam{number}")
        cameras.append(models.read_camera(part, "distortion_coeffs"))
        given = _given_poses(part, T_cam_B)
        if number and not given:
            raise MapError(f"{part.where}: {_NO_IMU_POSE}")
        if why and given[0][0] != "T_cn_cnm1":
            raise MapError(why)
        if number == 0 and (not given or given[0][0] == "T_cn_cnm1"):
            why = f"{part.where}: {_NO_IMU_POSE}"
            given = [("", se3.identity())]
        T_cam_B.append(given[0][1])
        notes += compare_poses(part.where, given)
    poses = np.stack(T_cam_B)
    notes += _compare_pairs(entry, poses) + models.note_line_delays(entry, cameras)
    notes += note_unknown_keys(entry, _NOT_OF_THE_CALIBRATION)
    if why:  # the body is the first camera
        poses = se3.compose(poses, se3.inverse(poses[0]))
    return Parts("kalibr", cameras, se3.inverse(poses), why_not_on_imu=why, notes=notes)


def _camera_number(key: object) -> int | None:
    """Return the number of a key cam0, cam1, ..., None for others."""
    text = str(key)
    digits = text.removeprefix("cam")
    is_camera = text.startswith("cam") and digits.isdecimal() and len(digits) < 3
    return int(digits) if is_camera and digits.isascii() else None


def _given_poses(entry: yaml_entry.Entry, before: list[F64]) -> list[tuple[str, F64]]:
    """Return all poses T_cam_B (7,) that a camera has, by key, the one that counts first."""
    given = []
    if "T_cam_imu" in entry:
        given.append(("T_cam_imu", entry.pose("T_cam_imu")))
    if "T_imu_cam" in entry:
        given.append(("T_imu_cam", se3.inverse(entry.pose("T_imu_cam"))))
    if "T_cn_cnm1" in entry:
        T_cn_cnm1 = entry.pose("T_cn_cnm1")
        if before:
            given.append(("T_cn_cnm1", se3.compose(T_cn_cnm1, before[-1])))
    return given


def _compare_pairs(entry: yaml_entry.Entry, T_cam_B: F64) -> list[str]:
    """Return notes where T_cam1_cam0 contradicts the poses of the cameras."""
    notes = []
    for key in entry:
        match = _PAIR.match(str(key))
        if match and max(int(n) for n in match.groups()) < len(T_cam_B):
            a, b = (T_cam_B[int(n)] for n in match.groups())
            poses = [
                ("T_cam_imu", se3.compose(a, se3.inverse(b))),
                (str(key), entry.pose(str(key))),
            ]
            notes += compare_poses(entry.where, poses)
    return notes


def read_kalibr_imu(top: yaml_entry.Entry) -> Parts:
    """Return the IMU of kalibr's or OpenVINS' IMU file; B is the frame i that cameras refer to.

    Raises:
        MapError: A key is missing or wrong, or a model is not supported.
    """
    entry = top.child("imu0") if "imu0" in top else top
    if "imu1" in top:
        raise MapError(f"{top.where}: several IMUs are not supported: keep imu0 only")
    if "T_i_b" in entry and not _is_identity(entry.pose("T_i_b"), se3.identity()):
        raise MapError(f"{entry.where}: key 'T_i_b' of the only IMU must be the identity")
    if abs(entry.number("time_offset", 0.0)) > 0.0:
        raise MapError(f"{entry.where}: key 'time_offset' of the only IMU must be 0")
    imu = models.read_imu(entry, models.KALIBR_NOISE, topic=entry.text("rostopic"))
    imu, T_I_i = with_measurement_matrices(imu, *_measurement_matrices(entry))
    notes = note_unknown_keys(top, (*_NOT_OF_THE_CALIBRATION, "integration_sigma"))
    return Parts("kalibr", imu=imu, T_B_I=se3.inverse(T_I_i), notes=notes)


def with_measurement_matrices(imu: Imu, W: F64, A: F64) -> tuple[Imu, F64]:
    """Return the IMU whose measurements are w = W w_i + b_g and a = A f_i + b_a, and T_I_i (7,).

    Args:
        imu: IMU without intrinsics.
        W: Matrix (3, 3) of the gyroscope, determinant positive.
        A: Matrix (3, 3) of the accelerometer, determinant positive.
    """
    if _is_identity(W, np.eye(3)) and _is_identity(A, np.eye(3)):
        return imu, se3.identity()
    T_g, R_I_i = upper_triangular_and_rotation(W)
    T_a, R_A_I = upper_triangular_and_rotation(A @ R_I_i.T)
    T_I_i = se3.make(so3.from_matrix(R_I_i), np.zeros(3))
    return dataclasses.replace(imu, intrinsics=ImuIntrinsics(T_g, T_a, R_A_I)), T_I_i


def _measurement_matrices(entry: yaml_entry.Entry) -> tuple[F64, F64]:
    """Return W and A (3, 3), after the model of the entry."""
    model = entry.text("model", default="calibrated")
    if "gyroscopes" in entry or "accelerometers" in entry or model.startswith("scale-mis"):
        gyroscope, accelerometer = entry.child("gyroscopes"), entry.child("accelerometers")
        _refuse_sensitivity(gyroscope, "A")
        for key in ("rx_i", "ry_i", "rz_i"):
            if key in accelerometer and np.any(accelerometer.vector(key, 3) != 0.0):
                raise MapError(
                    f"{accelerometer.where}: key '{key}': the size effect is not modelled: "
                    "calibrate with the model scale-misalignment"
                )
        W = gyroscope.matrix("M", 3, 3) @ gyroscope.rotation("C_gyro_i")
        return _invertible(W, gyroscope), _invertible(
            accelerometer.matrix("M", 3, 3), accelerometer
        )
    _refuse_sensitivity(entry, "Tg")
    W = _matrix_or_identity(entry, "Tw") @ _matrix_or_identity(entry, "R_IMUtoGYRO")
    A = _matrix_or_identity(entry, "Ta") @ _matrix_or_identity(entry, "R_IMUtoACC")
    return _invertible(W, entry), _invertible(A, entry)


def upper_triangular_and_rotation(matrix: F64) -> tuple[F64, F64]:
    """Return T and R with T R = matrix (3, 3), T upper triangular with a positive diagonal.

    R is a rotation if the determinant of the matrix is positive.
    """
    flip = np.eye(3)[::-1]
    q, r = np.linalg.qr((flip @ matrix).T)
    T, R = flip @ r.T @ flip, flip @ q.T
    signs = np.where(np.diag(T) < 0.0, -1.0, 1.0)
    return np.triu(T * signs), R * signs[:, None]


def _matrix_or_identity(entry: yaml_entry.Entry, key: str) -> F64:
    return entry.matrix(key, 3, 3) if key in entry else np.eye(3)


def _refuse_sensitivity(entry: yaml_entry.Entry, key: str) -> None:
    if key in entry and np.any(entry.matrix(key, 3, 3) != 0.0):
        raise MapError(
            f"{entry.where}: key '{key}': the gyroscope's sensitivity to acceleration is not "
            "modelled: calibrate without it"
        )


def _invertible(matrix: F64, entry: yaml_entry.Entry) -> F64:
    if np.linalg.det(matrix) <= 0.0:
        raise MapError(
            f"{entry.where}: scale and misalignment do not form a valid matrix: the determinant must be "
            "positive"
        )
    return matrix


def _is_identity(value: F64, identity: F64) -> bool:
    return bool(np.max(np.abs(value - identity)) < _IDENTITY_TOLERANCE)
