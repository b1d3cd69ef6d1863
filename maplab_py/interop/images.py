"""Pixels of images as cameras and drivers store them, converted to grey or BGR of 8 or 16 bits.

Sources: ROS, sensor_msgs/image_encodings.hpp and compressed_image_transport (the text of `format`); OpenCV,
"Color conversions" (its Bayer names begin with the second row: RGGB is BayerBG); PNG, ISO/IEC 15948; JPEG,
ITU-T T.81.
"""

import dataclasses
import io
import re
from collections.abc import Iterable
from typing import Any

import numpy as np

from maplab_py.array_types import U8, NDArray
from maplab_py.errors import MapError

Pixels = NDArray[np.uint8] | NDArray[np.uint16]
REMEDY = "leave it out with --vio_rosbag_start_s and --vio_rosbag_end_s, or copy it again"
CONTAINER_BITS = 16
"""Bits of the words in which cameras of 10, 12 and 14 bits store their values."""
SAMPLES = 8
"""Images of a camera in which the range of its values is sought."""
_CAMERA_BITS = (8, 10, 12, 14, 16)
_PNG = b"\x89PNG\r\n\x1a\n"
_PNG_BIT_DEPTH = 24  # place of the byte in the file
_ENDS = {_PNG: b"IEND\xaeB`\x82", b"\xff\xd8": b"\xff\xd9"}
"""First and last bytes of PNG and JPEG images."""
_OTHER_FORMATS = {
    b"RIFF": "WebP",
    b"BM": "BMP",
    b"II*\x00": "TIFF",
    b"MM\x00*": "TIFF",
    b"P5": "PGM",
}
_VIDEO = re.compile(r"h\.?26[3-6]|hevc|avc|av1|vp[89]|mpeg-?[124]|theora|video", re.IGNORECASE)
_VIDEO_START = (b"\x00\x00\x00\x01", b"\x00\x00\x01")  # Annex B of H.264 and H.265
_BAYER_CODES = {"rggb": "BayerBG", "bggr": "BayerRG", "gbrg": "BayerGR", "grbg": "BayerGB"}


@dataclasses.dataclass(frozen=True)
class Encoding:
    """Layout of the pixels of a raw image."""

    type: type[Any]
    channels: int  # numbers per pixel in a row
    code: str = ""  # conversion of OpenCV; empty = none
    planes: float = 1.0  # rows of the data per row of the image
    bits: int = 0  # of a value, where the name tells them


_YUYV, _UYVY = (Encoding(np.uint8, 2, f"YUV2BGR_{name}") for name in ("YUY2", "UYVY"))
ENCODINGS = {
    "mono8": Encoding(np.uint8, 1),
    "mono16": Encoding(np.uint16, 1),
    "bgr8": Encoding(np.uint8, 3),
    "rgb8": Encoding(np.uint8, 3, "RGB2BGR"),
    "bgra8": Encoding(np.uint8, 4, "BGRA2BGR"),
    "rgba8": Encoding(np.uint8, 4, "RGBA2BGR"),
    "bgr16": Encoding(np.uint16, 3),
    "rgb16": Encoding(np.uint16, 3, "RGB2BGR"),
    "bgra16": Encoding(np.uint16, 4, "BGRA2BGR"),
    "rgba16": Encoding(np.uint16, 4, "RGBA2BGR"),
    "8uc1": Encoding(np.uint8, 1),
    "8uc3": Encoding(np.uint8, 3),
    "8uc4": Encoding(np.uint8, 4, "BGRA2BGR"),
    "16uc1": Encoding(np.uint16, 1),
    "16uc3": Encoding(np.uint16, 3),
    "16uc4": Encoding(np.uint16, 4, "BGRA2BGR"),
    **{f"mono{bits}": Encoding(np.uint16, 1, bits=bits) for bits in (10, 12, 14)},
    **{
        f"bayer_{pattern}{bits}": Encoding(
            np.uint8 if bits == 8 else np.uint16, 1, f"{code}2BGR", bits=bits % CONTAINER_BITS
        )
        for pattern, code in _BAYER_CODES.items()
        for bits in _CAMERA_BITS
    },
    **dict.fromkeys(("yuv422_yuy2", "yuyv", "yuy2"), _YUYV),
    **dict.fromkeys(("yuv422", "uyvy"), _UYVY),
    "nv12": Encoding(np.uint8, 1, "YUV2BGR_NV12", planes=1.5),
    "nv21": Encoding(np.uint8, 1, "YUV2BGR_NV21", planes=1.5),
    "i420": Encoding(np.uint8, 1, "YUV2BGR_I420", planes=1.5),
    "nv24": Encoding(np.uint8, 1),  # the plane of luminance
}
"""Encodings of raw images, in lower case."""


def encoding_of(name: str, image: str) -> Encoding:
    """Return a raw encoding by its ROS name.

    Raises:
        MapError: It is unknown, or no picture; names the image.
    """
    encoding = ENCODINGS.get(name.lower())
    if encoding is None:
        kind = "are depths or measurements" if re.search(r"[FS]C\d|32|64", name) else "are unknown"
        raise MapError(
            f"{image}: pixels of the encoding '{name}' {kind}: record mono8, bgr8, a Bayer pattern or YUV, "
            "or name another topic"
        )
    return encoding


def converted(pixels: Any, code: str, name: str) -> Pixels:
    """Return pixels after a colour conversion of OpenCV."""
    import cv2

    if not code:
        unchanged: Pixels = pixels
        return unchanged
    try:
        converted: Pixels = cv2.cvtColor(pixels, getattr(cv2, f"COLOR_{code}"))
    except cv2.error as error:
        raise MapError(
            f"{name}: an image of this size cannot be in {code.split('2', maxsplit=1)[0]}"
        ) from error
    return converted


def encoded_size(name: str, data: bytes, form: str = "") -> tuple[int, int]:
    """Return width and height of a PNG or JPEG image from its header; its end is checked.

    Raises:
        MapError: It is neither, it is truncated, or a checksum is wrong.
    """
    end = next((end for start, end in _ENDS.items() if data.startswith(start)), b"")
    if end:
        return _whole_size(name, data, end)
    if not data:
        raise MapError(f"{name}: the image is empty; {REMEDY}")
    if _VIDEO.search(form) or data.startswith(_VIDEO_START):
        what = f"'{form}'" if _VIDEO.search(form) else "H.264 or H.265"
        raise MapError(
            f"{name}: {what} is a video, of which single messages are no images: decode it to PNG, JPEG or "
            "raw images first, as with ROS' `image_transport republish`"
        )
    if "compressedDepth" in form:
        raise MapError(f"{name}: '{form}' are depths: name the topic of a camera's images")
    other = next((kind for start, kind in _OTHER_FORMATS.items() if data.startswith(start)), "")
    if other:
        raise MapError(f"{name}: {other} images are not read: convert them to PNG")
    raise MapError(f"{name}: it is neither a PNG nor a JPEG image; {REMEDY}")


def has_16_bits(data: bytes) -> bool:
    """Return whether the first bytes of a file are those of a PNG image of 16 bits."""
    return data.startswith(_PNG) and data[_PNG_BIT_DEPTH : _PNG_BIT_DEPTH + 1] == b"\x10"


def sampled(count: int) -> list[int]:
    """Return up to `SAMPLES` of so many numbers, evenly spread."""
    return sorted({int(k) for k in np.linspace(0, count - 1, min(SAMPLES, count))})


def bits_of(images: Iterable[Pixels]) -> int:
    """Return the bits of the camera whose images of 16 bits these are: 8, 10, 12, 14 or 16."""
    largest = max((int(image.max(initial=0)) for image in images), default=0)
    return next(bits for bits in _CAMERA_BITS if largest < 1 << bits)


def as_8_bits(pixels: Any, bits: int) -> U8:
    """Return pixels of a camera of so many bits as 8 bits; values beyond its range become white."""
    if pixels.dtype != np.uint16:
        return np.asarray(pixels, dtype=np.uint8)
    shift = max(bits - 8, 0)
    return np.asarray(np.minimum(pixels >> shift, 255), dtype=np.uint8)


def as_grey(pixels: Any, bits: int) -> U8:
    """Return 8-bit grey values (H, W) of an image (H, W) or (H, W, 3) BGR."""
    import cv2

    if pixels.ndim == 3:
        pixels = cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY)
    return as_8_bits(pixels, bits)


def _whole_size(name: str, data: bytes, end: bytes) -> tuple[int, int]:
    """Return width and height of a PNG or JPEG image; more may follow its end: padding, or a short video."""
    from PIL import Image

    Image.MAX_IMAGE_PIXELS = None  # nothing is decoded here
    stream, size, place = io.BytesIO(data), (0, 0), 0
    try:
        with Image.open(stream, formats=("PNG", "JPEG")) as image:
            size, place = image.size, stream.tell()
            image.verify()  # the checksums of PNG
    except Exception:  # noqa: BLE001  (the library's own, of any type)
        size = (0, 0)
    if not all(size) or data.rfind(end, place) < 0:
        problem = "damaged" if end in data else "truncated"
        raise MapError(f"{name}: the image is {problem}; {REMEDY}")
    return size
