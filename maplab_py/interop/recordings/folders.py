"""Recordings as folders in the form of EuRoC (ASL): `mav0/cam0`, `mav0/cam1`, `mav0/imu0`.

TUM-VI's folders have the same form, with images of 8 or 16 bits.
"""

from __future__ import annotations

import heapq
import os
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path

import numpy as np

from maplab_py.array_types import I64
from maplab_py.errors import MapError
from maplab_py.input_files import read_text
from maplab_py.interop.images import CONTAINER_BITS, sampled
from maplab_py.interop.imu_csv import ImuRecording, read_imu_csv
from maplab_py.interop.recordings.images import bits_note, camera_bits, image_file
from maplab_py.interop.recordings.protocol import CameraImage, ImuBatch, Item, RecordedSensors
from maplab_py.sensors import Camera

_MAX_BYTES = 500_000_000
_LARGEST_BATCH = 1000


def image_root(path: Path) -> Path | None:
    """Return the folder with cam0 of a recording (mav0 or the path itself), None if there is none."""
    for folder in (path / "mav0", path):
        if (folder / "cam0").is_dir():
            return folder
    return None


class FolderRecording:
    """Reads a folder in the form of EuRoC."""

    kind = "EuRoC folder"

    def __init__(
        self,
        root: Path,
        device: RecordedSensors,
        camera_folders: tuple[int, ...] = (),
        *,
        image_bits: int = 0,
    ) -> None:
        """Open a recording.

        Args:
            root: Folder with cam0.
            device: Sensors.
            camera_folders: Number of the folder cam<number> of each camera; () = 0, 1, ...
            image_bits: Bits of values that are stored in 16; 0 = found.

        Raises:
            MapError: A table is missing, empty or wrong, or names an image that is not there.
        """
        self.name, self.device, self._root = str(root), device, root
        self._given_bits, self._bits = image_bits, [CONTAINER_BITS] * len(device.cameras)
        numbers = camera_folders or tuple(range(len(device.cameras)))
        self._cameras = [
            _ImageList(root / f"cam{number}", camera)
            for number, camera in zip(numbers, device.cameras, strict=True)
        ]

    @property
    def notes(self) -> tuple[str, ...]:
        """Parts of the recording that are not read, and how the others are."""
        notes = [bits_note(c, bits) for c, bits in enumerate(self._bits) if bits < CONTAINER_BITS]
        if not self.device.imu_id and (self._root / "imu0").is_dir():
            notes.append(
                "imu0 is not read: the calibration has no IMU, --imu_calibration_file names its file"
            )
        return tuple(notes)

    @cached_property
    def _imu(self) -> ImuRecording | None:
        if not self.device.imu_id:
            return None
        path = self._root / "imu0" / "data.csv"
        if not path.exists():
            raise MapError(
                f"{path}: the table is missing: copy the folder again, or give a calibration "
                "without IMU"
            )
        return read_imu_csv(path)

    @property
    def start_ns(self) -> int:
        """Time of the first item."""
        starts = [int(camera.times_ns[0]) for camera in self._cameras]
        if self._imu is not None:
            starts.append(int(self._imu.times_ns[0]))
        return min(starts)

    def items(self, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Item]:
        """Yield images and the IMU samples between them; see `Recording.items`."""
        streams = []
        for row, camera in enumerate(self._cameras):
            first, end = _range(camera.times_ns, start_ns, end_ns)
            samples = [camera.image(row, first + k) for k in sampled(end - first)]
            bits = self._given_bits or camera_bits(samples)
            self._bits[row] = CONTAINER_BITS if bits == 8 or self._given_bits else bits
            streams.append(camera.images(row, range(first, end), bits))
        images = heapq.merge(*streams, key=lambda image: (image.time_ns, image.camera))
        imu, table = self.device.imu, self._imu
        if imu is None or table is None:
            yield from images
            return
        row, end = _range(table.times_ns, start_ns, end_ns)
        for image in images:
            until = min(int(np.searchsorted(table.times_ns, image.time_ns, side="right")), end)
            while row < until:
                rows = slice(row, min(until, row + _LARGEST_BATCH))
                yield ImuBatch.of(imu, table.times_ns[rows], table.accel_gyro[rows])
                row = rows.stop
            yield image
        for first in range(row, end, _LARGEST_BATCH):
            rows = slice(first, min(end, first + _LARGEST_BATCH))
            yield ImuBatch.of(imu, table.times_ns[rows], table.accel_gyro[rows])


class _ImageList:
    """The images of one camera: stamps and file names."""

    def __init__(self, folder: Path, camera: Camera) -> None:
        if not folder.is_dir():
            raise MapError(
                f"{folder}: the folder is missing, although the calibration has this camera: choose "
                "cameras with --rovio_active_camera_indices"
            )
        self._folder, self._camera = folder / "data", camera
        table = folder / "data.csv"
        self._stamps_ns, self._files = _read_image_table(table)
        self.times_ns = self._stamps_ns + camera.time_offset_ns
        self._check_files(table)

    def images(self, row: int, indices: range, bits: int) -> Iterator[CameraImage]:
        """Yield images as those of the camera with this row."""
        for index in indices:
            yield self.image(row, index, bits)

    def image(self, row: int, index: int, bits: int = CONTAINER_BITS) -> CameraImage:
        """Return an image as that of the camera with this row."""
        data = image_file(self._folder / self._files[index], self._camera)
        times_ns = int(self.times_ns[index]), int(self._stamps_ns[index])
        return CameraImage(row, *times_ns, data, bits)

    def _check_files(self, table: Path) -> None:
        try:
            present = set(os.listdir(self._folder))
        except OSError as error:
            raise MapError(
                f"cannot read {self._folder}: {error.strerror}: copy the images there"
            ) from error
        missing = [name for name in self._files if name not in present]
        if missing:
            raise MapError(
                f"{self._folder / missing[0]}: the image is missing ({len(missing)} of "
                f"{len(self._files)} are): copy them, or remove their rows from {table}"
            )


def _read_image_table(path: Path) -> tuple[I64, list[str]]:
    """Return stamps and file names of a table `stamp,file`; names no path outside the folder."""
    try:
        remedy = "split the recording"
        text = read_text(path, _MAX_BYTES, remedy=remedy, error=MapError, encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        raise MapError(f"cannot read {path}: {reason}: copy the folder again") from error
    numbers, words = [], []
    for number, line in enumerate(text.splitlines(), start=1):
        content = line.strip()
        if content and not content.startswith("#"):
            numbers.append(number)
            words.append([word.strip() for word in content.replace(",", " ").split()])
    if not words:
        raise MapError(f"{path}: the recording is empty: there are no images in the table")
    for number, row in zip(numbers, words, strict=True):
        if len(row) != 2 or not row[0].isdecimal() or len(row[0]) > 19 or "/" in row[1]:
            raise MapError(
                f"{path}:{number}: a row must be a time stamp [ns] and the name of an image"
            )
    stamps_ns = np.array([int(row[0]) for row in words], dtype=np.uint64).astype(np.int64)
    late = np.flatnonzero(np.diff(stamps_ns) <= 0)
    if len(late):
        raise MapError(
            f"{path}:{numbers[late[0] + 1]}: the time stamp does not come after that of the row "
            "above: sort the rows or remove this one"
        )
    return stamps_ns, [row[1] for row in words]


def _range(times_ns: I64, start_ns: int | None, end_ns: int | None) -> tuple[int, int]:
    """Return the rows of times from start_ns up to but not including end_ns."""
    first = 0 if start_ns is None else int(np.searchsorted(times_ns, start_ns, side="left"))
    end = len(times_ns) if end_ns is None else int(np.searchsorted(times_ns, end_ns, side="left"))
    return first, max(first, end)
