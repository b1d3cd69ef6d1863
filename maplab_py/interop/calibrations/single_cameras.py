"""Files of one camera without its pose: ROS' CameraInfo, OpenCV's calibration, DSO's and DM-VIO's text."""

import dataclasses
import re
from pathlib import Path

import numpy as np

from maplab_py.array_types import F64
from maplab_py.errors import MapError
from maplab_py.geometry import se3
from maplab_py.interop.calibrations.models import make_camera, read_time_shift_ns
from maplab_py.interop.calibrations.parts import Parts, note_unknown_keys, read_calibration_text
from maplab_py.sensors import Camera, yaml_entry

_ON_CAMERA: F64 = np.eye(1, 7, 3)
_MATRICES = ("camera_matrix", "Camera_Matrix", "K", "k")
_TERMS = ("distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "D", "d")
_NOT_OF_THE_CALIBRATION = (
    *("header", "rectification_matrix", "projection_matrix", "local_transform", "R", "P", "r", "p"),
    *("calibration_time", "nframes", "nr_of_frames", "board_width", "board_height", "square_size"),
    *("avg_reprojection_error", "per_view_reprojection_errors", "extrinsic_parameters", "flags"),
    *("image_points", "grid_points", "fixed_aspect_ratio", "aspectRatio", "fixedAspectRatio"),
)
_DSO_MODELS = {
    "pinhole": ("none", 0),
    "radtan": ("radtan", 4),
    "equidistant": ("equidistant", 4),
    "kannalabrandt": ("equidistant", 4),
    "fov": ("fov", 1),
}
_DSO_FIRST = re.compile(r"\s*(?:[A-Za-z]+\s+)?(?:[-+0-9.eE]+\s+){4}[-+0-9.eE]+")


def is_camera_info(entry: yaml_entry.Entry) -> bool:
    """Tell whether a file is ROS' CameraInfo, or of OpenCV's calibration."""
    return any(key in entry for key in _MATRICES) and any(
        key in entry for key in ("image_width", "width")
    )


def read_camera_info(entry: yaml_entry.Entry) -> Parts:
    """Return the camera; `distortion_model` is OpenCV's polynomial where the file does not say.

    Raises:
        MapError: A key is missing or wrong, or a model is not supported.
    """
    K = entry.matrix(next(key for key in _MATRICES if key in entry), 3, 3)
    if not np.any(K):
        raise MapError(f"{entry.where}: the camera is not calibrated: its matrix is zero")
    key = next((key for key in _TERMS if key in entry), "")
    terms = entry.numbers(key) if key else np.zeros(0)
    model = entry.text("distortion_model", default="plumb_bob") or "plumb_bob"
    size = [
        entry.integer(names[0] if names[0] in entry else names[1])
        for names in (("image_width", "width"), ("image_height", "height"))
    ]
    if entry.integer("binning_x", 0) > 1 or entry.integer("binning_y", 0) > 1:
        raise MapError(f"{entry.where}: key 'binning_x': calibrate images without binning")
    entry.text("camera_name")
    intrinsics = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    names = ("camera_model", "pinhole"), ("distortion_model", model)
    camera = make_camera(entry, *names, intrinsics, terms, size)
    notes = note_unknown_keys(entry, (*_NOT_OF_THE_CALIBRATION, "roi"))
    if "roi" in entry and any(entry.child("roi").number(k, 0.0) for k in ("width", "height")):
        notes.append(f"{entry.where}: 'roi' is not used: the calibration is of the full image")
    why = f"{entry.where}: a CameraInfo has no pose on the IMU: calibrate both together (kalibr)"
    return Parts("CameraInfo", [camera], _ON_CAMERA, why_not_on_imu=why, notes=notes)


def is_dso_camera(path: Path) -> bool:
    """Return whether a file begins like a camera of DSO."""
    return path.is_file() and bool(_DSO_FIRST.match(read_calibration_text(path)))


def read_dso_camera(path: Path) -> Parts:
    """Return the camera of DSO's or DM-VIO's file; focal lengths below 1 are those of a width of 1.

    Raises:
        MapError: A line is wrong, or a model is not supported.
    """
    why = f"{path}: a camera of DM-VIO has no pose on the IMU: give its camchain.yaml"
    return Parts("DM-VIO", [dso_camera(path)], _ON_CAMERA, why_not_on_imu=why)


def read_dm_vio(entry: yaml_entry.Entry, path: Path) -> Parts:
    """Return the camera of a camchain.yaml that has its pose alone; camera*.txt beside it has the rest.

    Raises:
        MapError: There is none or several, or a file is wrong.
    """
    files = sorted(path.parent.glob("camera*.txt"))
    part = entry.child("cam0")
    if len(files) != 1:
        raise MapError(
            f"{part.where}: key 'intrinsics' is missing, and there is no one camera.txt of DM-VIO beside it"
        )
    offset_ns = read_time_shift_ns(part, "timeshift_cam_imu")
    camera = dataclasses.replace(
        dso_camera(files[0]), topic=part.text("rostopic"), time_offset_ns=offset_ns
    )
    T_imu_cam = se3.inverse(part.pose("T_cam_imu"))
    notes = [f"{part.where}: the intrinsics are those of {files[0]}"]
    return Parts("DM-VIO", [camera], T_imu_cam[None], notes=notes + note_unknown_keys(entry))


def dso_camera(path: Path) -> Camera:
    """Return the camera of DSO's or DM-VIO's file.

    Raises:
        MapError: A line is wrong, or a model is not supported.
    """
    lines = [line.split() for line in read_calibration_text(path).splitlines() if line.strip()]
    words = lines[0] if lines else []
    name = words[0] if words and words[0].isalpha() else ""
    values = _numbers(path, 1, words[1:] if name else words)
    size = _numbers(path, 2, lines[1] if len(lines) > 1 else [])
    if not name and len(values) == 5:
        name = "fov" if values[4] != 0.0 else "pinhole"
    if name.lower() not in _DSO_MODELS:
        known = "Pinhole, RadTan, EquiDistant, KannalaBrandt, FOV"
        raise MapError(
            f"{path}:1: camera model '{name}' is not supported: calibrate with one of {known}"
        )
    distortion, count = _DSO_MODELS[name.lower()]
    if len(values) < 4 + count or len(size) != 2:
        raise MapError(
            f"{path}: wants fx fy cx cy and {count} distortion parameters in the first line, width and "
            "height in the second"
        )
    pinhole = values[:4]
    if pinhole[2] < 1.0 and pinhole[3] < 1.0:
        pinhole = np.concatenate([pinhole[:2] * size, pinhole[2:] * size - 0.5])
    terms = values[4 : 4 + count]
    if distortion == "none" and np.any(values[4:]):
        raise MapError(f"{path}:1: a pinhole camera has no distortion parameters")
    entry = yaml_entry.Entry({}, str(path))
    return make_camera(entry, ("model", "pinhole"), ("model", distortion), pinhole, terms, size)


def _numbers(path: Path, line: int, words: list[str]) -> F64:
    try:
        values = np.array([float(word) for word in words], dtype=np.float64)
    except ValueError as error:
        raise MapError(f"{path}:{line}: {error}") from None
    if not np.all(np.isfinite(values)):
        raise MapError(f"{path}:{line}: has entries that are not finite numbers")
    return values
