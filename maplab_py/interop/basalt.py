"""Basalt's calibration.json, the inverse of its export.

Basalt corrects f_i = (1 + S_a) a - b_a and w_i = (1 + S_g) w - b_g, with S_a lower triangular; poses of
cameras are `T_imu_cam` on its frame i (basalt-headers, calib_bias.hpp and calibration.hpp).
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from maplab_py.array_types import F64
from maplab_py.errors import MapError
from maplab_py.geometry import se3
from maplab_py.input_files import read_text
from maplab_py.interop.recordings.kalibr import with_measurement_matrices
from maplab_py.interop.recordings.models import make_device
from maplab_py.interop.recordings.protocol import RecordedSensors
from maplab_py.sensors import Camera, Distortion, Imu, Projection
from maplab_py.sensors.yaml_entry import Entry

_MAX_BYTES = 16_000_000
_UNIT_TOLERANCE = 1e-3
_PINHOLE = ("fx", "fy", "cx", "cy")
_MODELS = {
    "pinhole": (Distortion.NONE, ()),
    "kb4": (Distortion.EQUIDISTANT, ("k1", "k2", "k3", "k4")),
    "pinhole-radtan8": (Distortion.RADTAN, ("k1", "k2", "p1", "p2")),
    "fov": (Distortion.FOV, ("w",)),
}


def read_basalt(path: Path) -> RecordedSensors:
    """Read a calibration of Basalt; biases, the vignette and poses of markers are not used.

    Raises:
        MapError: The file cannot be read, a key is missing or wrong, or a model is not supported.
    """
    top = Entry(_read_json(path), str(path))
    entry = top.child("value0") if "value0" in top else top
    parts = [_entries(entry, key) for key in ("T_imu_cam", "intrinsics")]
    sizes = entry.items("resolution")
    if not parts[0] or not len(parts[0]) == len(parts[1]) == len(sizes):
        raise MapError(
            f"{entry.where}: 'T_imu_cam', 'intrinsics' and 'resolution' need an entry per camera"
        )
    offset_ns = entry.integer("cam_time_offset_ns", 0)
    resolution = entry.matrix("resolution", len(sizes), 2)
    if np.any(resolution < 1) or np.any(resolution != np.round(resolution)):
        raise MapError(f"{entry.where}: key 'resolution' wants positive whole numbers")
    cameras = [
        _camera(part, int(size[0]), int(size[1]), offset_ns)
        for part, size in zip(parts[1], resolution, strict=True)
    ]
    imu, T_I_i = _imu(entry)
    T_i_C = np.stack([_pose(part) for part in parts[0]])
    return make_device(cameras, se3.compose(T_I_i, T_i_C), imu)


def _read_json(path: Path) -> object:
    try:
        text = read_text(path, _MAX_BYTES, remedy="it is no calibration", error=MapError)
        value: object = json.loads(text)
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        raise MapError(f"cannot read {path}: {reason}") from error
    except (ValueError, RecursionError) as error:
        raise MapError(f"{path}: not valid JSON: {error}") from error
    return value


def _entries(entry: Entry, key: str) -> list[Entry]:
    return [
        Entry(value, f"{entry.where}: {key}[{row}]") for row, value in enumerate(entry.items(key))
    ]


def _pose(entry: Entry) -> F64:
    """Return the pose (7,) of keys qx ... pz."""
    values = np.array([entry.number(key) for key in ("qx", "qy", "qz", "qw", "px", "py", "pz")])
    norm = float(np.linalg.norm(values[:4]))
    if abs(norm - 1.0) > _UNIT_TOLERANCE:
        raise MapError(f"{entry.where}: the quaternion is not of unit length")
    return np.concatenate([values[:4] / norm, values[4:]])


def _camera(entry: Entry, width_px: int, height_px: int, offset_ns: int) -> Camera:
    name = entry.text("camera_type")
    values = entry.child("intrinsics")
    pinhole = np.array([values.number(key, positive=key[0] == "f") for key in _PINHOLE])
    projection, distortion, parameters = Projection.PINHOLE, Distortion.NONE, np.zeros(0)
    if name == "ucm" or (name == "eucm" and values.number("beta") == 1.0):
        # x / (alpha d + (1 - alpha) z) is Mei's model with xi = alpha / (1 - alpha)
        alpha = values.number("alpha")
        if not 0.0 <= alpha < 1.0:
            raise MapError(f"{values.where}: key 'alpha' must be from 0 to 1, 1 excluded")
        projection = Projection.UNIFIED
        pinhole[:2] /= 1.0 - alpha
        pinhole = np.concatenate([[alpha / (1.0 - alpha)], pinhole])
    elif name in _MODELS:
        distortion, names = _MODELS[name]
        parameters = np.array([values.number(key) for key in names])
        _refuse_more_terms(values, name)
    else:
        known = ", ".join([*_MODELS, "ucm"])
        raise MapError(
            f"{entry.where}: key 'camera_type': '{name}' is not supported: calibrate with one of {known}"
        )
    return Camera(
        id="",
        projection=projection,
        distortion=distortion,
        intrinsics=pinhole,
        distortion_parameters=parameters,
        width_px=width_px,
        height_px=height_px,
        time_offset_ns=offset_ns,
    )


def _refuse_more_terms(values: Entry, name: str) -> None:
    if name != "pinhole-radtan8":
        return
    for key in ("k3", "k4", "k5", "k6"):
        if values.number(key, 0.0) != 0.0:
            raise MapError(
                f"{values.where}: key '{key}': four distortion parameters (k1 k2 p1 p2) are supported: "
                "calibrate with kb4, or with the others at 0"
            )


def _imu(entry: Entry) -> tuple[Imu, F64]:
    """Return the IMU and T_I_i (7,)."""
    imu = Imu(
        id="",
        acc_noise_density=_noise(entry, "accel_noise_std"),
        acc_bias_random_walk_noise_density=_noise(entry, "accel_bias_std"),
        gyro_noise_density=_noise(entry, "gyro_noise_std"),
        gyro_bias_random_walk_noise_density=_noise(entry, "gyro_bias_std"),
    )
    a, g = entry.vector("calib_accel_bias", 9), entry.vector("calib_gyro_bias", 12)
    S_a = np.array([[a[3], 0.0, 0.0], [a[4], a[6], 0.0], [a[5], a[7], a[8]]])
    corrections = [np.eye(3) + S_a, np.eye(3) + g[3:].reshape(3, 3).T]
    if min(np.linalg.det(matrix) for matrix in corrections) <= 0.0:
        raise MapError(f"{entry.where}: scale and misalignment of the IMU are no proper matrices")
    A, W = (np.linalg.inv(matrix) for matrix in corrections)
    return with_measurement_matrices(imu, W, A)


def _noise(entry: Entry, key: str) -> float:
    """Return the largest noise density of the three axes; old files have one number."""
    value = entry.raw(key)
    count = len(value) if isinstance(value, list) else 0
    densities = entry.vector(key, 3) if count else np.array([entry.number(key)])
    if np.any(densities <= 0.0):
        raise MapError(f"{entry.where}: key '{key}' must be positive")
    return float(densities.max())
