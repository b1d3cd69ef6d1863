"""Basalt's calibration.json, the inverse of its export.

Basalt corrects f_i = (1 + S_a) a - b_a and w_i = (1 + S_g) w - b_g, with S_a lower triangular; poses of
cameras are `T_imu_cam` on its frame i (basalt-headers, calib_bias.hpp and calibration.hpp).
"""

import numpy as np

from maplab_py.array_types import F64
from maplab_py.errors import MapError
from maplab_py.geometry import se3
from maplab_py.interop.calibrations import kalibr, models, parts
from maplab_py.sensors import Camera, Imu, yaml_entry

_UNIT_TOLERANCE = 1e-3
_MAX_TIME_OFFSET_NS = 10_000_000_000
_NOT_OF_THE_CALIBRATION = (
    *("vignette", "imu_update_rate", "rpmax", "calib_mag_bias"),
    *("T_mocap_world", "T_imu_marker", "mocap_time_offset_ns", "mocap_to_imu_offset_ns"),
)
_PINHOLE = ("fx", "fy", "cx", "cy")
_TERMS = {
    "pinhole": ("pinhole", "none", (), ()),
    "kb4": ("pinhole", "equidistant", (), ("k1", "k2", "k3", "k4")),
    "pinhole-radtan8": (
        *("pinhole", "rational_polynomial", ()),
        ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    ),
    "fov": ("pinhole", "fov", (), ("w",)),
    "ds": ("ds", "none", ("xi", "alpha"), ()),
    "eucm": ("eucm", "none", ("alpha", "beta"), ()),
    "ucm": ("omni", "none", ("alpha",), ()),
}
"""Projection, distortion, and the names of their parameters by Basalt's names of models."""


def read_basalt(top: yaml_entry.Entry) -> parts.Parts:
    """Read a calibration of Basalt; biases, the vignette and poses of markers are not used.

    Raises:
        MapError: A key is missing or wrong, or a model is not supported.
    """
    entry = top.child("value0") if "value0" in top else top
    poses, lenses = entry.entries("T_imu_cam"), entry.entries("intrinsics")
    sizes = entry.items("resolution")
    if not poses or not len(poses) == len(lenses) == len(sizes):
        raise MapError(
            f"{entry.where}: 'T_imu_cam', 'intrinsics' and 'resolution' need an entry per camera"
        )
    offset_ns = entry.integer("cam_time_offset_ns", 0)
    if abs(offset_ns) > _MAX_TIME_OFFSET_NS:
        raise MapError(
            f"{entry.where}: key 'cam_time_offset_ns': {1e-9 * offset_ns:g} s: it must be below 10 s: give "
            "nanoseconds"
        )
    resolution = entry.matrix("resolution", len(sizes), 2)
    if np.any(resolution < 1) or np.any(resolution != np.round(resolution)):
        raise MapError(f"{entry.where}: key 'resolution' wants positive whole numbers")
    cameras = [
        _camera(part, int(size[0]), int(size[1]), offset_ns)
        for part, size in zip(lenses, resolution, strict=True)
    ]
    imu, T_I_i = _imu(entry)
    T_i_C = np.stack([_pose(part) for part in poses])
    notes = parts.note_unknown_keys(top, _NOT_OF_THE_CALIBRATION)
    return parts.Parts("Basalt", cameras, T_i_C, imu, se3.inverse(T_I_i), notes=notes)


def _pose(entry: yaml_entry.Entry) -> F64:
    """Return the pose (7,) of keys qx ... pz."""
    values = np.array([entry.number(key) for key in ("qx", "qy", "qz", "qw", "px", "py", "pz")])
    norm = float(np.linalg.norm(values[:4]))
    if abs(norm - 1.0) > _UNIT_TOLERANCE:
        raise MapError(f"{entry.where}: the quaternion is not of unit length")
    return np.concatenate([values[:4] / norm, values[4:]])


def _camera(entry: yaml_entry.Entry, width_px: int, height_px: int, offset_ns: int) -> Camera:
    name = entry.text("camera_type")
    if name not in _TERMS:
        raise MapError(
            f"{entry.where}: key 'camera_type': '{name}' is not supported: calibrate with one of "
            f"{', '.join(_TERMS)}"
        )
    projection, distortion, mirror_names, names = _TERMS[name]
    values = entry.child("intrinsics")
    focal = np.array([values.number(key, positive=True) for key in _PINHOLE[:2]])
    centre = [values.number(key) for key in _PINHOLE[2:]]
    mirror = [values.number(key) for key in mirror_names]
    if name == "ucm":
        # x / (alpha d + (1 - alpha) z) is Mei's model with xi = alpha / (1 - alpha)
        alpha = mirror[0]
        if not 0.0 <= alpha < 1.0:
            raise MapError(f"{values.where}: key 'alpha' must be from 0 to 1, 1 excluded")
        mirror, focal = [alpha / (1.0 - alpha)], focal / (1.0 - alpha)
    coefficients = [values.number(key, None if row < 4 else 0.0) for row, key in enumerate(names)]
    return models.make_camera(
        values,
        ("camera_type", projection),
        ("camera_type", distortion),
        [*mirror, *focal, *centre],
        coefficients,
        (width_px, height_px),
        time_offset_ns=offset_ns,
    )


def _imu(entry: yaml_entry.Entry) -> tuple[Imu, F64]:
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
    return kalibr.with_measurement_matrices(imu, W, A)


def _noise(entry: yaml_entry.Entry, key: str) -> float:
    """Return the largest noise density of the three axes; old files have one number."""
    value = entry.raw(key)
    count = len(value) if isinstance(value, list) else 0
    densities = entry.vector(key, 3) if count else np.array([entry.number(key)])
    if np.any(densities <= 0.0):
        raise MapError(f"{entry.where}: key '{key}' must be positive")
    return float(densities.max())
