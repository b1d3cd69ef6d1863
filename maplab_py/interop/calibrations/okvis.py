"""Settings of OKVIS and OKVIS2, and of SVO: lists of cameras beside the parameters of an IMU.

OKVIS' `T_SC` is the pose of a camera on the IMU S; SVO's `T_B_C` that on its body, the IMU. Both subtract a
delay from the stamps of images to get to the clock of the IMU.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from maplab_py.errors import MapError
from maplab_py.interop.calibrations import models
from maplab_py.interop.calibrations.parts import Parts, note_unknown_keys
from maplab_py.sensors import Camera, yaml_entry

_OKVIS_NOISE = ("sigma_a_c", "sigma_aw_c", "sigma_g_c", "sigma_gw_c")
_SVO_NOISE = ("sigma_acc_c", "sigma_acc_bias_c", "sigma_omega_c", "sigma_omega_bias_c")
_SVO_DISTORTIONS = {"fisheye": "fov"}  # vikit's fisheye is the model of one field of view


def is_okvis(entry: yaml_entry.Entry) -> bool:
    """Tell whether a file has settings of OKVIS."""
    return any("T_SC" in camera for camera in _first_camera(entry))


def is_svo(entry: yaml_entry.Entry) -> bool:
    """Tell whether a file has cameras of SVO: those of maplab have ids."""
    if "cam_model" in entry and "cam_width" in entry:
        return True
    return any(
        isinstance(mounted.raw("camera"), dict) and "id" not in mounted.child("camera")
        for mounted in _first_camera(entry)
        if "camera" in mounted
    )


def _first_camera(entry: yaml_entry.Entry) -> Sequence[yaml_entry.Entry]:
    cameras = entry.raw("cameras") if "cameras" in entry else None
    is_list = isinstance(cameras, list) and cameras and isinstance(cameras[0], dict)
    return [yaml_entry.Entry(cameras[0], entry.where)] if is_list and cameras else []


def read_okvis(entry: yaml_entry.Entry) -> Parts:
    """Return cameras and IMU.

    Raises:
        MapError: A key is missing or wrong, or a model is not supported.
    """
    cameras, poses = [], []
    for part in entry.entries("cameras"):
        distortion = part.text("distortion_type", default="none")
        focal, centre = part.vector("focal_length", 2), part.vector("principal_point", 2)
        size = part.vector("image_dimension", 2)
        has_terms = "distortion_coefficients" in part
        terms = part.numbers("distortion_coefficients") if has_terms else np.zeros(0)
        pinhole = np.concatenate([focal, centre])
        names = ("cam_model", "pinhole"), ("distortion_type", distortion)
        cameras.append(models.make_camera(part, *names, pinhole, terms, size))
        poses.append(part.pose("T_SC"))
    shift_ns = 0
    for key in ("camera_parameters", "camera_params"):
        if key in entry:
            shift_ns = models.read_time_shift_ns(entry.child(key), "image_delay", sign=-1)
    if "imageDelay" in entry:
        shift_ns = models.read_time_shift_ns(entry, "imageDelay", sign=-1)
    cameras = [dataclasses.replace(camera, time_offset_ns=shift_ns) for camera in cameras]
    imu = None
    for key in ("imu_parameters", "imu_params"):
        if key in entry and imu is None:
            imu = models.read_imu(entry.child(key), _OKVIS_NOISE, _limits("a_max", "g_max"))
    notes = note_unknown_keys(entry, settings=True)
    return Parts("OKVIS", cameras, np.stack(poses), imu, notes=notes)


def _limits(accel_key: str, gyro_key: str) -> dict[str, str]:
    return {
        "saturation_accel_max_mps2": accel_key,
        "saturation_gyro_max_radps": gyro_key,
        "gravity_magnitude_mps2": "g",
    }


def read_svo(entry: yaml_entry.Entry) -> Parts:
    """Return cameras and IMU.

    Raises:
        MapError: A key is missing or wrong, or a model is not supported.
    """
    if "cam_model" in entry:
        why = f"{entry.where}: this file of SVO has no pose of the camera on the IMU"
        camera = _old_svo_camera(entry)
        return Parts("SVO", [camera], np.eye(1, 7, 3), why_not_on_imu=why)
    cameras, poses = [], []
    for mounted in entry.entries("cameras"):
        part = mounted.child("camera")
        lens = part.child("distortion")
        kind = lens.text("type", default="none")
        terms = lens.numbers("parameters") if "parameters" in lens else np.zeros(0)
        cameras.append(
            models.make_camera(
                part,
                ("type", part.text("type")),
                ("distortion", _SVO_DISTORTIONS.get(kind, kind)),
                part.numbers("intrinsics"),
                terms,
                (part.integer("image_width"), part.integer("image_height")),
                description=part.text("label"),
                line_delay_ns=part.integer("line-delay-nanoseconds", 0),
            )
        )
        poses.append(mounted.pose("T_B_C"))
    imu = None
    if "imu_params" in entry:
        part = entry.child("imu_params")
        shift_ns = models.read_time_shift_ns(part, "delay_imu_cam", sign=-1)
        cameras = [dataclasses.replace(camera, time_offset_ns=shift_ns) for camera in cameras]
        imu = models.read_imu(part, _SVO_NOISE, _limits("acc_max", "omega_max"))
    notes = models.note_line_delays(entry, cameras) + note_unknown_keys(entry, settings=True)
    return Parts("SVO", cameras, np.stack(poses), imu, notes=notes)


def _old_svo_camera(entry: yaml_entry.Entry) -> Camera:
    """Return the camera of SVO 1's file; the ATAN model is relative to the size of the image."""
    model = entry.text("cam_model")
    size = np.array([entry.integer("cam_width"), entry.integer("cam_height")], dtype=np.float64)
    numbers = np.array([entry.number(f"cam_{key}") for key in ("fx", "fy", "cx", "cy")])
    terms = [entry.number(f"cam_d{row}", 0.0) for row in range(4)]
    if model.lower() == "atan":
        numbers = np.concatenate([numbers[:2] * size, numbers[2:] * size - 0.5])
        return models.make_camera(
            entry, ("cam_model", "pinhole"), ("cam_model", "fov"), numbers, terms[:1], size
        )
    if model.lower() != "pinhole":
        raise MapError(
            f"{entry.where}: key 'cam_model': '{model}' of SVO is not supported: calibrate with ATAN or "
            "Pinhole"
        )
    names = ("cam_model", "pinhole"), ("cam_model", "radtan")
    return models.make_camera(entry, *names, numbers, terms, size)
