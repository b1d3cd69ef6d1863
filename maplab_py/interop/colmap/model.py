"""A COLMAP model as tables: cameras, rigs, frames, images with keypoints, points.

Frames: W is the model's world, R the rig, S a sensor, C a camera. Poses are rows [qx qy qz qw px py pz] of
T_A_B. Keypoints are in COLMAP's pixels: the centre of the first pixel is at (0.5, 0.5).
Source: COLMAP's documentation, "Output Format", of version 4.
"""

from __future__ import annotations

import dataclasses
from enum import IntEnum
from functools import cached_property

import numpy as np

from maplab_py.array_types import F64, I64, U8
from maplab_py.vimap.table import starts_of_counts

NO_POINT = -1
"""Point of a keypoint that observes none."""
PIXEL_CENTRE = 0.5
"""COLMAP's coordinates of the centre of the first pixel; it is 0 in maplab."""
FILES = ("cameras", "rigs", "frames", "images", "points3D")
"""Names of a model's files, without suffix."""


class SensorType(IntEnum):
    """Kinds of sensors of a rig (COLMAP's values)."""

    CAMERA = 0
    IMU = 1


Sensor = tuple[int, int]
"""Type (`SensorType`) and id of a sensor."""


@dataclasses.dataclass(frozen=True, eq=False)
class ColmapCamera:
    """A camera; the parameters are in the order of its model."""

    id: int
    model: int  # COLMAP's number of the camera model
    width_px: int
    height_px: int
    parameters: F64


@dataclasses.dataclass(frozen=True, eq=False)
class ColmapRig:
    """Sensors with their poses; the first is the reference sensor, whose frame is R."""

    id: int
    sensors: tuple[Sensor, ...]
    T_S_R: F64  # (n, 7); NaN where the file has none


@dataclasses.dataclass(frozen=True, eq=False)
class ColmapFrames:
    """Images of a rig at one time, with the pose of the rig."""

    id: I64  # (F,)
    rig: I64  # (F,) ids
    T_R_W: F64  # (F, 7)
    image_frame: I64  # (D,) rows of frames that have images
    image_id: I64  # (D,)


@dataclasses.dataclass(frozen=True, eq=False)
class ColmapImages:
    """Images, each with consecutive rows of keypoints."""

    id: I64  # (N,)
    camera: I64  # (N,) ids
    T_C_W: F64  # (N, 7)
    name: tuple[str, ...]
    keypoint_count: I64  # (N,)
    uv: F64  # (K, 2) in COLMAP's pixels
    point: I64  # (K,) ids, NO_POINT where there is none

    @cached_property
    def keypoint_start(self) -> I64:
        """Offsets (N + 1) of the keypoints of images."""
        return starts_of_counts(self.keypoint_count)

    @cached_property
    def keypoint_image(self) -> I64:
        """Image row (K,) of every keypoint."""
        return np.repeat(np.arange(len(self.id)), self.keypoint_count)


@dataclasses.dataclass(frozen=True, eq=False)
class ColmapPoints:
    """Points; the images say which keypoints observe them."""

    id: I64  # (L,)
    p_W: F64  # (L, 3)
    colour: U8  # (L, 3) red, green, blue
    error_px: F64  # (L,) mean reprojection error


@dataclasses.dataclass(frozen=True, eq=False)
class ColmapModel:
    """A whole model."""

    cameras: tuple[ColmapCamera, ...]
    rigs: tuple[ColmapRig, ...]
    frames: ColmapFrames
    images: ColmapImages
    points: ColmapPoints
