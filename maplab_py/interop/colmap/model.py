"""A COLMAP model as tables: cameras, rigs, frames, images with keypoints, points.

Frames: W is the model's world, R the rig, S a sensor, C a camera. Poses are rows [qx qy qz qw px py pz] of
T_A_B. Keypoints are in COLMAP's pixels: the centre of the first pixel is at (0.5, 0.5).
Source: COLMAP's documentation, "Output Format", of version 4.
"""

import dataclasses
import io
from functools import cached_property
from pathlib import Path
from typing import Any, Self, TypeVar

import numpy as np

from maplab_py.array_types import F64, I64, U8, U64, NDArray
from maplab_py.errors import MapError, UserError
from maplab_py.input_files import read_npz
from maplab_py.sensors.camera import DISTORTION_SIZE, Camera, Distortion, Projection
from maplab_py.vimap.table import starts_of_counts

_Kind = TypeVar("_Kind", bound=np.generic)
NO_POINT = -1
"""Point of a keypoint that observes none."""
PIXEL_CENTRE = 0.5
"""COLMAP's coordinates of the centre of the first pixel; it is 0 in maplab."""
FILES = ("cameras", "rigs", "frames", "images", "points3D")
"""Names of a model's files, without suffix."""
KEYPOINT = np.dtype([("uv", "<f8", 2), ("point", "<i8")])
POINT = np.dtype(
    [("id", "<i8"), ("p_W", "<f8", 3), ("colour", "u1", 3), ("error", "<f8"), ("length", "<i8")]
)
ELEMENT = np.dtype([("image", "<u4"), ("keypoint", "<u4")])
"""Keypoint of an image, point without its track, and element of a track in binary files."""


CAMERA_SENSOR = 0
"""COLMAP's number of the cameras among the sensors of a rig."""


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
    """Cameras with their poses; in files that are written the first is the reference, whose frame is R."""

    id: int
    cameras: tuple[int, ...]  # rows
    T_C_R: F64  # (n, 7); NaN where the file has none


@dataclasses.dataclass(frozen=True, eq=False)
class ColmapFrames:
    """Poses of rigs at the times of their images."""

    id: I64  # (F,)
    rig: I64  # (F,) rows
    T_R_W: F64  # (F, 7)


@dataclasses.dataclass(frozen=True, eq=False)
class ColmapImages:
    """Images, each with consecutive rows of keypoints."""

    id: I64  # (N,)
    camera: I64  # (N,) rows
    frame: I64  # (N,) rows
    T_C_W: F64  # (N, 7)
    name: tuple[str, ...]
    keypoint_count: I64  # (N,)
    uv: F64  # (K, 2) in COLMAP's pixels
    point: I64  # (K,) rows, NO_POINT where there is none

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

    id: I64  # (L,) ascending
    p_W: F64  # (L, 3)
    colour: U8  # (L, 3) red, green, blue
    error_px: F64  # (L,) mean reprojection error


@dataclasses.dataclass(frozen=True, eq=False)
class ColmapModel:
    """A whole model, with rows in place of the ids by which its files refer to each other."""

    cameras: tuple[ColmapCamera, ...]
    rigs: tuple[ColmapRig, ...]
    frames: ColmapFrames
    images: ColmapImages
    points: ColmapPoints

    @cached_property
    def place_in_rig(self) -> I64:
        """Place (C,) of each camera among those of its rig."""
        place = np.zeros(len(self.cameras), dtype=np.int64)
        for rig in self.rigs:
            place[list(rig.cameras)] = np.arange(len(rig.cameras))
        return place

    @cached_property
    def point_id(self) -> I64:
        """Id (K,) of the point of every keypoint, NO_POINT where there is none."""
        return picked(self.points.id, self.images.point, np.full(len(self.images.point), NO_POINT))


def picked(values: NDArray[Any], rows: I64, default: NDArray[_Kind]) -> NDArray[_Kind]:
    """Return the values of rows, a default (N, ...) where a row is -1."""
    result, known = default.copy(), rows >= 0
    result[known] = values[rows[known]]
    return result


def rows_of(ids: I64, wanted: I64) -> I64:
    """Return the rows of wanted ids in a column of unique ids, -1 where they are not."""
    if not len(ids):
        return np.full(len(wanted), -1, dtype=np.int64)
    order = np.argsort(ids, kind="stable")
    place = np.minimum(np.searchsorted(ids[order], wanted), len(ids) - 1)
    return np.where(ids[order[place]] == wanted, order[place], -1).astype(np.int64)


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
        few = Distortion.RADTAN5 if values[8] else Distortion.RADTAN
        distortion = Distortion.RATIONAL if values[9:].any() else few
        values = values[: 4 + DISTORTION_SIZE[distortion]]
    if distortion is None:
        raise UserError(
            f"camera {camera.id}: maplab has no camera model {model.name}: give --undistort to import "
            "perspective keypoints"
        )
    focals = 1 if model.has_single_focal_length else 2
    focal, rest = values[[0, focals - 1]], values[focals:]
    pinhole = np.concatenate([focal, rest[:2] - PIXEL_CENTRE])
    projection, coefficients = Projection.PINHOLE, np.zeros(DISTORTION_SIZE[distortion])
    if model.number == _EUCM:
        projection, pinhole = Projection.EXTENDED_UNIFIED, np.concatenate([rest[2:], pinhole])
    else:
        coefficients[: len(rest) - 2] = rest[2:]
    size = camera.width_px, camera.height_px
    return Camera(sensor_id, projection, distortion, pinhole, coefficients, *size)


def has_model(camera: ColmapCamera) -> bool:
    """Return whether maplab has the camera's model."""
    return MODELS[camera.model].distortion is not None


# What a COLMAP model cannot hold of a map: ids, times, body frames and qualities, in a file beside it.
#
# COLMAP ignores the file. Whoever imports the model again, refined or not, gets the ids of the map back.


FILE_NAME = "maplab.npz"
_VERSION = 1


def _column(leader: str, *width: int, kind: str = "i", rows_of: str = "") -> Any:
    """Declare a column as long as another, of integers (i), numbers (f) or texts (U)."""
    return dataclasses.field(
        metadata={"leader": leader, "width": width, "kind": kind, "rows_of": rows_of}
    )


@dataclasses.dataclass(frozen=True, eq=False)
class SideFile:
    """Rows of the map by names of images and by ids of the model.

    Points carry an observation, which tells whether a refined model still has the same point.
    """

    mission_id: U64 = _column("mission_id", 2)
    mission_name: NDArray[Any] = _column("mission_id", kind="U")
    is_metric: I64 = _column("mission_id")  # 1 = scale and gravity are known
    vertex_id: U64 = _column("vertex_id", 2)
    vertex_mission: I64 = _column("vertex_id", rows_of="mission_id")
    vertex_time_ns: I64 = _column("vertex_id")
    image_name: NDArray[Any] = _column("image_name", kind="U")
    image_vertex: I64 = _column("image_name", rows_of="vertex_id")
    image_frame_id: U64 = _column("image_name", 2)  # of frames of the map
    image_time_ns: I64 = _column("image_name")
    point: I64 = _column("point")  # ids of points, ascending
    point_image: I64 = _column("point", rows_of="image_name")  # images that observe them
    point_keypoint: I64 = _column("point")  # keypoints of these images
    landmark_id: U64 = _column("point", 2)
    landmark_quality: I64 = _column("point")
    rig: I64 = _column("rig")  # ids of rigs
    rig_id: U64 = _column("rig", 2)
    T_I_R: F64 = _column("rig", 7, kind="f")
    camera: I64 = _column("camera")  # ids of cameras
    camera_id: U64 = _column("camera", 2)

    def content(self) -> bytes:
        """Return the file's bytes, the same for the same content."""
        stream = io.BytesIO()
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        np.savez(stream, version=np.array([_VERSION]), **values)
        return stream.getvalue()

    @classmethod
    def read(cls, folder: Path) -> Self:
        """Read the file of a model's folder; without one there are no rows.

        Raises:
            MapError: The file is damaged, or of a newer version.
        """
        path = folder / FILE_NAME
        if not path.is_file():
            columns = {field.name: field.metadata for field in dataclasses.fields(cls)}
            return cls(**{n: np.zeros((0, *c["width"]), c["kind"]) for n, c in columns.items()})
        without = "delete it to import the model with new ids"
        try:
            arrays = read_npz(path)
        except (MapError, ValueError, OSError) as error:
            raise MapError(f"{path}: is damaged: {error}; {without}") from error
        if int(arrays.pop("version", np.zeros(1)).ravel()[0]) != _VERSION:
            raise MapError(f"{path}: was written by another version; {without}")
        names = {field.name for field in dataclasses.fields(cls)}
        if set(arrays) != names or not _fits(arrays):
            raise MapError(f"{path}: is damaged: its columns do not fit; {without}")
        return cls(**arrays)


def _fits(arrays: dict[str, NDArray[Any]]) -> bool:
    """Return whether the columns have equal lengths, the right widths and kinds, and rows that exist."""
    for field in dataclasses.fields(SideFile):
        values, column = arrays[field.name], field.metadata
        if values.shape != (len(arrays[column["leader"]]), *column["width"]):
            return False
        if values.dtype.kind not in ("iu" if column["kind"] == "i" else column["kind"]):
            return False
        owner = column["rows_of"]
        if owner and not np.all((values >= 0) & (values < len(arrays[owner]))):
            return False
    return True
