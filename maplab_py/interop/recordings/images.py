"""Images as they are recorded: files, compressed messages, raw messages; decoded when asked for."""

import contextlib
import dataclasses
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.array_types import U8
from maplab_py.errors import MapError, os_errors_as
from maplab_py.input_files import read_bytes
from maplab_py.interop import images as pixel_data
from maplab_py.interop.recordings.protocol import CameraImage
from maplab_py.sensors import Camera

_MAX_FILE_BYTES = 200_000_000


@dataclasses.dataclass(frozen=True, eq=False)
class EncodedImage:
    """A PNG or JPEG image."""

    name: str  # file, or topic and stamp
    camera: Camera
    read: Callable[[], bytes]
    form: str = ""  # of a CompressedImage

    def check(self) -> None:
        """Check size and completeness; see `ImageData.check`."""
        self._whole()

    def size_px(self) -> tuple[int, int]:
        """Return width and height as recorded.

        Raises:
            MapError: The image cannot be read.
        """
        return pixel_data.encoded_size(self.name, self.read())

    def decode(self) -> pixel_data.Pixels:
        """Return the pixels; see `ImageData.decode`."""
        import cv2

        flags = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION
        pixels: Any = cv2.imdecode(np.frombuffer(self._whole(), dtype=np.uint8), flags)
        if pixels is None:
            raise MapError(f"{self.name}: the image is damaged; {pixel_data.REMEDY}")
        if pixels.dtype not in (np.uint8, np.uint16):
            raise MapError(
                f"{self.name}: pixels of type {pixels.dtype} are not supported: use 8 or 16 bits"
            )
        source = self.form.split(";", maxsplit=1)[0].strip().lower()
        is_mosaic = pixels.ndim == 2 and source.startswith("bayer_")  # the transport stores it so
        code = pixel_data.encoding_of(source, self.name).code if is_mosaic else ""
        return pixel_data.converted(pixels, code, self.name)

    @property
    def encoding(self) -> str:
        """Name of the encoding."""
        data = self.read()
        kind = (
            "PNG, 16 bits"
            if pixel_data.has_16_bits(data)
            else "PNG"
            if data[1:4] == b"PNG"
            else "JPEG"
        )
        source = self.form.split(";")[0].strip()
        return f"{kind} of {source}" if source.startswith("bayer_") else kind

    @property
    def bits(self) -> int:
        """Bits of a value; 0 = not known without looking at the values."""
        return 0 if pixel_data.has_16_bits(self.read()) else 8

    def _whole(self) -> bytes:
        data = self.read()
        width, height = pixel_data.encoded_size(self.name, data, self.form)
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

    def size_px(self) -> tuple[int, int]:
        """Return width and height as recorded."""
        return self.width_px, self.height_px

    def check(self) -> None:
        """Check size and completeness; see `ImageData.check`."""
        check_size(self.name, self.camera, self.width_px, self.height_px)
        self._rows()

    def decode(self) -> pixel_data.Pixels:
        """Return the pixels; see `ImageData.decode`."""
        check_size(self.name, self.camera, self.width_px, self.height_px)
        described, stored = self._rows()
        dtype = np.dtype(described.type).newbyteorder(">" if self.is_big_endian else "<")
        pixels: Any = np.ascontiguousarray(stored).view(dtype).astype(described.type, copy=False)
        if described.channels > 1:
            pixels = pixels.reshape(len(stored), self.width_px, described.channels)
        return pixel_data.converted(pixels, described.code, self.name)

    def _rows(self) -> tuple[pixel_data.Encoding, U8]:
        """Return the encoding, and the bytes of the rows (rows, bytes).

        Raises:
            MapError: The encoding is unknown, or rows or data are too short.
        """
        described, size = pixel_data.encoding_of(self.encoding, self.name), len(self.data)
        row_bytes = self.width_px * described.channels * np.dtype(described.type).itemsize
        rows = round(self.height_px * described.planes)
        step = self.step or size // rows  # some drivers do not set it
        if step < row_bytes or size < step * rows:
            raise MapError(
                f"{self.name}: the image is truncated: {size} bytes in rows of {step}, {row_bytes * rows} "
                f"are needed; {pixel_data.REMEDY}"
            )
        stored = np.frombuffer(self.data, dtype=np.uint8, count=step * rows).reshape(rows, step)
        return described, stored[:, :row_bytes]

    @property
    def bits(self) -> int:
        """Bits of a value; 0 = not known without looking at the values."""
        described = pixel_data.encoding_of(self.encoding, self.name)
        return described.bits or (8 if described.type().itemsize == 1 else 0)


def image_file(path: Path, camera: Camera) -> EncodedImage:
    """Return the image of a file."""

    def read() -> bytes:
        with os_errors_as(MapError, f"{path}: the image cannot be read"):
            return read_bytes(path, _MAX_FILE_BYTES, remedy="it is no image", error=MapError)

    return EncodedImage(str(path), camera, read)


def image_of_message(message: Any, name: str, camera: Camera) -> EncodedImage | RawImage:
    """Return the image of a sensor_msgs/Image or CompressedImage."""
    if not hasattr(message, "encoding"):
        return EncodedImage(name, camera, message.data.tobytes, message.format)
    return RawImage(
        name,
        camera,
        message.encoding,
        int(message.width),
        int(message.height),
        int(message.step),
        bool(message.is_bigendian),
        message.data,
    )


def camera_bits(images: Iterable[CameraImage]) -> int:
    """Return the bits of a camera, sought in those of its images that can be decoded.

    The first image that tells them ends the search: only those of 16 bits are read further.
    """
    decoded = []
    for image in images:
        with contextlib.suppress(MapError):  # whoever needs the image is told
            if image.data.bits:
                return image.data.bits
            decoded.append(image.decode())
    return pixel_data.bits_of(decoded) if decoded else pixel_data.CONTAINER_BITS


def bits_note(camera: int, bits: int) -> str:
    """Return a line on a camera whose values of fewer bits are stored in 16."""
    return (
        f"camera {camera}: images of 16 bits are read as {bits} bits: no value of "
        f"{pixel_data.SAMPLES} images is above {(1 << bits) - 1} (another range: --image_bits)"
    )


def check_size(name: str, camera: Camera, width_px: int, height_px: int) -> None:
    """Check that an image has the size of its camera.

    Raises:
        MapError: It has another; names both.
    """
    if (width_px, height_px) != (camera.width_px, camera.height_px):
        remedy = "calibrate the camera at the size it records"
        if (width_px, height_px) == (camera.height_px, camera.width_px):
            remedy = "does the calibration have the height before the width?"
        raise MapError(
            f"{name}: the image is {width_px} x {height_px}, the calibration is of "
            f"{camera.width_px} x {camera.height_px}: {remedy}"
        )
