"""Descriptors, scales and images of an imported model, from COLMAP's database and image folders."""

import contextlib
import dataclasses
import sqlite3
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any
from urllib.request import pathname2url

import numpy as np

from maplab_py.array_types import F64, U8, NDArray
from maplab_py.errors import MapError, UserError
from maplab_py.input_files import read_bytes
from maplab_py.progress import SILENT, Progress
from maplab_py.report import counted
from maplab_py.storage.resources.new import NewResources
from maplab_py.vimap import MissionSensor, VIMap, mission_sensor_id
from maplab_py.vimap.descriptors import DescriptorBlock, DescriptorDepth, FeatureType
from maplab_py.vimap.table import object_column

_SIFT, _UNDEFINED = 0, -1
"""COLMAP's numbers of feature types; `export_colmap` writes binary descriptors without type."""
_SIFT_BYTES = 128
SCALED, UNDISTORTED = "scaled", "undistorted"
_SHARE = 0.99
_LEAST_SCALED, _LEAST_UNDISTORTED = 6, 60
"""Keypoints that tell a fit with 2 numbers an axis, or with 21, from chance."""
_FEW_SHARE = 0.05
"""Of the extent: how far half of too few keypoints for such a fit may lie apart."""


@dataclasses.dataclass(frozen=True, eq=False)
class ImageFeatures:
    """Keypoints of an image with their descriptors."""

    scale: F64  # (K,) [px]
    descriptor: U8  # (K, bytes), no columns where there are none
    block: DescriptorBlock | None
    agreement: str = ""  # of the keypoints with those of the model: "", SCALED or UNDISTORTED


_LARGEST_KEYPOINT = 1e7
"""Of pixels and scales; a file that is damaged has others, and numbers that are none."""

_DAMAGES = (sqlite3.Error, ValueError, MemoryError)
"""Of a damaged file; MemoryError where sizes in it are huge."""


_QUERY = """
    SELECT k.rows, k.cols, k.data, {kind}, d.rows, d.cols, d.data
    FROM images AS i LEFT JOIN keypoints AS k ON k.image_id = i.image_id
    LEFT JOIN descriptors AS d ON d.image_id = i.image_id WHERE i.name = ?
"""


def features_of_images(
    path: Path, names: Sequence[str], uv: Sequence[F64], progress: Progress = SILENT
) -> Iterator[ImageFeatures]:
    """Yield the features of images in a database, which is opened for reading only.

    Args:
        names: Names of the images.
        uv: Keypoints (K, 2) of each image in the model, in COLMAP's pixels.

    Raises:
        UserError: There is no such file.
        MapError: It is damaged or no database of COLMAP, or an image is not there or has other keypoints.
    """
    if not path.is_file():
        raise UserError(f"--database={path}: no such file")
    uri = f"file:{pathname2url(str(path.absolute()))}?mode=ro"
    try:
        with contextlib.closing(sqlite3.connect(uri, uri=True)) as connection:
            columns = connection.execute("PRAGMA table_info(descriptors)").fetchall()
            has_types = any(column[1] == "type" for column in columns)
            query = _QUERY.format(kind="d.type" if has_types else _SIFT)
            for row, (name, of_model) in enumerate(zip(names, uv, strict=True)):
                progress.step(row, len(names), "descriptors")
                stored = connection.execute(query, (name,)).fetchone()
                if stored is None:
                    raise MapError(f"{path}: has no image {name}: name the database of this model")
                yield _features(f"{path}: image {name}", stored, of_model)
    except _DAMAGES as error:
        reason = str(error) or "its sizes make no sense"
        raise MapError(
            f"--database={path}: is damaged or no database: {reason}; copy it again, or import without "
            "--database"
        ) from error


def _features(image: str, stored: tuple[Any, ...], uv: F64) -> ImageFeatures:
    """Return the features of an image in a row of `_QUERY`.

    Raises:
        ValueError: It is damaged.
        MapError: It does not fit the keypoints of the model.
    """
    with np.errstate(invalid="ignore"):  # of signalling NaN, which are refused
        values = _matrix(image, stored[:3], np.dtype("<f4")).astype(np.float64)
    if values.shape[1] < 2 or not (np.abs(values) < _LARGEST_KEYPOINT).all():
        raise ValueError(f"the keypoints of {image} are no pixels")
    if len(values) != len(uv):
        raise MapError(
            f"{image} has {len(values)} keypoints, and {len(uv)} in the model: name the database of this "
            "model"
        )
    ratio, kind = agreement(values[:, :2], uv)
    if kind is None:
        apart_px = float(np.median(np.linalg.norm(values[:, :2] - uv, axis=1)))
        raise MapError(
            f"{image}: the keypoints are not those of the model (median distance {apart_px:.3g} px): it is "
            "of another extraction, name the database of this model"
        )
    scale = np.full(len(values), ratio)
    if values.shape[1] >= 6:  # x, y and an affine shape
        scale *= np.hypot(values[:, 2], values[:, 4])
    elif values.shape[1] == 4:  # x, y, scale and orientation
        scale *= values[:, 2]
    number, *table = stored[3:]
    descriptor = _matrix(image, table, np.dtype(np.uint8))
    if not descriptor.size:
        return ImageFeatures(scale, np.zeros((len(uv), 0), dtype=np.uint8), None, kind)
    width = descriptor.shape[1]
    is_sift = number == _SIFT and width == _SIFT_BYTES
    if not is_sift and number != _UNDEFINED:
        raise MapError(
            f"{image}: has descriptors of type {number} with {width} bytes: only SIFT of 128 bytes and the "
            "binary ones of export_colmap can be imported; import without --database"
        )
    if len(descriptor) != len(uv):
        raise ValueError(f"{image} has {len(descriptor)} descriptors of {len(uv)} keypoints")
    feature = FeatureType.SIFT if is_sift else FeatureType.BINARY
    block = DescriptorBlock(len(uv), width, DescriptorDepth.UINT8, feature)
    return ImageFeatures(scale, descriptor, block, kind)


def _matrix(image: str, stored: Sequence[Any], kind: np.dtype[Any]) -> NDArray[Any]:
    """Return a matrix of its rows, columns and data; none where the table has no row of the image."""
    rows, columns, data = (0, 2, b"") if stored[0] in (None, 0) else stored
    is_sized = isinstance(rows, int) and isinstance(columns, int) and columns > 0
    if not is_sized or not isinstance(data, bytes) or len(data) != rows * columns * kind.itemsize:
        raise ValueError(f"the data of {image} have the wrong size")
    return np.frombuffer(data, dtype=kind).reshape(rows, columns)


def agreement(database: F64, model: F64) -> tuple[float, str | None]:
    """Return the ratio of sizes between keypoints (K, 2) of model and database, and how they agree.

    None if they do not: pixels are the same, or scaled with the image, or a smooth function of each other,
    as where COLMAP has undistorted the model.
    """
    if _is_same(database, model):
        return 1.0, ""
    centre, extent = database.mean(axis=0), np.maximum(np.ptp(database, axis=0), 1e-9)
    x, y = ((database - centre) / extent).T
    ones = np.ones(len(x))
    if len(x) >= _LEAST_SCALED:
        fits = [
            np.linalg.lstsq(np.stack([ones, z], axis=1), m, rcond=None)[0]
            for z, m in zip((x, y), model.T, strict=True)
        ]
        fitted = np.stack([fits[0][0] + fits[0][1] * x, fits[1][0] + fits[1][1] * y], axis=1)
        ratio = np.array([fits[0][1], fits[1][1]]) / extent
        if (ratio > 0.0).all() and _is_same(fitted, model, max(1.0, float(ratio.max()))):
            return float(np.sqrt(ratio.prod())), SCALED
    if len(x) >= _LEAST_UNDISTORTED:
        powers = [x**i * y**j for i in range(6) for j in range(6 - i)]
        basis = np.stack(powers, axis=1)
        weights, *_ = np.linalg.lstsq(basis, model, rcond=None)
        if _is_same(basis @ weights, model, 2.0):
            return 1.0, UNDISTORTED
    elif _is_same(database, model, _FEW_SHARE * float(np.linalg.norm(extent)), 0.5):
        return 1.0, UNDISTORTED
    return 1.0, None


def _is_same(a: F64, b: F64, tolerance_px: float = 1.0, share: float = _SHARE) -> bool:
    apart = np.linalg.norm(a - b, axis=1)
    return len(apart) == 0 or float(np.mean(apart <= tolerance_px)) >= share


_RAW_GREY, _RAW_COLOUR = 0, 4
_MAX_IMAGE_BYTES = 1_000_000_000


def with_features(
    vi_map: VIMap, names: list[str], uv: F64, database: Path, *, progress: Progress = SILENT
) -> tuple[VIMap, list[str]]:
    """Return the map with the descriptors and scales of a database, and notes.

    Args:
        names: Name of the image of each frame (F).
        uv: Keypoints (K, 2) as the model has them.

    Raises:
        UserError: There is no such file.
        MapError: It does not fit the model, or is damaged.
    """
    parts = np.split(uv, vi_map.keypoint_start[1:-1])[: len(names)]
    features = list(features_of_images(database, names, parts, progress))
    width = max((part.descriptor.shape[1] for part in features), default=0)
    descriptor: U8 = np.zeros((len(vi_map.keypoints), width), dtype=np.uint8)
    for start, part in zip(vi_map.keypoint_start.tolist(), features, strict=False):
        rows, columns = part.descriptor.shape
        descriptor[start : start + rows, :columns] = part.descriptor
    blocks = [(part.block,) if part.block is not None else None for part in features]
    frames = vi_map.frames.replace(descriptor_blocks=object_column(blocks))
    scale = np.concatenate([part.scale for part in features] or [np.zeros(0)])
    keypoints = vi_map.keypoints.replace(descriptor=descriptor, scale=scale)
    notes = [
        f"the keypoints of {counted(count, 'image')} are {kind} against those of the database"
        for kind in (SCALED, UNDISTORTED)
        if (count := sum(part.agreement == kind for part in features))
    ]
    vi_map = vi_map.replace(frames=frames, keypoints=keypoints)
    first = vi_map.observations[vi_map.observation_start[:-1]]  # tells the type of each landmark
    kind = np.maximum(vi_map.feature_type[first], 0)
    return vi_map.replace(landmarks=vi_map.landmarks.replace(feature_type=kind)), notes


def with_images(
    vi_map: VIMap, names: list[str], folder: Path, *, link: bool, progress: Progress = SILENT
) -> tuple[VIMap, int]:
    """Return the map with the images of a folder as resources, and their number.

    Raises:
        UserError: The folder has none of the images.
        MapError: A file is no image, or has another size than its camera.
    """
    new = NewResources(seed=vi_map.missions.id.tobytes())
    rows, owners = [], []
    for frame, name in enumerate(names):
        progress.step(frame, len(names), "images")
        path = folder / name
        if path.is_file():
            rows.append(_add(new, vi_map, frame, path, link=link))
            owners.append(frame)
    if not rows:
        raise UserError(
            f"--images={folder}: has no image of the model, such as {names[0]}: name the folder that "
            "COLMAP's image names begin in"
        )
    return new.attached(vi_map, rows, owners), len(rows)


def _add(new: NewResources, vi_map: VIMap, frame: int, path: Path, *, link: bool) -> int:
    import cv2

    data = read_bytes(path, _MAX_IMAGE_BYTES, remedy="it is no image", error=MapError)
    image = (
        cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    )
    if image is None or image.dtype != np.uint8 or (image.ndim == 3 and image.shape[2] != 3):
        raise MapError(f"{path}: is no 8-bit grey or colour image")
    mission = int(vi_map.vertices.mission[vi_map.frames.vertex[frame]])
    rig = vi_map.sensors.camera_rig(mission_sensor_id(vi_map, mission, MissionSensor.NCAMERA))
    camera = rig.cameras[int(vi_map.frames.camera_index[frame])]
    if image.shape[:2] != (camera.height_px, camera.width_px):
        raise MapError(
            f"{path}: has {image.shape[1]} x {image.shape[0]} pixels, and its camera {camera.width_px} x "
            f"{camera.height_px}: name the images that COLMAP used"
        )
    kind = _RAW_GREY if image.ndim == 2 else _RAW_COLOUR
    return new.add_link(kind, data, path.resolve()) if link else new.add_image(image, kind)
