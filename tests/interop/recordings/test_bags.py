"""ROS 1 and ROS 2 bags: written and read again, equal to folders, and damaged ones."""

import dataclasses
import sys
import tracemalloc
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from maplab_py.errors import MapError, MaplabError, UserError
from maplab_py.interop.calibration_import import import_calibration
from maplab_py.interop.recordings.options import SourceOptions, StreamOptions
from maplab_py.interop.recordings.protocol import FrameSet, RecordedSensors
from maplab_py.interop.recordings.reader_choice import open_recording
from maplab_py.interop.recordings.stream import EventStream
from maplab_py.interop.recordings.summary import summarise
from tests.interop.recordings.written import (
    HEIGHT,
    START_NS,
    WIDTH,
    Content,
    assert_content,
    frame_sets,
    image_message,
    imu_message,
    make_content,
    samples,
    write_bag,
    write_calibration,
    write_folder,
    write_messages,
)
from tests.support.own_process import in_own_process

pytest.importorskip("rosbags")

from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS1_NOETIC)


@pytest.fixture(scope="module")
def device(tmp_path_factory: pytest.TempPathFactory) -> RecordedSensors:
    folder = write_folder(make_content(frames=1), tmp_path_factory.mktemp("device") / "room")
    return import_calibration(folder / "mav0")


@pytest.fixture
def calibrated(tmp_path: Path, device: RecordedSensors) -> SourceOptions:
    return SourceOptions(
        sensor_calibration_file=write_calibration(device, tmp_path / "sensors.yaml")
    )


@pytest.mark.parametrize(
    ("version", "storage", "name"),
    [(1, "", "room.bag"), (2, "sqlite3", "room"), (2, "mcap", "mcap_room")],
)
@pytest.mark.parametrize(
    ("encoding", "dtype", "channels"),
    [
        ("mono8", np.uint8, 1),
        ("mono16", np.uint16, 1),
        ("rgb8", np.uint8, 3),
        ("bgr8", np.uint8, 3),
        ("png", np.uint16, 1),
    ],
)
def test_a_bag_reads_back(
    tmp_path: Path,
    calibrated: SourceOptions,
    version: int,
    storage: str,
    name: str,
    encoding: str,
    dtype: type,
    channels: int,
) -> None:
    content = make_content(dtype=dtype, channels=channels)
    path = write_bag(content, tmp_path / name, version=version, storage=storage, encoding=encoding)
    recording = open_recording(path, calibrated)
    assert recording.kind == f"ROS {version} bag"
    assert_content(list(EventStream(recording)), content)
    assert summarise(recording, check_images=True).checked_images == 16


def test_a_single_file_of_a_ros_2_bag(tmp_path: Path, calibrated: SourceOptions) -> None:
    content = make_content()
    for storage, suffix in (("sqlite3", "db3"), ("mcap", "mcap")):
        folder = write_bag(content, tmp_path / storage, version=2, storage=storage)
        (file,) = folder.glob(f"*.{suffix}")
        assert_content(list(EventStream(open_recording(file, calibrated))), content)


def test_compressed_jpeg(tmp_path: Path, calibrated: SourceOptions) -> None:
    content = make_content(frames=1)
    recording = open_recording(
        write_bag(content, tmp_path / "room.bag", encoding="jpeg"), calibrated
    )
    (frame_set,) = frame_sets(list(EventStream(recording)))
    data = cv2.imencode(".jpg", content.images[1][0])[1]
    expected = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(frame_set.images[1].decode(), expected)


def test_topics_of_flags_and_the_time_offset(tmp_path: Path, device: RecordedSensors) -> None:
    content = make_content(cameras=1)
    path = write_bag(content, tmp_path / "room.bag")
    late = dataclasses.replace(device.cameras[0], time_offset_ns=7_000_000)
    rig = dataclasses.replace(device.rig, cameras=(late, device.cameras[1]))
    sensors = {device.imu_id: device.sensors.sensors[device.imu_id], rig.id: rig}
    shifted = dataclasses.replace(
        device, sensors=dataclasses.replace(device.sensors, sensors=sensors)
    )
    file = write_calibration(shifted, tmp_path / "sensors.yaml")
    file.write_text(file.read_text().replace("/imu0", "/other").replace("/cam0", "/left"))
    options = SourceOptions(
        sensor_calibration_file=file,
        rovio_active_camera_indices="0",
        imu_topic="imu0",
        camera_topics="/cam0/image_raw",
    )
    events = list(EventStream(open_recording(path, options)))
    assert [s.time_ns for s in frame_sets(events)] == (content.stamps_ns[0] + 7_000_000).tolist()
    stamps_ns = [s.images[0].stamp_ns for s in frame_sets(events)]
    assert stamps_ns == content.stamps_ns[0].tolist()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"imu_topic": "/imu"},
            r"no topic /imu of IMU: give --imu_topic; the bag has /imu0 \(sensor_msgs/msg/Imu\)",
        ),
        (
            {"camera_topics": "/cam0/image_raw,/left"},
            "no topic /left of camera 1: give --camera_topics",
        ),
        (
            {"imu_topic": "/cam0/image_raw"},
            "has messages of type sensor_msgs/msg/Image, wanted is sensor_msgs/msg/Imu",
        ),
        ({"camera_topics": "/cam0/image_raw"}, "names 1 topics, 2 cameras are read"),
        ({"camera_topics": "/cam0/image_raw,/cam0/image_raw"}, "two sensors have the same topic"),
        (
            {"sensor_calibration_file": None},
            "a bag has no calibration: give --sensor_calibration_file",
        ),
        ({"imu_calibration_file": Path("imu.yaml")}, "belongs to a camera chain of kalibr"),
    ],
)
def test_wrong_requests(
    tmp_path: Path, calibrated: SourceOptions, changes: dict[str, Any], message: str
) -> None:
    path = write_bag(make_content(), tmp_path / "room.bag")
    with pytest.raises(UserError, match=message):
        open_recording(path, dataclasses.replace(calibrated, **changes))


def test_calibration_without_topics(tmp_path: Path, calibrated: SourceOptions) -> None:
    file = calibrated.sensor_calibration_file
    assert file is not None
    file.write_text(file.read_text().replace("/imu0", "''"))
    path = write_bag(make_content(), tmp_path / "room.bag")
    with pytest.raises(
        UserError, match="no topic of IMU is given: give --imu_topic; the bag has /imu0"
    ):
        open_recording(path, calibrated)


def _without(content: Content, samples_too: bool) -> Content:
    return dataclasses.replace(
        content,
        stamps_ns=tuple(stamps[:0] for stamps in content.stamps_ns),
        images=tuple([] for _ in content.images),
        imu_ns=content.imu_ns[:0] if samples_too else content.imu_ns,
        accel_gyro=content.accel_gyro[:0] if samples_too else content.accel_gyro,
    )


def test_empty_bags(tmp_path: Path, calibrated: SourceOptions) -> None:
    bare = write_bag(_without(make_content(), True), tmp_path / "bare.bag")
    with pytest.raises(MaplabError, match=r"bare\.bag"):
        open_recording(bare, calibrated)
    blind = write_bag(_without(make_content(), False), tmp_path / "blind.bag")
    with pytest.raises(UserError, match=r"no topic has sensor_msgs/msg/Image .*the bag has /imu0"):
        open_recording(blind, calibrated)


@pytest.mark.parametrize(("version", "name"), [(1, "room.bag"), (2, "room")])
def test_truncated_bags(tmp_path: Path, calibrated: SourceOptions, version: int, name: str) -> None:
    path = write_bag(make_content(), tmp_path / name, version=version)
    file = path if version == 1 else next(path.glob("*.db3"))
    content = file.read_bytes()
    for share in (0.0, 0.01, 0.5, 0.95):
        file.write_bytes(content[: int(share * len(content))])
        with pytest.raises(MapError, match=r"cannot be read.*(copy|recover|reindex)") as caught:
            list(EventStream(open_recording(path, calibrated)))
        assert "\n" not in str(caught.value)
        assert str(path) in str(caught.value)


def _messages(content: Content) -> list[tuple[int, str, Any]]:
    messages = [
        (t, "/imu0", imu_message(STORE, t, v, 1))
        for t, v in zip(content.imu_ns.tolist(), content.accel_gyro, strict=True)
    ]
    for camera in (0, 1):
        for t, image in zip(
            content.stamps_ns[camera].tolist(), content.images[camera], strict=True
        ):
            message = image_message(STORE, t, image, "mono8", 1)
            messages.append((t, f"/cam{camera}/image_raw", message))
    return sorted(messages, key=lambda entry: entry[:2])


def test_part_of_a_bag_whose_clock_is_another(tmp_path: Path, calibrated: SourceOptions) -> None:
    content = make_content(frames=500)  # 25 s, so that the reader can skip messages
    offset_ns = 10**15
    path = write_bag(content, tmp_path / "room", version=2, delay_ns=(offset_ns, offset_ns + 10**9))
    part = StreamOptions(start_s=12.0, end_s=14.0)
    times_ns, accel_gyro = samples(list(EventStream(open_recording(path, calibrated), part)))
    begin = int(content.imu_ns[0]) + 12 * 10**9
    inside = (content.imu_ns >= begin) & (content.imu_ns < begin + 2 * 10**9)
    np.testing.assert_array_equal(times_ns, content.imu_ns[inside])
    np.testing.assert_array_equal(accel_gyro, content.accel_gyro[inside])


def test_messages_that_arrive_much_too_late(tmp_path: Path, calibrated: SourceOptions) -> None:
    messages = _messages(make_content(frames=100))
    late = [
        (arrival + (3 * 10**9 if topic == "/cam1/image_raw" and row > 400 else 0), topic, message)
        for row, (arrival, topic, message) in enumerate(messages)
    ]
    late.sort(key=lambda entry: entry[:2])
    write_messages(tmp_path / "room.bag", STORE, late)
    with pytest.raises(MapError, match=r"/cam1/image_raw: 2 of 100 stamps do not come after"):
        list(EventStream(open_recording(tmp_path / "room.bag", calibrated)))


def test_bad_messages(tmp_path: Path, calibrated: SourceOptions) -> None:
    def first_image(messages: list[tuple[int, str, Any]]) -> Any:
        return next(message for _, topic, message in messages if topic == "/cam0/image_raw")

    def cut(messages: list[tuple[int, str, Any]]) -> None:
        image = first_image(messages)
        image.data = image.data[:-100]

    def depths(messages: list[tuple[int, str, Any]]) -> None:
        first_image(messages).encoding = "32FC1"

    def narrow(messages: list[tuple[int, str, Any]]) -> None:
        first_image(messages).width = 60

    def not_a_number(messages: list[tuple[int, str, Any]]) -> None:
        for _, _, message in messages[:2]:  # one would be left out
            message.linear_acceleration.x = float("nan")

    for harm, message in (
        (cut, "the image is truncated"),
        (depths, "the encoding '32FC1' are depths or measurements: record mono8"),
        (narrow, "the image is 60 x 48, the calibration is of 64 x 48"),
        (not_a_number, "2 of 19 samples are left out, the one at .* is no number"),
    ):
        messages = _messages(make_content(frames=2))
        harm(messages)
        path = tmp_path / f"{harm.__name__}.bag"
        write_messages(path, STORE, messages)
        with pytest.raises(MapError, match=message):
            summarise(open_recording(path, calibrated), check_images=True)


def test_without_the_library_the_error_names_the_extra(
    tmp_path: Path, calibrated: SourceOptions, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_bag(make_content(), tmp_path / "room.bag")
    monkeypatch.setitem(sys.modules, "maplab_py.interop.recordings.bag_reader", None)
    with pytest.raises(UserError, match=r"pip install 'maplab-py\[bags\]'"):
        open_recording(path, calibrated)


def _frames_and_peak(path: Path, options: SourceOptions) -> tuple[int, int]:
    """Read a bag to its end; return the number of frame sets and the peak of memory in bytes."""
    recording = open_recording(path, options)
    tracemalloc.start()
    count = sum(isinstance(event, FrameSet) for event in EventStream(recording))
    return count, tracemalloc.get_traced_memory()[1]


def test_a_long_bag_is_not_held_at_once(tmp_path: Path, calibrated: SourceOptions) -> None:
    frames = 3_000
    image = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
    stamps = START_NS + np.arange(frames) * 50_000_000
    content = Content(
        stamps, np.zeros((frames, 6)), (stamps, stamps + 1), ([image] * frames, [image] * frames)
    )
    path = write_bag(content, tmp_path / "long.bag")
    size = path.stat().st_size
    assert size > 18e6
    count, peak = in_own_process(_frames_and_peak, path, calibrated)
    assert count == frames
    assert peak < 0.4 * size, peak  # a chunk, the index, and the messages of a second
