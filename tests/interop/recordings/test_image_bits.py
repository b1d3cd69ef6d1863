"""Cameras of 10, 12 and 14 bits, whose values are stored in 16: the range is found and said."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from maplab_py.errors import FlagError
from maplab_py.interop.recordings.images import RawImage, camera_bits
from maplab_py.interop.recordings.opening import open_recording
from maplab_py.interop.recordings.options import ReadingOptions, SourceOptions, StreamOptions
from maplab_py.interop.recordings.protocol import CameraImage
from maplab_py.interop.recordings.stream import EventStream
from maplab_py.interop.recordings.summary import summarise
from maplab_py.sensors import Camera, Distortion, Projection
from tests.interop.recordings.written import (
    Content,
    frame_sets,
    make_content,
    write_bag,
    write_calibration,
    write_folder,
)


def content_of(bits: int) -> Content:
    """Images of both cameras whose values fill the range of a camera, dark at first."""
    content = make_content(dtype=np.uint16)
    images = tuple([image >> (16 - bits) for image in camera] for camera in content.images)
    for camera in images:
        camera[0] = camera[0] >> 4
    return dataclasses.replace(content, images=images)


def raw_image(pixels: np.ndarray) -> CameraImage:
    height, width = pixels.shape
    numbers = np.array([100.0, 100.0, 1.0, 1.0])
    camera = Camera(
        "c" * 32, Projection.PINHOLE, Distortion.NONE, numbers, np.zeros(0), width, height
    )
    encoding = "mono8" if pixels.dtype == np.uint8 else "mono16"
    data = RawImage(
        "an image", camera, encoding, width, height, pixels.strides[0], False, pixels.tobytes()
    )
    return CameraImage(0, 0, 0, data)


def opened(content: Content, tmp_path: Path, form: str, **options: object):
    folder = write_folder(content, tmp_path / "room")
    if form == "folder":
        return open_recording(folder, SourceOptions(reading=ReadingOptions(**options)))
    calibration = write_calibration(open_recording(folder).device, tmp_path / "sensors.yaml")
    encoding = "png" if form == "png" else "mono16"
    bag = write_bag(content, tmp_path / "a.bag", encoding=encoding)
    return open_recording(
        bag, SourceOptions(sensor_calibration_file=calibration, reading=ReadingOptions(**options))
    )


@pytest.mark.parametrize("form", ["folder", "mono16", "png"])
@pytest.mark.parametrize("bits", [10, 12, 14, 16])
def test_the_range_is_found_over_the_recording(tmp_path: Path, form: str, bits: int) -> None:
    if form != "folder":
        pytest.importorskip("rosbags")
    content = content_of(bits)
    recording = opened(content, tmp_path, form)
    sets = frame_sets(list(EventStream(recording)))
    for camera in (0, 1):
        expected = content.images[camera][3] >> (bits - 8)
        np.testing.assert_array_equal(sets[3].images[camera].grey(), expected)
    report = summarise(recording)
    said = [note for note in report.notes if f"are read as {bits} bits" in note]
    assert len(said) == (2 if bits < 16 else 0)


def test_a_flag_decides(tmp_path: Path) -> None:
    content = content_of(12)
    recording = opened(content, tmp_path, "folder", image_bits=16)
    (first, *_) = frame_sets(list(EventStream(recording)))
    np.testing.assert_array_equal(first.images[0].grey(), content.images[0][0] >> 8)
    assert recording.notes == ()
    with pytest.raises(FlagError, match="--image_bits=7: wants 8 to 16"):
        open_recording(tmp_path / "room", SourceOptions(reading=ReadingOptions(image_bits=7)))


@pytest.mark.parametrize(("bits", "read"), [(8, 1), (12, 5)])
def test_only_images_of_16_bits_are_searched(bits: int, read: int) -> None:
    kind = np.uint8 if bits == 8 else np.uint16
    images = iter([raw_image(np.full((2, 3), 200 << (bits - 8), kind)) for _ in range(5)])
    assert camera_bits(images) == bits
    assert len(list(images)) == 5 - read


def test_damaged_images_outside_the_chosen_time_do_not_matter(tmp_path: Path) -> None:
    content = content_of(12)
    folder = write_folder(content, tmp_path / "room")
    (folder / f"mav0/cam0/data/{content.stamps_ns[0][0]}.png").write_bytes(b"no image")
    stream = EventStream(open_recording(folder), StreamOptions(start_s=0.1))
    sets = frame_sets(list(stream))
    np.testing.assert_array_equal(sets[0].images[0].grey(), content.images[0][2] >> 4)
