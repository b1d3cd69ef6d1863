"""Files of models, binary or text, read as records of numbers and names, and written in binary.

Every count is checked against what is there: COLMAP's own reader does not look at the end of a file, it takes
what memory holds for the missing part, or never returns.
"""

import re
import struct
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from maplab_py.array_types import F64, NDArray
from maplab_py.errors import MapError
from maplab_py.geometry import so3
from maplab_py.input_files import read_bytes, read_foreign_text
from maplab_py.interop.colmap.model import CAMERA_SENSOR, ELEMENT, KEYPOINT, POINT, ColmapModel
from maplab_py.vimap.table import starts_of_counts

REMEDY = "copy or write the model again"
ANNOUNCED = re.compile(r"# Number of \w+: (\d+)")
"""The number of records in the head of a text file."""
_MAX_BYTES = 20_000_000_000
_MAX_NAME_BYTES = 4096
_SIZES = 1e-100, 1e100
_LARGEST_ID = 1 << 53
_COLUMNS = {
    "cameras": "id, camera model, width, height and parameters",
    "rigs": "RIG_ID NUM_SENSORS, then sensors",
    "frames": "FRAME_ID RIG_ID QW QX QY QZ TX TY TZ NUM_DATA_IDS, then data",
    "images": "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME",
    "points3D": "POINT3D_ID X Y Z R G B ERROR, then a track",
}
_CUTS = {"images": 9, "points3D": 8}
_T = TypeVar("_T")


class _File(ABC):
    """A file that is read from its beginning to its end."""

    tolerance = np.inf  # of the length of quaternions
    wanted = ""  # what the record should be, for messages

    def __init__(self, path: Path) -> None:
        self.path, self._line = path, ""

    def pose(self) -> F64:
        """Take a pose (7,), which has w first in files."""
        values = self.doubles(7)[[1, 2, 3, 0, 4, 5, 6]]
        if not np.isfinite(values).all():
            raise self.damaged("it has numbers that are not finite")
        size = float(np.abs(values[:4]).max())
        if not _SIZES[0] < size < _SIZES[1] or (
            abs(float(np.linalg.norm(values[:4])) - 1.0) > self.tolerance
        ):
            raise self.damaged("it has a quaternion that is not of unit length")
        return np.concatenate([so3.normalize(values[:4]), values[4:]])

    def damaged(self, reason: str) -> MapError:
        """Return the error that the file is damaged."""
        return MapError(f"{self.path}{self._line}: is damaged: {reason}; {REMEDY}")

    @abstractmethod
    def doubles(self, count: int) -> F64:
        """Take numbers."""


class _Binary(_File):
    tolerance = 1e-3

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        try:
            self._data = read_bytes(path, _MAX_BYTES, remedy="split the model", error=MapError)
        except OSError as error:
            raise MapError(f"cannot read {path}: {error.strerror}; {REMEDY}") from error
        self._at = 0

    def records(self, least_bytes: int) -> Iterator[None]:
        """Yield at the beginning of each record, which has at least so many bytes."""
        (count,) = self.integers("Q")
        if count * least_bytes > len(self._data) - self._at:
            raise self.damaged("it ends too early")
        for _ in range(count):
            yield
        if self._at != len(self._data):
            raise self.damaged(f"{len(self._data) - self._at} bytes follow its last record")

    def integers(self, layout: str) -> tuple[int, ...]:
        """Take numbers in a layout of `struct`."""
        return struct.unpack("<" + layout, self._take(struct.calcsize("<" + layout)))

    def word(self, numbers: Mapping[str, int]) -> Any:  # noqa: ARG002
        """Take a number for which text files have a word; one that is not known as it is."""
        return self.integers("i")[0]

    def text(self) -> str:
        """Take a name."""
        end = self._data.find(b"\0", self._at, self._at + _MAX_NAME_BYTES)
        if end < 0:
            is_cut = len(self._data) - self._at <= _MAX_NAME_BYTES
            raise self.damaged("it ends too early" if is_cut else "an image name does not end")
        try:
            return self._take(end + 1 - self._at)[:-1].decode()
        except UnicodeDecodeError:
            raise self.damaged("an image name is not text") from None

    def keypoints(self) -> NDArray[Any]:
        """Take the keypoints of an image."""
        return np.frombuffer(self._take(KEYPOINT.itemsize * self.integers("Q")[0]), dtype=KEYPOINT)

    def points(self) -> NDArray[Any]:
        """Take all points."""
        rows = []
        for _ in self.records(POINT.itemsize):
            rows.append(self._take(POINT.itemsize))
            self._take(ELEMENT.itemsize * int.from_bytes(rows[-1][-8:], "little"))
        return np.frombuffer(b"".join(rows), dtype=POINT)

    def _take(self, size: int) -> bytes:
        if size > len(self._data) - self._at:
            raise self.damaged("it ends too early")
        self._at += size
        return self._data[self._at - size : self._at]

    def doubles(self, count: int) -> F64:
        """See `_File`."""
        return np.frombuffer(self._take(8 * count), dtype="<f8").astype(np.float64)


class _Text(_File):
    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._lines = enumerate(read_foreign_text(path, _MAX_BYTES).split("\n"), start=1)
        self._words = list[str]()

    def records(self, least_bytes: int) -> Iterator[None]:  # noqa: ARG002
        """See `_Binary`."""
        announced: re.Match[str] | None = None
        count = 0
        for number, line in self._lines:
            self._line = f":{number}"
            if line.startswith("#"):
                announced = announced or ANNOUNCED.search(line)
            elif line.strip():
                self.wanted = _COLUMNS[self.path.stem]
                self._words = line.split(maxsplit=_CUTS.get(self.path.stem, -1))[::-1]
                yield
                if self._words and self.path.stem != "points3D":
                    raise self.damaged(f"wants {self.wanted}")
                count += 1
        if announced is not None and int(announced[1]) != count:
            raise MapError(
                f"{self.path}: is damaged: it announces {announced[1]} records and has {count}; {REMEDY}"
            )

    def integers(self, layout: str) -> tuple[int, ...]:
        """See `_Binary`."""
        numbers = tuple(self._next(int) for _ in layout)
        if not all(0 <= number < _LARGEST_ID for number in numbers):
            raise self.damaged("a whole number is negative or too large")
        return numbers

    def word(self, numbers: Mapping[str, int]) -> Any:
        """See `_Binary`."""
        word = self._next(str)
        return numbers.get(word, word)

    def text(self) -> str:
        """See `_Binary`."""
        return self._next(str.strip)

    def keypoints(self) -> NDArray[Any]:
        """See `_Binary`."""
        number, line = next(self._lines, (0, ""))
        self._line = f":{number}"
        try:
            values = np.array(line.split(), dtype=np.float64).reshape(-1, 3)
        except ValueError:
            raise self.damaged("wants X Y POINT3D_ID of each keypoint") from None
        if not np.all(np.abs(values[:, 2]) < _LARGEST_ID):
            raise self.damaged("a point id is too large")
        table = np.zeros(len(values), dtype=KEYPOINT)
        table["uv"], table["point"] = values[:, :2], values[:, 2]
        return table

    def points(self) -> NDArray[Any]:
        """See `_Binary`."""
        rows = [(*self.integers("Q"), *self.doubles(7)) for _ in self.records(0)]
        values = np.array(rows, dtype=np.float64).reshape(-1, 8)
        if not np.isfinite(values).all():
            raise self.damaged("it has points that are not finite")
        table = np.zeros(len(values), dtype=POINT)
        table["id"], table["p_W"], table["error"] = values[:, 0], values[:, 1:4], values[:, 7]
        table["colour"] = np.clip(values[:, 4:7], 0.0, 255.0)
        return table

    def doubles(self, count: int) -> F64:
        """See `_File`."""
        return np.array([self._next(float) for _ in range(count)])

    def _next(self, kind: Callable[[str], _T]) -> _T:
        try:
            return kind(self._words.pop())
        except (IndexError, ValueError):
            raise self.damaged(f"wants {self.wanted}") from None


Records = _Binary | _Text
"""A file of a model; both forms have the same methods."""
FILES_OF: dict[str, Callable[[Path], Records]] = {".bin": _Binary, ".txt": _Text}
"""Files by their suffix."""


_TO_FILE = [3, 0, 1, 2, 4, 5, 6]  # the quaternion's w comes first


def binary_files(model: ColmapModel) -> dict[str, Iterator[bytes]]:
    """Return the content of the files of a model by name."""
    return {
        "cameras.bin": _encode_cameras(model),
        "rigs.bin": _encode_rigs(model),
        "frames.bin": _encode_frames(model),
        "images.bin": _encode_images(model),
        "points3D.bin": _encode_points(model),
    }


def _encode_cameras(model: ColmapModel) -> Iterator[bytes]:
    yield struct.pack("<Q", len(model.cameras))
    for camera in model.cameras:
        yield struct.pack("<IiQQ", camera.id, camera.model, camera.width_px, camera.height_px)
        yield _doubles(camera.parameters)


def _encode_rigs(model: ColmapModel) -> Iterator[bytes]:
    yield struct.pack("<Q", len(model.rigs))
    for rig in model.rigs:
        yield struct.pack("<II", rig.id, len(rig.cameras))
        for place, camera in enumerate(rig.cameras):
            yield struct.pack("<iI", CAMERA_SENSOR, model.cameras[camera].id)
            if place:
                yield b"\x01" + _doubles(rig.T_C_R[place, _TO_FILE])


def _encode_frames(model: ColmapModel) -> Iterator[bytes]:
    frames, images = model.frames, model.images
    order = np.argsort(images.frame, kind="stable")
    start = starts_of_counts(np.bincount(images.frame, minlength=len(frames.id)))
    yield struct.pack("<Q", len(frames.id))
    for row, (number, rig) in enumerate(zip(frames.id.tolist(), frames.rig.tolist(), strict=True)):
        mine = order[start[row] : start[row + 1]]
        yield struct.pack("<II", number, model.rigs[rig].id) + _doubles(frames.T_R_W[row, _TO_FILE])
        yield struct.pack("<I", len(mine))
        for camera, image in zip(
            images.camera[mine].tolist(), images.id[mine].tolist(), strict=True
        ):
            yield struct.pack("<iIQ", CAMERA_SENSOR, model.cameras[camera].id, image)


def _encode_images(model: ColmapModel) -> Iterator[bytes]:
    images = model.images
    keypoints = np.zeros(len(images.uv), dtype=KEYPOINT)
    keypoints["uv"], keypoints["point"] = images.uv, model.point_id
    start = images.keypoint_start.tolist()
    yield struct.pack("<Q", len(images.id))
    for row, name in enumerate(images.name):
        camera = model.cameras[int(images.camera[row])]
        yield struct.pack("<I", int(images.id[row])) + _doubles(images.T_C_W[row, _TO_FILE])
        yield struct.pack("<I", camera.id) + name.encode() + b"\0"
        yield struct.pack("<Q", start[row + 1] - start[row])
        yield keypoints[start[row] : start[row + 1]].tobytes()


def _encode_points(model: ColmapModel) -> Iterator[bytes]:
    points, images = model.points, model.images
    observing = np.flatnonzero(images.point >= 0)
    row = images.point[observing]
    length = np.bincount(row, minlength=len(points.id))
    observing = observing[np.argsort(row, kind="stable")]
    records = np.zeros(len(points.id), dtype=POINT)
    records["id"], records["p_W"], records["colour"] = points.id, points.p_W, points.colour
    records["error"], records["length"] = points.error_px, length
    image = images.keypoint_image[observing]
    elements = np.zeros(len(observing), dtype=ELEMENT)
    elements["image"] = images.id[image]
    elements["keypoint"] = observing - images.keypoint_start[image]
    start = starts_of_counts(length).tolist()
    yield struct.pack("<Q", len(points.id))
    for number, record in enumerate(records):
        yield record.tobytes() + elements[start[number] : start[number + 1]].tobytes()


def _doubles(values: F64) -> bytes:
    return np.asarray(values, dtype="<f8").tobytes()
