"""Descriptors, scales and images of an imported model, from COLMAP's database and image folders."""

import dataclasses
import sqlite3
from pathlib import Path
from urllib.request import pathname2url

import numpy as np

from maplab_py.array_types import F64, U8
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
_REMEDY = "copy it again, or import without --database"


@dataclasses.dataclass(frozen=True, eq=False)
class ImageFeatures:
    """Keypoints of an image with their descriptors."""

    scale: F64  # (K,) [px]
    descriptor: U8  # (K, bytes), no columns where there are none
    block: DescriptorBlock | None
    agreement: str = ""  # of the keypoints with those of the model: "", SCALED or UNDISTORTED


_LARGEST_KEYPOINT = 1e7
"""Of pixels and scales; a file that is damaged has others, and numbers that are none."""

_DAMAGES = (sqlite3.Error, UnicodeDecodeError, MemoryError)
"""Raised by sqlite for a damaged file; MemoryError where sizes in it are huge."""


class ColmapDatabase:
    """A database, opened for reading only."""

    def __init__(self, path: Path) -> None:
        """Open the database.

        Raises:
            UserError: There is no such file.
            MapError: It is no database of COLMAP.
        """
        if not path.is_file():
            raise UserError(f"--database={path}: no such file")
        self.path = path
        try:
            uri = f"file:{pathname2url(str(path.absolute()))}?mode=ro"
            self._connection = sqlite3.connect(uri, uri=True)
            self._id_of = dict(self._connection.execute("SELECT name, image_id FROM images"))
            columns = self._connection.execute("PRAGMA table_info(descriptors)").fetchall()
        except _DAMAGES as error:
            raise self._damaged(str(error) or "its sizes make no sense") from error
        self._has_types = any(column[1] == "type" for column in columns)

    def close(self) -> None:
        """Close the database."""
        self._connection.close()

    def features(self, name: str, uv: F64) -> ImageFeatures:
        """Return the features of an image.

        Args:
            name: Name of the image.
            uv: Its keypoints (K, 2) in the model, in COLMAP's pixels.

        Raises:
            MapError: The image is not there, has other keypoints, or is damaged.
        """
        count = len(uv)
        image = self._id_of.get(name)
        if image is None:
            raise MapError(f"{self.path}: has no image {name}: name the database of this model")
        rows, columns, data = self._row("keypoints", "rows, cols, data", image) or (0, 2, b"")
        with np.errstate(invalid="ignore"):  # of signalling NaN, which are refused
            values = self._array(data, rows, columns, np.dtype("<f4"), name).astype(np.float64)
        if columns < 2 or not (np.abs(values) < _LARGEST_KEYPOINT).all():
            raise self._damaged(f"the keypoints of image {name} are no pixels")
        if rows != count:
            raise MapError(
                f"{self.path}: image {name} has {rows} keypoints, and {count} in the model: name the "
                "database of this model"
            )
        scale, kind = agreement(values[:, :2], uv)
        if kind is None:
            apart_px = float(np.median(np.linalg.norm(values[:, :2] - uv, axis=1)))
            raise MapError(
                f"{self.path}: the keypoints of image {name} are not those of the model (median distance "
                f"{apart_px:.3g} px): it is of another extraction, name the database of this model"
            )
        return ImageFeatures(scale * _scales(values), *self._descriptors(image, count, name), kind)

    def _descriptors(self, image: int, count: int, name: str) -> tuple[U8, DescriptorBlock | None]:
        kind_column = "type" if self._has_types else str(_SIFT)
        row = self._row("descriptors", f"{kind_column}, rows, cols, data", image)
        if row is None or row[1] == 0:
            return np.zeros((count, 0), dtype=np.uint8), None
        kind, rows, columns, data = row
        is_sift = kind == _SIFT and columns == _SIFT_BYTES
        if not is_sift and kind != _UNDEFINED:
            raise MapError(
                f"{self.path}: descriptors of type {kind} with {columns} bytes: only SIFT of 128 bytes and "
                "the binary ones of export_colmap can be imported; import without --database"
            )
        if rows != count:
            raise self._damaged(f"image {name} has {rows} descriptors of {count} keypoints")
        descriptor = self._array(data, rows, columns, np.dtype(np.uint8), name)
        feature = FeatureType.SIFT if is_sift else FeatureType.BINARY
        return descriptor, DescriptorBlock(count, columns, DescriptorDepth.UINT8, feature)

    def _row(self, table: str, columns: str, image: int) -> tuple[int, ...] | None:
        query = f"SELECT {columns} FROM {table} WHERE image_id = ?"
        try:
            row: tuple[int, ...] | None = self._connection.execute(query, (image,)).fetchone()
        except _DAMAGES as error:
            raise self._damaged(str(error) or "its sizes make no sense") from error
        if row is not None and not all(isinstance(value, int) for value in row[:-1]):
            raise self._damaged(f"{table} of image {image} have no sizes")
        return row

    def _array(
        self, data: object, rows: int, columns: int, kind: np.dtype, name: str
    ) -> np.ndarray:
        content = data if isinstance(data, bytes) else b""
        if columns < 1 or len(content) != rows * columns * kind.itemsize:
            raise self._damaged(f"the data of image {name} have the wrong size")
        return np.frombuffer(content, dtype=kind).reshape(rows, columns)

    def _damaged(self, reason: str) -> MapError:
        return MapError(f"--database={self.path}: is damaged or no database: {reason}; {_REMEDY}")


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


def _scales(values: F64) -> F64:
    """Return scales (K,) of keypoints: x, y; with scale, orientation; or with an affine shape."""
    if values.shape[1] >= 6:
        return np.asarray(np.hypot(values[:, 2], values[:, 4]))
    return values[:, 2] if values.shape[1] == 4 else np.ones(len(values))


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
    store = ColmapDatabase(database)
    features = []
    try:
        start = vi_map.keypoint_start.tolist()
        for row, name in enumerate(names):
            progress.step(row, len(names), "descriptors")
            features.append(store.features(name, uv[start[row] : start[row + 1]]))
    finally:
        store.close()
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
    return _with_landmark_types(vi_map.replace(frames=frames, keypoints=keypoints)), notes


def _with_landmark_types(vi_map: VIMap) -> VIMap:
    """Give each landmark the feature type of its first observation."""
    first = vi_map.observations[vi_map.observation_start[:-1]]
    kind = np.maximum(vi_map.feature_type[first], 0)
    return vi_map.replace(landmarks=vi_map.landmarks.replace(feature_type=kind))


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
