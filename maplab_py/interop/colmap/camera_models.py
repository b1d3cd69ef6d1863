"""Camera models that COLMAP and maplab have in common.

maplab's parameters are [fu fv cu cv] and those of the distortion, or [alpha beta fu fv cu cv] of the extended
unified model, which COLMAP calls EUCM and begins with fu. COLMAP's principal point is half a pixel further to
the right and below.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.array_types import F64
from maplab_py.errors import UserError
from maplab_py.interop.colmap.model import PIXEL_CENTRE, ColmapCamera
from maplab_py.sensors.camera import DISTORTION_SIZE, Camera, Distortion, Projection


@dataclasses.dataclass(frozen=True)
class CameraModel:
    """A camera model of COLMAP."""

    number: int
    name: str
    parameters: int
    distortion: Distortion | None = None  # None = maplab has no such model
    has_single_focal_length: bool = False


_RADTAN, _EQUIDISTANT = Distortion.RADTAN, Distortion.EQUIDISTANT
_MODELS = (
    CameraModel(0, "SIMPLE_PINHOLE", 3, Distortion.NONE, has_single_focal_length=True),
    CameraModel(1, "PINHOLE", 4, Distortion.NONE),
    CameraModel(2, "SIMPLE_RADIAL", 4, _RADTAN, has_single_focal_length=True),
    CameraModel(3, "RADIAL", 5, _RADTAN, has_single_focal_length=True),
    CameraModel(4, "OPENCV", 8, _RADTAN),
    CameraModel(5, "OPENCV_FISHEYE", 8, _EQUIDISTANT),
    CameraModel(6, "FULL_OPENCV", 12, Distortion.RATIONAL),
    CameraModel(7, "FOV", 5, Distortion.FOV),
    CameraModel(8, "SIMPLE_RADIAL_FISHEYE", 4, _EQUIDISTANT, has_single_focal_length=True),
    CameraModel(9, "RADIAL_FISHEYE", 5, _EQUIDISTANT, has_single_focal_length=True),
    CameraModel(10, "THIN_PRISM_FISHEYE", 12),
    CameraModel(11, "RAD_TAN_THIN_PRISM_FISHEYE", 16),
    CameraModel(12, "SIMPLE_DIVISION", 4),
    CameraModel(13, "DIVISION", 5),
    CameraModel(14, "SIMPLE_FISHEYE", 3, _EQUIDISTANT, has_single_focal_length=True),
    CameraModel(15, "FISHEYE", 4, _EQUIDISTANT),
    CameraModel(16, "EUCM", 6, Distortion.NONE),
    CameraModel(17, "EQUIRECTANGULAR", 2),
)
MODELS = {model.number: model for model in _MODELS}
"""COLMAP's camera models by number."""
_FULL_OPENCV, _EUCM = 6, 16
_NUMBER_OF = {
    Distortion.NONE: 1,
    Distortion.RADTAN: 4,
    Distortion.RADTAN5: _FULL_OPENCV,
    Distortion.RATIONAL: _FULL_OPENCV,
    Distortion.EQUIDISTANT: 5,
    Distortion.FOV: 7,
}


def colmap_camera(camera: Camera, number: int) -> ColmapCamera:
    """Return a camera of a map as a camera of COLMAP with this id.

    Raises:
        UserError: COLMAP has no such model.
    """
    pinhole = camera.intrinsics[-4:] + np.array([0.0, 0.0, PIXEL_CENTRE, PIXEL_CENTRE])
    if camera.projection is Projection.EXTENDED_UNIFIED:
        model, coefficients = _EUCM, camera.intrinsics[:2]
    elif camera.projection is Projection.PINHOLE:
        model, coefficients = _NUMBER_OF[camera.distortion], camera.distortion_parameters
    else:
        raise UserError(
            f"camera {camera.id}: COLMAP has no {camera.projection.value} model: give --undistort to "
            "write perspective keypoints"
        )
    parameters = np.zeros(MODELS[model].parameters)
    parameters[: 4 + len(coefficients)] = *pinhole, *coefficients
    return ColmapCamera(number, model, camera.width_px, camera.height_px, parameters)


def map_camera(camera: ColmapCamera, sensor_id: str) -> Camera:
    """Return a camera of COLMAP as a camera of a map with this id.

    Raises:
        UserError: maplab has no such model.
    """
    model = MODELS[camera.model]
    values = camera.parameters
    distortion = model.distortion
    if model.number == _FULL_OPENCV:
        distortion = _smallest_model(values[4:])
        values = values[: 4 + DISTORTION_SIZE[distortion]]
    if distortion is None:
        raise UserError(
            f"camera {camera.id}: maplab has no camera model {model.name}: give --undistort to import "
            "perspective keypoints"
        )
    focal, rest = (values[[0, 0]], values[1:]) if model.has_single_focal_length else _split(values)
    pinhole = np.concatenate([focal, rest[:2] - PIXEL_CENTRE])
    projection, coefficients = Projection.PINHOLE, np.zeros(DISTORTION_SIZE[distortion])
    if model.number == _EUCM:
        projection, pinhole = Projection.EXTENDED_UNIFIED, np.concatenate([rest[2:], pinhole])
    else:
        coefficients[: len(rest) - 2] = rest[2:]
    return Camera(
        sensor_id,
        projection,
        distortion,
        pinhole,
        coefficients,
        camera.width_px,
        camera.height_px,
    )


def has_model(camera: ColmapCamera) -> bool:
    """Return whether maplab has the camera's model."""
    return MODELS[camera.model].distortion is not None


def _smallest_model(coefficients: F64) -> Distortion:
    """Return the model with the fewest coefficients (8) of OpenCV that are not zero."""
    if coefficients[5:].any():
        return Distortion.RATIONAL
    return Distortion.RADTAN5 if coefficients[4] else Distortion.RADTAN


def _split(values: F64) -> tuple[F64, F64]:
    return values[:2], values[2:]
