"""kalibr's results: the camera chain, and the IMU file of kalibr, OpenVINS and their relatives.

Poses `T_cam_imu` (or OpenVINS' inverse, `T_imu_cam`) refer to a frame i of the IMU. Its
measurements are w = W w_i + b_g and a = A f_i + b_a. Ours are in the frame I in which W becomes
upper triangular: W = T_g R_I_i and A = T_a R_A_I R_I_i; both are RQ decompositions.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from maplab_py.array_types import F64
from maplab_py.errors import MapError
from maplab_py.geometry import se3, so3
from maplab_py.interop.recordings.models import make_device, read_camera, read_entry, read_imu_noise
from maplab_py.interop.recordings.protocol import RecordedSensors
from maplab_py.sensors import Camera, Imu, ImuIntrinsics
from maplab_py.sensors.yaml_entry import Entry

_IDENTITY_TOLERANCE = 1e-9


def read_kalibr(camchain: Path, imu_file: Path | None) -> RecordedSensors:
    """Read a camera chain, and an IMU file unless it is None.

    Raises:
        MapError: A file cannot be read, a key is missing or wrong, or a model is not supported.
    """
    top = read_entry(camchain)
    cameras, T_cam_i = _read_chain(top, needs_imu=imu_file is not None)
    if imu_file is None:
        # without an IMU the body is the first camera
        return make_device(cameras, se3.compose(T_cam_i[0], se3.inverse(T_cam_i)), None)
    imu, T_I_i = read_kalibr_imu(imu_file)
    return make_device(cameras, se3.compose(T_I_i, se3.inverse(T_cam_i)), imu)


def is_camera_chain(entry: Entry) -> bool:
    """Tell whether a calibration file is kalibr's camera chain."""
    return "cam0" in entry


def _read_chain(top: Entry, *, needs_imu: bool) -> tuple[list[Camera], F64]:
    """Return the cameras and their poses T_cam_i (C, 7)."""
    if not is_camera_chain(top):
        raise MapError(f"{top.where}: key 'cam0' is missing: this is not a kalibr camera chain")
    cameras: list[Camera] = []
    poses: list[F64] = []
    while f"cam{len(cameras)}" in top:
        entry = top.child(f"cam{len(cameras)}")
        cameras.append(
            dataclasses.replace(
                read_camera(entry, "distortion_coeffs"),
                topic=entry.text("rostopic"),
                time_offset_ns=round(1e9 * entry.number("timeshift_cam_imu", 0.0)),
            )
        )
        poses.append(_camera_pose(entry, poses, needs_imu=needs_imu))
    return cameras, np.stack(poses)


def _camera_pose(entry: Entry, before: list[F64], *, needs_imu: bool) -> F64:
    """Return T_cam_i (7,) of the camera that follows those `before`."""
    if "T_cam_imu" in entry:
        return entry.pose("T_cam_imu")
    if "T_imu_cam" in entry:
        return se3.inverse(entry.pose("T_imu_cam"))
    if "T_cn_cnm1" in entry and before:
        return se3.compose(entry.pose("T_cn_cnm1"), before[-1])
    if not before and not needs_imu:
        return se3.identity()
    raise MapError(
        f"{entry.where}: key 'T_cam_imu' is missing: calibrate cameras and IMU together "
        "(kalibr_calibrate_imu_camera)"
    )


def read_kalibr_imu(path: Path) -> tuple[Imu, F64]:
    """Return the IMU of kalibr's or OpenVINS' IMU file, and T_I_i (7,).

    Raises:
        MapError: The file cannot be read, a key is missing or wrong, or a model is not supported.
    """
    top = read_entry(path)
    entry = top.child("imu0") if "imu0" in top else top
    if "imu1" in top:
        raise MapError(f"{path}: several IMUs are not supported: keep imu0 only")
    if "T_i_b" in entry and not _is_identity(entry.pose("T_i_b"), se3.identity()):
        raise MapError(f"{entry.where}: key 'T_i_b' of the only IMU must be the identity")
    if abs(entry.number("time_offset", 0.0)) > 0.0:
        raise MapError(f"{entry.where}: key 'time_offset' of the only IMU must be 0")
    imu = dataclasses.replace(read_imu_noise(entry), topic=entry.text("rostopic"))
    return with_measurement_matrices(imu, *_measurement_matrices(entry))


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


def _measurement_matrices(entry: Entry) -> tuple[F64, F64]:
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


def _matrix_or_identity(entry: Entry, key: str) -> F64:
    return entry.matrix(key, 3, 3) if key in entry else np.eye(3)


def _refuse_sensitivity(entry: Entry, key: str) -> None:
    if key in entry and np.any(entry.matrix(key, 3, 3) != 0.0):
        raise MapError(
            f"{entry.where}: key '{key}': the gyroscope's sensitivity to acceleration is not "
            "modelled: calibrate without it"
        )


def _invertible(matrix: F64, entry: Entry) -> F64:
    if np.linalg.det(matrix) <= 0.0:
        raise MapError(
            f"{entry.where}: scale and misalignment do not form a valid matrix: the determinant must be "
            "positive"
        )
    return matrix


def _is_identity(value: F64, identity: F64) -> bool:
    return bool(np.max(np.abs(value - identity)) < _IDENTITY_TOLERANCE)
