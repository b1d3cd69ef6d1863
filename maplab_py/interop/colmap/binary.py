"""Models in COLMAP's binary format, read and written.

Every count is checked against the bytes that are there: COLMAP's own reader does not look at the end of a
file, it takes what memory holds for the missing part, or never returns.
"""

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from maplab_py.array_types import F64, I64, U8
from maplab_py.compilation import compiled
from maplab_py.errors import MapError
from maplab_py.geometry import so3
from maplab_py.input_files import read_bytes
from maplab_py.interop.colmap import model as colmap
from maplab_py.vimap.table import starts_of_counts

_MAX_BYTES = 20_000_000_000
_MAX_NAME_BYTES = 4096
_FROM_FILE = [1, 2, 3, 0, 4, 5, 6]
_UNIT_TOLERANCE = 1e-3
REMEDY = "copy or write the model again"


class _Cursor:
    """Reads a file from its beginning to its end."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self.data = read_bytes(path, _MAX_BYTES, remedy="split the model", error=MapError)
        except OSError as error:
            raise MapError(f"cannot read {path}: {error.strerror}; {REMEDY}") from error
        self.place = 0

    def take(self, size: int) -> bytes:
        if size < 0 or size > len(self.data) - self.place:
            raise self.damaged("it ends too early")
        self.place += size
        return self.data[self.place - size : self.place]

    def numbers(self, layout: str) -> tuple[int, ...]:
        return struct.unpack("<" + layout, self.take(struct.calcsize("<" + layout)))

    def count(self, least_bytes: int) -> int:
        """Return a count of records of at least some bytes, 8 bytes wide."""
        (count,) = self.numbers("Q")
        if count * least_bytes > len(self.data) - self.place:
            raise self.damaged("it ends too early")
        return count

    def doubles(self, count: int) -> F64:
        values = np.frombuffer(self.take(8 * count), dtype="<f8").astype(np.float64)
        if not np.all(np.isfinite(values)):
            raise self.damaged("it has numbers that are not finite")
        return values

    def pose(self) -> F64:
        values = self.doubles(7)[_FROM_FILE]
        if not abs(float(np.linalg.norm(np.clip(values[:4], -2.0, 2.0))) - 1.0) <= _UNIT_TOLERANCE:
            raise self.damaged("it has a quaternion that is not of unit length")
        return np.concatenate([so3.normalize(values[:4]), values[4:]])

    def text(self) -> str:
        end = self.data.find(b"\0", self.place, self.place + _MAX_NAME_BYTES)
        if end < 0:
            is_cut = len(self.data) - self.place <= _MAX_NAME_BYTES
            raise self.damaged("it ends too early" if is_cut else "an image name does not end")
        name = self.take(end + 1 - self.place)[:-1]
        try:
            return name.decode()
        except UnicodeDecodeError:
            raise self.damaged("an image name is not text") from None

    def finish(self) -> None:
        if self.place != len(self.data):
            raise self.damaged(f"{len(self.data) - self.place} bytes follow its last record")

    def damaged(self, reason: str) -> MapError:
        return MapError(f"{self.path}: is damaged: {reason}; {REMEDY}")


def read_binary(folder: Path) -> colmap.ColmapModel:
    """Read the binary files of a model; references between the files are checked by the caller.

    Models of versions without rigs and frames get a rig of each camera, and a frame of each image.

    Raises:
        MapError: A file is missing, damaged, or cut.
    """
    cameras = _cameras(_Cursor(folder / "cameras.bin"))
    images = _images(_Cursor(folder / "images.bin"))
    points = _points(_Cursor(folder / "points3D.bin"))
    if (folder / "rigs.bin").exists() or (folder / "frames.bin").exists():
        rigs = _rigs(_Cursor(folder / "rigs.bin"))
        frames = _frames(_Cursor(folder / "frames.bin"))
        return colmap.ColmapModel(cameras, rigs, frames, images, points)
    used = np.unique(images.camera).tolist()
    identity = np.array([[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]])
    rigs = tuple(
        colmap.ColmapRig(number, ((colmap.SensorType.CAMERA, number),), identity) for number in used
    )
    rows = np.arange(len(images.id))
    frames = colmap.ColmapFrames(images.id, images.camera, images.T_C_W, rows, images.id)
    return colmap.ColmapModel(cameras, rigs, frames, images, points)


def read_binary_cameras(path: Path) -> tuple[colmap.ColmapCamera, ...]:
    """Read cameras.bin.

    Raises:
        MapError: It is missing, damaged, or cut.
    """
    return _cameras(_Cursor(path))


def _cameras(file: _Cursor) -> tuple[colmap.ColmapCamera, ...]:
    cameras = []
    for _ in range(file.count(24)):
        number, model, width, height = file.numbers("IiQQ")
        if model not in colmap.MODELS:
            raise file.damaged(f"camera {number} has the unknown camera model {model}")
        parameters = file.doubles(colmap.MODELS[model].parameters)
        if not (0 < width < 1 << 31 and 0 < height < 1 << 31):
            raise file.damaged(f"the images of camera {number} have no pixels")
        cameras.append(colmap.ColmapCamera(number, model, width, height, parameters))
    file.finish()
    return tuple(cameras)


def _rigs(file: _Cursor) -> tuple[colmap.ColmapRig, ...]:
    rigs = []
    for _ in range(file.count(8)):
        number, count = file.numbers("II")
        sensors: list[colmap.Sensor] = []
        poses: list[F64] = []
        for row in range(count):
            kind, sensor = file.numbers("iI")
            pose = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
            if row:
                pose = file.pose() if file.take(1) != b"\0" else np.full(7, np.nan)
            sensors.append((kind, sensor))
            poses.append(pose)
        rigs.append(colmap.ColmapRig(number, tuple(sensors), np.array(poses).reshape(-1, 7)))
    file.finish()
    return tuple(rigs)


def _frames(file: _Cursor) -> colmap.ColmapFrames:
    count = file.count(68)
    ids, rigs, poses = [], [], []
    owners: list[int] = []
    images: list[int] = []
    for row in range(count):
        number, rig = file.numbers("II")
        ids.append(number)
        rigs.append(rig)
        poses.append(file.pose())
        for _ in range(file.numbers("I")[0]):
            kind, _, data = file.numbers("iIQ")
            if kind == colmap.SensorType.CAMERA:
                owners.append(row)
                images.append(data)
    file.finish()
    return colmap.ColmapFrames(
        _integers(ids), _integers(rigs), _rows(poses, 7), _integers(owners), _integers(images)
    )


def _images(file: _Cursor) -> colmap.ColmapImages:
    ids, cameras, poses, names, counts = [], [], [], [], []
    keypoints = [np.zeros(0, dtype=KEYPOINT)]
    for _ in range(file.count(69)):
        ids.append(file.numbers("I")[0])
        poses.append(file.pose())
        cameras.append(file.numbers("I")[0])
        names.append(file.text())
        counts.append(file.count(KEYPOINT.itemsize))
        rows = np.frombuffer(file.take(counts[-1] * KEYPOINT.itemsize), dtype=KEYPOINT)
        keypoints.append(rows)
    file.finish()
    table = np.concatenate(keypoints)
    if not np.all(np.isfinite(table["uv"])):
        raise file.damaged("it has keypoints that are not finite")
    return colmap.ColmapImages(
        _integers(ids),
        _integers(cameras),
        _rows(poses, 7),
        tuple(names),
        _integers(counts),
        np.ascontiguousarray(table["uv"], dtype=np.float64),
        np.ascontiguousarray(table["point"], dtype=np.int64),
    )


def _points(file: _Cursor) -> colmap.ColmapPoints:
    count = file.count(POINT.itemsize)
    data = np.frombuffer(file.data, dtype=np.uint8)
    starts = record_starts(data, file.place, count)
    if np.any(starts < 0):
        raise file.damaged("it ends too early")
    file.place = int(starts[-1])
    file.finish()
    records = data[starts[:-1, None] + np.arange(POINT.itemsize)].reshape(-1).view(POINT)
    p_W = np.ascontiguousarray(records["p_W"], dtype=np.float64)
    if not np.all(np.isfinite(p_W)):
        raise file.damaged("it has points that are not finite")
    return colmap.ColmapPoints(
        records["id"].astype(np.int64),
        p_W,
        records["colour"].copy(),
        records["error"].astype(np.float64),
    )


def _integers(values: list[int]) -> I64:
    return np.array(values, dtype=np.int64)


def _rows(values: list[F64], width: int) -> F64:
    return np.array(values, dtype=np.float64).reshape(-1, width)


KEYPOINT = np.dtype([("uv", "<f8", 2), ("point", "<i8")])
POINT = np.dtype(
    [("id", "<i8"), ("p_W", "<f8", 3), ("colour", "u1", 3), ("error", "<f8"), ("length", "<i8")]
)
ELEMENT = np.dtype([("image", "<u4"), ("keypoint", "<u4")])
_TO_FILE = [3, 0, 1, 2, 4, 5, 6]  # the quaternion's w comes first


def binary_files(model: colmap.ColmapModel) -> dict[str, Iterator[bytes]]:
    """Return the content of the files of a model by name."""
    return {
        "cameras.bin": _encode_cameras(model),
        "rigs.bin": _encode_rigs(model),
        "frames.bin": _encode_frames(model),
        "images.bin": _encode_images(model),
        "points3D.bin": _encode_points(model),
    }


def _encode_cameras(model: colmap.ColmapModel) -> Iterator[bytes]:
    yield struct.pack("<Q", len(model.cameras))
    for camera in model.cameras:
        yield struct.pack("<IiQQ", camera.id, camera.model, camera.width_px, camera.height_px)
        yield _doubles(camera.parameters)


def _encode_rigs(model: colmap.ColmapModel) -> Iterator[bytes]:
    yield struct.pack("<Q", len(model.rigs))
    for rig in model.rigs:
        yield struct.pack("<II", rig.id, len(rig.sensors))
        for row, sensor in enumerate(rig.sensors):
            yield struct.pack("<iI", *sensor)
            if row:
                yield b"\x01" + _doubles(rig.T_S_R[row, _TO_FILE])


def _encode_frames(model: colmap.ColmapModel) -> Iterator[bytes]:
    frames = model.frames
    order = np.argsort(frames.image_frame, kind="stable")
    images = frames.image_id[order]
    start = starts_of_counts(np.bincount(frames.image_frame, minlength=len(frames.id)))
    row_of_image = {image: row for row, image in enumerate(model.images.id.tolist())}
    yield struct.pack("<Q", len(frames.id))
    for row, (number, rig) in enumerate(zip(frames.id.tolist(), frames.rig.tolist(), strict=True)):
        mine = images[start[row] : start[row + 1]].tolist()
        yield struct.pack("<II", number, rig) + _doubles(frames.T_R_W[row, _TO_FILE])
        yield struct.pack("<I", len(mine))
        for image in mine:
            camera = int(model.images.camera[row_of_image[image]])
            yield struct.pack("<iIQ", colmap.SensorType.CAMERA, camera, image)


def _encode_images(model: colmap.ColmapModel) -> Iterator[bytes]:
    images = model.images
    keypoints = np.zeros(len(images.uv), dtype=KEYPOINT)
    keypoints["uv"], keypoints["point"] = images.uv, images.point
    start = images.keypoint_start.tolist()
    yield struct.pack("<Q", len(images.id))
    for row, name in enumerate(images.name):
        yield struct.pack("<I", int(images.id[row])) + _doubles(images.T_C_W[row, _TO_FILE])
        yield struct.pack("<I", int(images.camera[row])) + name.encode() + b"\0"
        yield struct.pack("<Q", start[row + 1] - start[row])
        yield keypoints[start[row] : start[row + 1]].tobytes()


def _encode_points(model: colmap.ColmapModel) -> Iterator[bytes]:
    """Yield the records as bytes that are scattered to their places."""
    points, images = model.points, model.images
    observing = np.flatnonzero(images.point >= 0)
    order = np.argsort(points.id, kind="stable")
    row = order[np.searchsorted(points.id[order], images.point[observing])]
    length = np.bincount(row, minlength=len(points.id))
    by_point = np.argsort(row, kind="stable")
    observing, row = observing[by_point], row[by_point]
    records = np.zeros(len(points.id), dtype=POINT)
    records["id"], records["p_W"], records["colour"] = points.id, points.p_W, points.colour
    records["error"], records["length"] = points.error_px, length
    image = images.keypoint_image[observing]
    elements = np.zeros(len(observing), dtype=ELEMENT)
    elements["image"] = images.id[image]
    elements["keypoint"] = observing - images.keypoint_start[image]
    start = starts_of_counts(RECORD_BYTES + ELEMENT_BYTES * length)
    data: U8 = np.zeros(int(start[-1]), dtype=np.uint8)
    data[start[:-1, None] + np.arange(RECORD_BYTES)] = _bytes(records, RECORD_BYTES)
    of_point = np.arange(len(observing)) - starts_of_counts(length)[row]
    place = start[row] + RECORD_BYTES + ELEMENT_BYTES * of_point
    data[place[:, None] + np.arange(ELEMENT_BYTES)] = _bytes(elements, ELEMENT_BYTES)
    yield struct.pack("<Q", len(points.id))
    yield data.tobytes()


def _bytes(records: np.ndarray, size: int) -> U8:
    """Return records (N,) as bytes (N, size)."""
    return records.view(np.uint8).reshape(len(records), size)


def _doubles(values: F64) -> bytes:
    return np.asarray(values, dtype="<f8").tobytes()


RECORD_BYTES, ELEMENT_BYTES = POINT.itemsize, ELEMENT.itemsize
"""Bytes of a point without its track, and of an element of a track."""
_LENGTH_AT = 43


@compiled()
def record_starts(data, first, count):  # type: ignore[no-untyped-def]
    """Return where the records of points begin.

    Args:
        data: Bytes (N,) of the file.
        first: Place of the first record.
        count: Number of records.

    Returns:
        Places (count + 1,) of the records and of their end; -1 from the record on that is not
        complete.
    """
    starts = np.full(count + 1, -1, dtype=np.int64)
    place = first
    for row in range(count):
        if place + RECORD_BYTES > len(data):
            return starts
        length = np.int64(0)
        for byte in range(8):
            length |= np.int64(data[place + _LENGTH_AT + byte]) << np.int64(8 * byte)
        if length < 0 or length > (len(data) - place - RECORD_BYTES) // ELEMENT_BYTES:
            return starts
        starts[row] = place
        place += RECORD_BYTES + ELEMENT_BYTES * length
    starts[count] = place
    return starts


def compile_kernels() -> None:
    """Compile the kernel of this module."""
    record_starts(np.zeros(RECORD_BYTES, dtype=np.uint8), 0, 1)
