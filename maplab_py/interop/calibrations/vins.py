"""Settings of VINS-Mono and VINS-Fusion, and camodocal's files of cameras that they name.

`body_T_cam0` takes points of the camera to the IMU; the clock of the images plus `td` is that of the IMU.
`acc_n`, `gyr_n` are standard deviations of samples, which they use like densities.
"""

import dataclasses
from pathlib import Path

import numpy as np

from maplab_py.array_types import F64
from maplab_py.errors import MapError
from maplab_py.geometry import se3, so3
from maplab_py.interop.calibrations import models, parts
from maplab_py.sensors import Camera, Imu, yaml_entry

_MAX_CAMERAS = 16
_NOISE = (
    "acc_n, gyr_n, acc_w, gyr_w are taken as densities: VINS means standard deviations of samples, which are "
    "larger by the root of the rate of the IMU"
)
_MODELS = {
    "PINHOLE": ("pinhole", "radtan", (), ("fx", "fy", "cx", "cy"), ("k1", "k2", "p1", "p2")),
    "MEI": ("omni", "radtan", ("xi",), ("gamma1", "gamma2", "u0", "v0"), ("k1", "k2", "p1", "p2")),
    "KANNALA_BRANDT": ("pinhole", "equidistant", (), ("mu", "mv", "u0", "v0"), ()),
}
"""Projection, distortion, and names of the parameters by camodocal's names of models."""


def is_vins(entry: yaml_entry.Entry) -> bool:
    """Tell whether a file has settings of VINS, or one of its cameras."""
    keys = ("body_T_cam0", "cam0_calib", "extrinsicRotation", "projection_parameters")
    return any(key in entry for key in keys) or ("acc_n" in entry and "gyr_n" in entry)


def read_vins(entry: yaml_entry.Entry, folder: Path) -> parts.Parts:
    """Return cameras and IMU of the settings.

    Args:
        folder: Files of cameras are named relative to it.

    Raises:
        MapError: A file cannot be read, a key is missing or wrong, or a model is not supported.
    """
    notes: list[str] = []
    if "model_type" in entry:
        cameras, poses = [_camera(entry)], [_mono_pose(entry)]
    else:
        count = entry.integer("num_of_cam", 1)
        if not 1 <= count <= _MAX_CAMERAS:
            raise MapError(f"{entry.where}: key 'num_of_cam' must be from 1 to {_MAX_CAMERAS}")
        files = [folder / str(entry.raw(f"cam{row}_calib")) for row in range(count)]
        cameras = [_camera(parts.read_entry(path)) for path in files]
        keys = [f"body_T_cam{row}" for row in range(count)]
        poses = [entry.pose(key) if key in entry else None for key in keys]
        notes += _compare_sizes(entry, cameras)
    shift_ns = models.read_time_shift_ns(entry, "td")
    topics = ("image0_topic", "image1_topic")
    cameras = [
        dataclasses.replace(
            camera,
            time_offset_ns=shift_ns,
            topic=entry.text(topics[row], "image_topic") if row < 2 else "",
            line_delay_ns=_line_delay_ns(entry, camera),
        )
        for row, camera in enumerate(cameras)
    ]
    imu = _imu(entry)
    if imu is not None:
        notes.append(f"{entry.where}: {_NOISE}")
    missing = [row for row, pose in enumerate(poses) if pose is None]
    if missing and len(poses) > 1:
        entry.raw(f"body_T_cam{missing[0]}")  # is missing
    why = f"{entry.where}: has no pose of the camera on the IMU ('body_T_cam0')" if missing else ""
    if missing and imu is not None:
        raise MapError(f"{why}: let VINS estimate it first, or calibrate with kalibr")
    T_B_C = np.stack([se3.identity() if pose is None else pose for pose in poses])
    notes += models.note_line_delays(entry, cameras) + parts.note_unknown_keys(entry, settings=True)
    return parts.Parts("VINS", cameras, T_B_C, imu, why_not_on_imu=why, notes=notes)


def _camera(entry: yaml_entry.Entry) -> Camera:
    name = entry.text("model_type").upper()
    if name not in _MODELS:
        raise MapError(
            f"{entry.where}: key 'model_type': '{name}' is not supported: calibrate with one of "
            f"{', '.join(_MODELS)}"
        )
    projection, distortion, mirror, names, terms = _MODELS[name]
    values = entry.child("projection_parameters")
    numbers = [entry.child("mirror_parameters").number(key) for key in mirror]
    numbers += [values.number(key) for key in names]
    if terms:
        lens = entry.child("distortion_parameters")
        coefficients = [lens.number(key) for key in terms]
    else:
        coefficients = [values.number(key) for key in ("k2", "k3", "k4", "k5")]
    entry.text("camera_name")
    size = (entry.integer("image_width"), entry.integer("image_height"))
    return models.make_camera(
        entry, ("model_type", projection), ("model_type", distortion), numbers, coefficients, size
    )


def _mono_pose(entry: yaml_entry.Entry) -> F64 | None:
    """Return the pose of VINS-Mono's camera on the IMU, None if VINS estimates it from nothing."""
    if "body_T_cam0" in entry:
        return entry.pose("body_T_cam0")
    if "extrinsicRotation" not in entry or entry.integer("estimate_extrinsic", 0) == 2:
        return None
    R = entry.rotation("extrinsicRotation")
    return se3.make(so3.from_matrix(R), entry.vector("extrinsicTranslation", 3))


def _line_delay_ns(entry: yaml_entry.Entry, camera: Camera) -> int:
    readout_ns = models.read_time_shift_ns(entry, "rolling_shutter_tr")
    return round(readout_ns / camera.height_px) if entry.integer("rolling_shutter", 0) else 0


def _imu(entry: yaml_entry.Entry) -> Imu | None:
    if not entry.integer("imu", int("acc_n" in entry)):
        return None
    noise, limits = ("acc_n", "acc_w", "gyr_n", "gyr_w"), {"gravity_magnitude_mps2": "g_norm"}
    return models.read_imu(entry, noise, limits, topic=entry.text("imu_topic"))


def _compare_sizes(entry: yaml_entry.Entry, cameras: list[Camera]) -> list[str]:
    """Return a note where the settings say another size of images than a camera."""
    if "image_width" not in entry or "image_height" not in entry:
        return []
    size = (entry.integer("image_width"), entry.integer("image_height"))
    return [
        f"{entry.where}: images have {size[0]} x {size[1]} pixels, camera {row} {camera.width_px} x "
        f"{camera.height_px} in its file, which is used"
        for row, camera in enumerate(cameras)
        if (camera.width_px, camera.height_px) != size
    ]
