"""Pixels of every encoding: converted, or refused by name."""

from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from maplab_py.errors import MapError
from maplab_py.interop import images
from maplab_py.interop.recordings.images import EncodedImage, RawImage

HEIGHT, WIDTH = 48, 64
PATTERNS = {"rggb": "RGGB", "bggr": "BGGR", "gbrg": "GBRG", "grbg": "GRBG"}


def scene() -> np.ndarray:
    """A smooth coloured image (H, W, 3) BGR, whose mosaic loses little."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH] / 64.0
    channels = [60 + 120 * x, 90 + 100 * y, 200 - 110 * x * y]
    return np.stack(channels, axis=2).astype(np.uint8)


def mosaic(image: np.ndarray, pattern: str) -> np.ndarray:
    channel = {"B": 0, "G": 1, "R": 2}
    raw = np.empty(image.shape[:2], dtype=image.dtype)
    for place, colour in enumerate(pattern):
        row, column = divmod(place, 2)
        raw[row::2, column::2] = image[row::2, column::2, channel[colour]]
    return raw


CAMERA: Any = SimpleNamespace(width_px=WIDTH, height_px=HEIGHT)


def raw(encoding: str, step: int, data: bytes, *, is_big_endian: bool = False) -> Any:
    return RawImage("image", CAMERA, encoding, WIDTH, HEIGHT, step, is_big_endian, data).decode()


def encoded(data: bytes, form: str) -> Any:
    return EncodedImage("image", CAMERA, lambda: data, form).decode()


def read(encoding: str, stored: np.ndarray, padding: int = 6, **options: Any) -> np.ndarray:
    rows = np.ascontiguousarray(stored).view(np.uint8).reshape(stored.shape[0], -1)
    rows = np.pad(rows, ((0, 0), (0, padding)))
    data = rows.tobytes()
    return raw(encoding, rows.shape[1], data, **options)


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("bits", [8, 10, 12, 16])
def test_mosaics(pattern: str, bits: int) -> None:
    image = scene().astype(np.uint16) << (bits - 8) if bits > 8 else scene()
    pixels = read(f"bayer_{pattern}{bits}", mosaic(image, PATTERNS[pattern]))
    assert pixels.shape == image.shape
    error = images.as_8_bits(pixels, bits)[2:-2, 2:-2].astype(int) - scene()[2:-2, 2:-2]
    assert np.abs(error).max() <= 6


@pytest.mark.parametrize("name", ["yuv422_yuy2", "YUYV", "yuv422", "uyvy", "nv12", "nv21", "i420"])
def test_luminance_and_chroma(name: str) -> None:
    yuv = cv2.cvtColor(scene(), cv2.COLOR_BGR2YUV)
    y, u, v = yuv[..., 0], yuv[:, ::2, 1], yuv[:, ::2, 2]
    if name in ("nv12", "nv21", "i420"):
        u, v = u[::2], v[::2]
        pair = np.stack([u, v] if name == "nv12" else [v, u], axis=2).reshape(HEIGHT // 2, WIDTH)
        planes = np.concatenate([u.reshape(-1, WIDTH), v.reshape(-1, WIDTH)])
        stored = np.concatenate([y, planes if name == "i420" else pair])
    else:
        chroma = np.stack([u, v], axis=2).reshape(HEIGHT, WIDTH)
        order = [chroma, y] if name in ("yuv422", "uyvy") else [y, chroma]
        stored = np.stack(order, axis=2).reshape(HEIGHT, -1)
    padding = 0 if name == "i420" else 6
    grey = images.as_grey(read(name, stored, padding), 8)
    # BT.601 of video range; the plane itself is of full range
    expected = np.clip((y.astype(float) - 16.0) * 255.0 / 219.0, 0, 255)
    assert np.abs(grey - expected).max() < 12


@pytest.mark.parametrize("order", ["bgr", "rgb", "bgra", "rgba"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("is_big_endian", [False, True])
def test_channels_in_any_order(order: str, dtype: type, is_big_endian: bool) -> None:
    bits = 8 * np.dtype(dtype).itemsize
    image = scene().astype(dtype) << (bits - 8)
    channels = [image[..., "bgr".index(c)] if c != "a" else image[..., 0] * 0 for c in order]
    stored = np.stack(channels, axis=2).astype(
        np.dtype(dtype).newbyteorder("><"[not is_big_endian])
    )
    pixels = read(f"{order}{bits}", stored, is_big_endian=is_big_endian)
    np.testing.assert_array_equal(pixels, image)


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_the_range_of_a_camera(bits: int) -> None:
    image = (np.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH) % (1 << bits)).astype(np.uint16)
    image[0, 0] = (1 << bits) - 1
    assert images.bits_of([image // 3, image]) == bits
    eight = images.as_8_bits(read("mono16", image), bits)
    assert (int(eight.max()), eight.dtype) == (255, np.uint8)
    np.testing.assert_array_equal(eight, image >> (bits - 8))


def test_values_beyond_a_given_range_become_white() -> None:
    assert images.as_8_bits(np.array([[5000, 4095, 16]], dtype=np.uint16), 12).tolist() == [
        [255, 255, 1]
    ]


def test_compressed_mosaics() -> None:
    data = cv2.imencode(".png", mosaic(scene(), "RGGB"))[1].tobytes()
    pixels = encoded(data, "bayer_rggb8; png compressed ")
    assert np.abs(pixels[2:-2, 2:-2].astype(int) - scene()[2:-2, 2:-2]).max() <= 6
    assert encoded(data, "mono8; png compressed ").ndim == 2
    colours = cv2.imencode(".jpg", scene())[1].tobytes()
    assert encoded(colours, "bayer_rggb8; jpeg compressed bgr8").ndim == 3


@pytest.mark.parametrize(
    ("data", "form", "words"),
    [
        (b"\x00\x00\x00\x01\x67", "h264", "'h264' is a video"),
        (b"\x00\x00\x00\x01\x67", "", "H.264 or H.265 is a video"),
        (b"\x12\x00\x0a\x0b", "rgb8; av1 compressed", "is a video"),
        (b"....", "hevc", "'hevc' is a video.*republish"),
        (b"....", "16UC1; compressedDepth", "are depths"),
        (b"RIFF....WEBP", "webp", "WebP images are not read: convert them to PNG"),
        (b"text", "jpeg", "neither a PNG nor a JPEG"),
        (b"", "jpeg", "is empty"),
    ],
)
def test_other_messages_are_named(data: bytes, form: str, words: str) -> None:
    with pytest.raises(MapError, match=words):
        encoded(data, form)


@pytest.mark.parametrize("name", ["32FC1", "64FC3", "mono12p", "8UC2", ""])
def test_unknown_encodings_are_named(name: str) -> None:
    with pytest.raises(MapError, match=f"encoding '{name}'"):
        read(name, scene()[..., 0])


def test_short_data_are_refused_for_every_encoding() -> None:
    for name in images.ENCODINGS:
        with pytest.raises(MapError, match="truncated"):
            raw(name, WIDTH, bytes(WIDTH * HEIGHT - 1))
