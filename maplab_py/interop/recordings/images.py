"""Images as they are recorded: files, compressed messages, raw messages; decoded when asked for."""

from __future__ import annotations

import dataclasses
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.errors import MapError
from maplab_py.input_files import read_bytes
from maplab_py.interop.recordings.protocol import Pixels
from maplab_py.sensors import Camera

_MAX_FILE_BYTES = 200_000_000
_PNG, _PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND"
_JPEG, _JPEG_END = b"\xff\xd8", b"\xff\xd9"
_TAIL = 64
"""Bytes at the end of a file in which the end marker must be; some writers pad."""
_JPEG_FRAME_MARKERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}

ENCODINGS: dict[str, tuple[type[Any], int]] = {
    "mono8": (np.uint8, 1),
    "8UC1": (np.uint8, 1),
    "mono16": (np.uint16, 1),
    "16UC1": (np.uint16, 1),
    "rgb8": (np.uint8, 3),
    "bgr8": (np.uint8, 3),
    "8UC3": (np.uint8, 3),
}
"""Type and channels of the encodings of raw images."""


@dataclasses.dataclass(frozen=True, eq=False)
class EncodedImage:
    """A PNG or JPEG image."""

    name: str  # file, or topic and stamp
    camera: Camera
    read: Callable[[], bytes]

    def check(self) -> None:
        """Check size and completeness; see `ImageData.check`."""
        self._checked_bytes()

    def decode(self) -> Pixels:
        """Return the pixels; see `ImageData.decode`."""
        import cv2

        flags = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION
        pixels: Any = cv2.imdecode(np.frombuffer(self._checked_bytes(), dtype=np.uint8), flags)
        if pixels is None:
            raise MapError(f"{self.name}: the image is damaged; {_REMEDY}")
        return _checked_type(pixels, self.name)

    def _checked_bytes(self) -> bytes:
        data = self.read()
        width, height = encoded_size(data, self.name)
        check_size(self.name, self.camera, width, height)
        return data


@dataclasses.dataclass(frozen=True, eq=False)
class RawImage:
    """An uncompressed image message."""

    name: str
    camera: Camera
    encoding: str
    width_px: int
    height_px: int
    step: int  # bytes of a row
    is_big_endian: bool
    data: Any  # buffer

    def check(self) -> None:
        """Check size and completeness; see `ImageData.check`."""
        if self.encoding not in ENCODINGS:
            known = ", ".join(ENCODINGS)
            raise MapError(
                f"{self.name}: encoding '{self.encoding}' is not supported: record one of {known}"
            )
        check_size(self.name, self.camera, self.width_px, self.height_px)
        kind, channels = ENCODINGS[self.encoding]
        row_bytes = self.width_px * channels * np.dtype(kind).itemsize
        if self.step < row_bytes or len(self.data) < self.step * self.height_px:
            raise MapError(
                f"{self.name}: the image is truncated: {len(self.data)} bytes in rows of "
                f"{self.step}, {row_bytes * self.height_px} are needed; {_REMEDY}"
            )

    def decode(self) -> Pixels:
        """Return the pixels; see `ImageData.decode`."""
        self.check()
        kind, channels = ENCODINGS[self.encoding]
        dtype = np.dtype(kind).newbyteorder(">" if self.is_big_endian else "<")
        count = self.step * self.height_px
        rows = np.frombuffer(self.data, dtype=np.uint8, count=count).reshape(self.height_px, -1)
        row_bytes = self.width_px * channels * dtype.itemsize
        pixels = np.ascontiguousarray(rows[:, :row_bytes]).view(dtype).astype(kind)
        if channels == 1:
            return pixels
        pixels = pixels.reshape(self.height_px, self.width_px, channels)
        return np.ascontiguousarray(pixels[:, :, ::-1]) if self.encoding == "rgb8" else pixels


_REMEDY = "leave it out with --vio_rosbag_start_s and --vio_rosbag_end_s, or copy it again"


def image_file(path: Path, camera: Camera) -> EncodedImage:
    """Return the image of a file."""

    def read() -> bytes:
        try:
            return read_bytes(path, _MAX_FILE_BYTES, remedy="it is no image", error=MapError)
        except OSError as error:
            raise MapError(f"{path}: the image cannot be read ({error.strerror})") from error

    return EncodedImage(str(path), camera, read)


def check_size(name: str, camera: Camera, width_px: int, height_px: int) -> None:
    """Check that an image has the size of its camera.

    Raises:
        MapError: It has another; names both.
    """
    if (width_px, height_px) != (camera.width_px, camera.height_px):
        raise MapError(
            f"{name}: the image is {width_px} x {height_px}, the calibration is of "
            f"{camera.width_px} x {camera.height_px}: calibrate the camera at the size it records"
        )


def encoded_size(data: bytes, name: str) -> tuple[int, int]:
    """Return width and height of a PNG or JPEG image from its header.

    Raises:
        MapError: It is neither, it is truncated, or a checksum is wrong.
    """
    if data.startswith(_PNG):
        _check_png(data, name)
        width, height = struct.unpack(">II", data[16:24])
        return int(width), int(height)
    if data.startswith(_JPEG):
        size = _jpeg_size(data)
        if size is None or _JPEG_END not in data[-_TAIL:]:
            raise MapError(f"{name}: the image is truncated; {_REMEDY}")
        return size
    if not data:
        raise MapError(f"{name}: the image is empty; {_REMEDY}")
    raise MapError(f"{name}: it is neither a PNG nor a JPEG image; {_REMEDY}")


def _check_png(data: bytes, name: str) -> None:
    """Check that all chunks of a PNG image are there, with their checksums."""
    place, kind = len(_PNG), b""
    while kind != _PNG_END:
        if place + 12 > len(data):
            raise MapError(f"{name}: the image is truncated; {_REMEDY}")
        size, kind = struct.unpack(">I4s", data[place : place + 8])
        end = place + 8 + size
        if end + 4 > len(data):
            raise MapError(f"{name}: the image is truncated; {_REMEDY}")
        is_first = place == len(_PNG)
        checksum = struct.unpack(">I", data[end : end + 4])[0]
        if zlib.crc32(memoryview(data)[place + 4 : end]) != checksum or (
            is_first and (kind, size) != (b"IHDR", 13)
        ):
            raise MapError(f"{name}: the image is damaged; {_REMEDY}")
        place = end + 4


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    """Return width and height from the frame header, None when it is not there."""
    place = 2
    while place + 9 <= len(data) and data[place] == 0xFF:
        marker = data[place + 1]
        if marker == 0xFF:  # fill byte
            place += 1
            continue
        if marker in _JPEG_FRAME_MARKERS:
            height, width = struct.unpack(">HH", data[place + 5 : place + 9])
            return int(width), int(height)
        place += 2 + int(struct.unpack(">H", data[place + 2 : place + 4])[0])
    return None


def _checked_type(pixels: Any, name: str) -> Pixels:
    if pixels.dtype not in (np.uint8, np.uint16):
        raise MapError(f"{name}: pixels of type {pixels.dtype} are not supported: use 8 or 16 bits")
    checked: Pixels = pixels
    return checked
