"""CameraInfo messages against the calibration of a map."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from maplab_py.array_types import F64
from maplab_py.errors import MapError, UserError
from maplab_py.sensors import Camera, Distortion, Projection
from maplab_py.sensors.projection import back_project, project

_MODELS = {
    "": Distortion.NONE,
    "none": Distortion.NONE,
    "plumb_bob": Distortion.RADTAN,
    "rational_polynomial": Distortion.RADTAN,
    "radtan": Distortion.RADTAN,
    "equidistant": Distortion.EQUIDISTANT,
    "fisheye": Distortion.EQUIDISTANT,
    "fov": Distortion.FOV,
}
_SIZES = {Distortion.NONE: 0, Distortion.RADTAN: 4, Distortion.EQUIDISTANT: 4, Distortion.FOV: 1}
_GRID = 9  # pixels of a row and of a column that are compared


def check_camera_info(message: Any, name: str, camera: Camera, tolerance_px: float) -> float:
    """Compare a CameraInfo with a camera of the map.

    Args:
        message: The message.
        name: Bag and topic.
        camera: Camera that the images are said to be of.
        tolerance_px: Largest distance between the pixels of the same ray.

    Returns:
        The largest distance on a grid over the image [px].

    Raises:
        MapError: The message has no calibration, or a model that cameras of maps do not have.
        UserError: It is the calibration of another camera.
    """
    told = camera_of_info(message, name, camera)
    if (told.width_px, told.height_px) != (camera.width_px, camera.height_px):
        raise UserError(
            f"{name}: its images are {told.width_px} x {told.height_px}, those of the map's camera "
            f"{camera.width_px} x {camera.height_px}: choose the camera by --camera"
        )
    distance_px = largest_distance_px(camera, told)
    if not distance_px <= tolerance_px:
        raise UserError(
            f"{name}: its calibration differs from that of the map's camera by up to "
            f"{distance_px:.3g} px: choose the camera by --camera, take images that are not "
            "rectified, or give a larger --calibration_tolerance_px"
        )
    return distance_px


def camera_of_info(message: Any, name: str, like: Camera) -> Camera:
    """Return a camera with the calibration of a CameraInfo.

    Raises:
        MapError: The message has no calibration, or a model that cameras of maps do not have.
    """
    K, D = _field(message, "k"), _field(message, "d")
    if K.size != 9 or not np.isfinite(K).all() or K[0] <= 0.0 or K[4] <= 0.0:
        raise MapError(f"{name}: the camera is not calibrated: K has no focal lengths")
    model = _MODELS.get(message.distortion_model.lower())
    if model is None:
        raise MapError(
            f"{name}: the distortion model {message.distortion_model} is not supported: leave "
            "--camera_calibration_topic away"
        )
    if not D.any() and model is not Distortion.FOV:
        model = Distortion.NONE
    size = _SIZES[model]
    if len(D) < size or D[size:].any():
        raise MapError(
            f"{name}: {message.distortion_model} with {len(D)} coefficients is not supported, "
            f"{size} are: leave out --camera_calibration_topic"
        )
    return dataclasses.replace(
        like,
        projection=Projection.PINHOLE,
        distortion=model,
        intrinsics=K[[0, 4, 2, 5]],
        distortion_parameters=D[:size],
        width_px=int(message.width),
        height_px=int(message.height),
    )


def largest_distance_px(first: Camera, second: Camera) -> float:
    """Return the largest distance [px] between the pixels of the same ray in two cameras.

    Pixels on a grid of the first camera are compared that have a ray; infinite if the second sees none.
    """
    u = np.linspace(0.0, first.width_px - 1.0, _GRID)
    v = np.linspace(0.0, first.height_px - 1.0, _GRID)
    uv = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    rays, has_ray = back_project(first, uv)
    seen, is_seen = project(second, rays)
    both = has_ray & is_seen
    if not both.any():
        return float("inf")
    return float(np.max(np.linalg.norm(seen[both] - uv[both], axis=1)))


def _field(message: Any, name: str) -> F64:
    """Return an array of a CameraInfo; ROS 1 spells the names with capitals."""
    values = getattr(message, name, None)
    if values is None:
        values = getattr(message, name.upper())
    return np.asarray(values, dtype=np.float64).reshape(-1)
