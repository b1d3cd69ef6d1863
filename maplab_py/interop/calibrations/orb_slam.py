"""Settings of ORB-SLAM2 and 3 (both forms of their keys) and of stella_vslam.

`T_b_c1` (formerly `Tbc`) takes points of the first camera to the IMU, `T_c1_c2` (`Tlr`) those of the second
to the first.
"""

from typing import Any

import numpy as np

from maplab_py.array_types import F64
from maplab_py.errors import MapError
from maplab_py.geometry import se3, so3
from maplab_py.interop.calibrations.models import make_camera, read_imu
from maplab_py.interop.calibrations.parts import Parts, note_unknown_keys
from maplab_py.sensors import Camera, Imu
from maplab_py.sensors.yaml_entry import Entry

_PINHOLE = ("fx", "fy", "cx", "cy")
_TERMS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_MODELS = {
    "pinhole": "radtan",
    "rectified": "radtan",
    "perspective": "radtan",
    "kannalabrandt8": "equidistant",
    "fisheye": "equidistant",
}
"""Distortion by the name of the camera's model."""


def is_orb_slam(entry: Entry) -> bool:
    """Tell whether a file has settings of ORB-SLAM or stella_vslam."""
    group = entry.raw("Camera") if "Camera" in entry else None
    is_group = isinstance(group, dict) and ("model" in group or "fx" in group)
    keys = ("Camera.fx", "Camera1.fx", "Camera.model", "LEFT.K")
    return is_group or any(key in entry for key in keys)


def read_orb_slam(entry: Entry) -> Parts:
    """Return cameras and IMU of the settings.

    Raises:
        MapError: A key is missing or wrong, or a model is not supported.
    """
    camera = _group(entry, "Camera")
    is_stella = "model" in camera
    model = camera.text("model", "type", default="PinHole")
    if model.lower() not in _MODELS:
        raise MapError(
            f"{camera.where}: model '{model}' is not supported: calibrate as "
            f"{', '.join(sorted(_MODELS))}"
        )
    size = _size(camera)
    rectifier = _rectifier(entry, is_stella=is_stella)
    notes: list[str] = []
    if rectifier is not None:
        cameras, T_C0_C = _unrectified(camera, rectifier, size)
    else:
        cameras, T_C0_C = _cameras(entry, camera, model, size, notes)
    T_b_c1 = next((entry.pose(key) for key in ("IMU.T_b_c1", "Tbc") if key in entry), None)
    imu = _imu(entry)
    why = "" if T_b_c1 is not None else f"{entry.where}: key 'IMU.T_b_c1' (or 'Tbc') is missing"
    if imu is not None and why:
        raise MapError(why)
    T_B_C = T_C0_C if T_b_c1 is None else se3.compose(T_b_c1, T_C0_C)
    notes += note_unknown_keys(entry, settings=True)
    form = "stella_vslam" if is_stella else "ORB-SLAM"
    return Parts(form, cameras, T_B_C, imu, why_not_on_imu=why, notes=notes)


def _group(entry: Entry, name: str) -> Entry:
    """Return the keys NAME.key, or the mapping under NAME."""
    if name in entry and isinstance(entry.raw(name), dict):
        return entry.child(name)
    values = {
        str(key).removeprefix(f"{name}."): entry.raw(key)
        for key in list(entry)
        if str(key).startswith(f"{name}.") and key in entry
    }
    return Entry(values, f"{entry.where}: {name}")


def _size(camera: Entry) -> tuple[float, float]:
    keys = ("cols", "rows") if "cols" in camera else ("width", "height")
    return camera.integer(keys[0]), camera.integer(keys[1])


def _cameras(
    entry: Entry, camera: Entry, model: str, size: tuple[float, float], notes: list[str]
) -> tuple[list[Camera], F64]:
    """Return the cameras and their poses on the first one (n, 7)."""
    new_form = _group(entry, "Camera1")
    first = new_form if "fx" in new_form else camera
    cameras = [_camera(first, model, size)]
    second = _group(entry, "Camera2")
    T_c1_c2 = next((entry.pose(key) for key in ("Stereo.T_c1_c2", "Tlr") if key in entry), None)
    if "fx" in second:
        if T_c1_c2 is None:
            raise MapError(f"{entry.where}: key 'Stereo.T_c1_c2' (or 'Tlr') is missing")
        cameras.append(_camera(second, model, size))
    elif (baseline_m := _baseline_m(entry, camera, model, cameras[0])) > 0.0:
        T_c1_c2 = np.array([0.0, 0.0, 0.0, 1.0, baseline_m, 0.0, 0.0])
        cameras.append(cameras[0])
        notes.append(f"{entry.where}: two rectified cameras, {1e3 * baseline_m:.4g} mm apart")
    else:
        T_c1_c2 = None
    for part in (new_form, second):
        notes += note_unknown_keys(part, settings=True)
    poses = [se3.identity()] + ([] if T_c1_c2 is None else [T_c1_c2])
    return cameras, np.stack(poses)


def _camera(entry: Entry, model: str, size: tuple[float, float]) -> Camera:
    distortion = _MODELS[model.lower()]
    pinhole = [entry.number(key) for key in _PINHOLE]
    names = ("k1", "k2", "k3", "k4") if distortion == "equidistant" else _TERMS
    coefficients = [entry.number(key, 0.0) for key in names]
    return make_camera(
        entry, ("type", "pinhole"), ("type", distortion), pinhole, coefficients, size
    )


def _baseline_m(entry: Entry, camera: Entry, model: str, first: Camera) -> float:
    """Return the baseline of a rectified pair, 0 if there is one camera or a depth camera."""
    if model.lower() == "rectified" and "Stereo.b" in entry:
        return entry.number("Stereo.b", positive=True)
    if camera.text("setup") == "stereo":
        return camera.number("focal_x_baseline", positive=True) / float(first.intrinsics[0])
    has_depth = "DepthMapFactor" in entry or "RGBD.DepthMapFactor" in entry
    if "bf" in camera and not has_depth and "model" not in camera:
        return camera.number("bf", positive=True) / float(first.intrinsics[0])
    return 0.0


def _rectifier(entry: Entry, *, is_stella: bool) -> Entry | None:
    """Return the matrices of both images before rectification, as K_left, D_left, R_left, ...."""
    if is_stella:
        group = _group(entry, "StereoRectifier")
        return group if "K_left" in group else None
    if "LEFT.K" not in entry or "RIGHT.K" not in entry:
        return None
    values: dict[str, Any] = {
        f"{key}_{side.lower()}": entry.raw(f"{side}.{key}")
        for side in ("LEFT", "RIGHT")
        for key in ("K", "D", "R")
    }
    if "RIGHT.P" in entry:
        P = entry.matrix("RIGHT.P", 3, 4)
        values["baseline"] = float(-P[0, 3] / P[0, 0]) if P[0, 0] > 0.0 else 0.0
    return Entry(values, entry.where)


def _unrectified(
    camera: Entry, rectifier: Entry, size: tuple[float, float]
) -> tuple[list[Camera], F64]:
    """Return the cameras before rectification: R_left p_left = R_right p_right + (b, 0, 0)."""
    model = rectifier.text("model", default="perspective")
    cameras = []
    for side in ("left", "right"):
        K = rectifier.matrix(f"K_{side}", 3, 3)
        coefficients = rectifier.numbers(f"D_{side}")
        intrinsics = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
        distortion = _MODELS.get(model.lower(), model)
        cameras.append(
            make_camera(
                rectifier, ("K", "pinhole"), ("model", distortion), intrinsics, coefficients, size
            )
        )
    R_rect_left, R_rect_right = rectifier.rotation("R_left"), rectifier.rotation("R_right")
    if "baseline" in rectifier:
        baseline_m = rectifier.number("baseline", positive=True)
    else:
        key = "focal_x_baseline" if "focal_x_baseline" in camera else "bf"
        baseline_m = camera.number(key, positive=True) / camera.number("fx", positive=True)
    R_left_right = R_rect_left.T @ R_rect_right
    second = se3.make(so3.from_matrix(R_left_right), R_rect_left.T @ [baseline_m, 0.0, 0.0])
    return cameras, np.stack([se3.identity(), second])


def _imu(entry: Entry) -> Imu | None:
    if "IMU.NoiseGyro" not in entry and "IMU.NoiseAcc" not in entry:
        return None
    return read_imu(entry, ("IMU.NoiseAcc", "IMU.AccWalk", "IMU.NoiseGyro", "IMU.GyroWalk"))
