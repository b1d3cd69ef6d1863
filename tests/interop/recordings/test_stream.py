"""Cameras synchronised, missions of maps replayed, values of 10 to 14 bits."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplab_py.array_types import I64
from maplab_py.errors import FlagError, MapError
from maplab_py.interop.recordings.images import RawImage, camera_bits
from maplab_py.interop.recordings.map_replay import MapRecording
from maplab_py.interop.recordings.options import ReadingOptions, SourceOptions, StreamOptions
from maplab_py.interop.recordings.protocol import (
    CameraImage,
    Event,
    FrameSet,
    ImuBatch,
    TrackedFrameSet,
)
from maplab_py.interop.recordings.reader_choice import open_recording
from maplab_py.interop.recordings.stream import EventStream, Synchroniser
from maplab_py.interop.recordings.summary import summarise
from maplab_py.sensors import Camera, Distortion, Projection
from maplab_py.storage.native import load_map
from tests.interop.recordings.written import (
    Content,
    assert_in_order,
    frame_sets,
    make_content,
    samples,
    write_bag,
    write_calibration,
    write_folder,
)
from tests.interop.small_map import START_NS, VERTICES, make_map
from tests.support.data import shared_data

NO_DATA: Any = None


def _images(*stamps_of_cameras: list[int]) -> list[CameraImage]:
    images = [
        CameraImage(camera, stamp, stamp, NO_DATA)
        for camera, stamps in enumerate(stamps_of_cameras)
        for stamp in stamps
    ]
    return sorted(images, key=lambda image: (image.time_ns, image.camera))


def _batch(times_ns: I64) -> ImuBatch:
    count = len(times_ns)
    return ImuBatch(times_ns, np.zeros((count, 6)), np.zeros(count, dtype=np.bool_))


def _run(synchroniser: Synchroniser, items: list[Any]) -> list[Event]:
    events = [event for item in items for event in synchroniser.push(item)]
    return events + list(synchroniser.finish())


def test_images_within_the_tolerance_are_put_together() -> None:
    synchroniser = Synchroniser(2, 3)
    sets = _run(synchroniser, _images([0, 100, 200, 300], [2, 104, 197, 400]))
    pairs = [[image.time_ns for image in s.images] for s in sets if isinstance(s, FrameSet)]
    assert pairs == [[0, 2], [200, 197]]
    assert synchroniser.unmatched == [2, 2]
    assert [s.time_ns for s in sets if isinstance(s, FrameSet)] == [0, 200]


def test_a_camera_that_stops_does_not_hold_the_imu_back() -> None:
    synchroniser = Synchroniser(2, 3)
    (image,) = _images([50], [])
    events = _run(synchroniser, [image, _batch(np.array([51, 52])), _batch(np.array([60, 70]))])
    assert [event.time_ns for event in events] == [51, 60]
    assert synchroniser.unmatched == [1, 0]


@given(
    first=st.lists(st.integers(1, 40), min_size=1, max_size=12),
    jitter=st.lists(st.integers(-6, 6), min_size=12, max_size=12),
    missing=st.sets(st.integers(0, 11)),
)
def test_every_image_is_in_a_set_or_counted(
    first: list[int], jitter: list[int], missing: set[int]
) -> None:
    tolerance = 4
    stamps = (np.cumsum(np.array(first) + 20)).tolist()  # further apart than twice the tolerance
    other = [
        s + j for row, (s, j) in enumerate(zip(stamps, jitter, strict=False)) if row not in missing
    ]
    other = sorted(set(other))
    images = _images(stamps, other)
    end = max(stamps + other) + 10
    items: list[Any] = []
    last = 0
    for image in images:  # samples at every time, those up to an image before it
        if image.time_ns > last:
            items.append(_batch(np.arange(last + 1, image.time_ns + 1)))
            last = image.time_ns
        items.append(image)
    items.append(_batch(np.arange(last + 1, end + 1)))
    synchroniser = Synchroniser(2, tolerance)
    events = _run(synchroniser, items)
    sets = [event for event in events if isinstance(event, FrameSet)]
    expected = [(s, o) for s in stamps for o in other if abs(s - o) <= tolerance]
    assert [(s.images[0].time_ns, s.images[1].time_ns) for s in sets] == expected
    assert synchroniser.unmatched == [len(stamps) - len(sets), len(other) - len(sets)]
    samples = [event.times_ns for event in events if isinstance(event, ImuBatch)]
    np.testing.assert_array_equal(np.concatenate(samples), np.arange(1, end + 1))
    assert_in_order(events)


@pytest.mark.parametrize("cameras", [1, 3])
def test_other_numbers_of_cameras(cameras: int) -> None:
    stamps = [list(range(0, 1000, 100))] * cameras
    sets = _run(Synchroniser(cameras, 0), _images(*stamps))
    assert [s.time_ns for s in sets] == stamps[0]


@pytest.mark.parametrize("mission", [0, 1])
def test_a_mission_reads_back(mission: int) -> None:
    vi_map = make_map()
    recording = MapRecording(vi_map, mission)
    events = list(EventStream(recording))
    assert_in_order(events)
    sets = [event for event in events if isinstance(event, TrackedFrameSet)]
    rows = slice(mission * VERTICES, (mission + 1) * VERTICES)
    assert [s.time_ns for s in sets] == vi_map.vertices.timestamp_ns[rows].tolist()
    frames = [s.frames[0] for s in sets]
    keypoints = slice(mission * 24, (mission + 1) * 24)
    for name in ("uv_px", "sigma_px", "track_id", "scale", "descriptor"):
        read = np.concatenate([getattr(frame, name) for frame in frames])
        np.testing.assert_array_equal(read, getattr(vi_map.keypoints, name)[keypoints])
    assert {int(size) for frame in frames for size in frame.descriptor_size} == {(48, 3)[mission]}
    times_ns, accel_gyro = samples(events)
    first = START_NS + mission * 10**11
    assert times_ns.tolist() == list(range(first, first + (VERTICES - 1) * 500_000_000 + 1, 10**7))
    edges = slice(mission * (VERTICES - 1) * 51, mission * (VERTICES - 1) * 51 + 51)
    np.testing.assert_array_equal(accel_gyro[:51], vi_map.imu_samples.accel_gyro[edges])


def test_part_of_a_mission() -> None:
    recording = MapRecording(make_map(), 0)
    events = list(EventStream(recording, StreamOptions(start_s=0.5, end_s=1.5)))
    times_ns, _ = samples(events)
    assert (times_ns[0] - START_NS, times_ns[-1] - START_NS) == (500_000_000, 1_490_000_000)
    sets = [event for event in events if isinstance(event, TrackedFrameSet)]
    assert [s.time_ns - START_NS for s in sets] == [500_000_000, 1_000_000_000]


def test_missing_and_invalid_frames_are_none() -> None:
    vi_map = make_map()
    is_valid = np.ones(len(vi_map.frames), dtype=np.bool_)
    is_valid[1] = False
    vi_map = vi_map.replace(frames=vi_map.frames.replace(is_valid=is_valid))
    sets = [e for e in EventStream(MapRecording(vi_map, 0)) if isinstance(e, TrackedFrameSet)]
    assert [s.frames[0] is None for s in sets] == [False, True, False, False, False, False]


def test_what_cannot_be_replayed() -> None:
    vi_map = make_map()
    missions = vi_map.missions.replace(sensor_id=np.zeros_like(vi_map.missions.sensor_id))
    with pytest.raises(MapError, match="has no camera rig: choose another mission"):
        MapRecording(vi_map.replace(missions=missions), 0)
    times_ns = vi_map.imu_samples.timestamp_ns.copy()
    times_ns[60] -= 10**9
    table = dataclasses.replace(vi_map.imu_samples, timestamp_ns=times_ns)
    with pytest.raises(MapError, match=r"samples of IMU edge [0-9a-f]{32} run backwards"):
        MapRecording(vi_map.replace(imu_samples=table), 0)


def test_real_walk() -> None:
    vi_map, _ = load_map(shared_data("maplab_maps/tango_handheld"))
    assert len(vi_map.imu_samples) == 25_675
    recording = MapRecording(vi_map, 0)
    events = list(EventStream(recording))
    assert_in_order(events)
    sets = [event for event in events if isinstance(event, TrackedFrameSet)]
    assert len(sets) == 969
    times_ns, accel_gyro = samples(events)
    assert len(times_ns) == 25_675 - 967  # each of the 968 edges but the first repeats a sample
    kept = np.unique(vi_map.imu_samples.timestamp_ns, return_index=True)[1]
    np.testing.assert_array_equal(accel_gyro, vi_map.imu_samples.accel_gyro[kept])
    frames = [frame for s in sets for frame in s.frames if frame is not None]
    assert sum(len(frame.uv_px) for frame in frames) == 254_757
    assert all(np.all(frame.descriptor_size == 48) for frame in frames)
    report = summarise(recording)
    assert report.frame_sets == 969
    assert report.duration_s == pytest.approx(118.0, abs=1.0)
    assert report.frame_set_rate_hz == pytest.approx(8.2, abs=0.1)


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
