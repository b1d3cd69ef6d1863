"""What a live recording yields and leaves out; sets of images, and samples of two IMU topics."""

import struct
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplab_py.errors import MapError, UserError
from maplab_py.interop.live import receiving
from maplab_py.interop.live.connection import open_transport
from maplab_py.interop.live.options import LiveOptions, NetworkOptions
from maplab_py.interop.live.receiving import Inbox, Message, SetMatcher, TopicCounts
from maplab_py.interop.live.source import image_data, imu_values
from maplab_py.interop.live.transport import Topic
from maplab_py.interop.recordings import bag_files, paired_imu
from maplab_py.interop.recordings.options import SourceOptions, StreamOptions
from maplab_py.interop.recordings.protocol import CameraImage, FrameSet, ImuBatch, RecordedSensors
from maplab_py.interop.recordings.stream import EventStream
from maplab_py.sensors import Camera, Distortion, Projection
from tests.interop.live.support import (
    IMU,
    TOPICS,
    FakeTransport,
    gravity,
    imu_message,
    live,
    messages_of,
    small_device,
    small_master,
)
from tests.interop.recordings.written import make_content
from tests.support.waiting import wait_until

CAMERA = Camera(
    id="",
    projection=Projection.PINHOLE,
    distortion=Distortion.NONE,
    intrinsics=np.array([50.0, 50.0, 4.0, 3.0]),
    distortion_parameters=np.zeros(0),
    width_px=8,
    height_px=6,
)


def image(camera: int, time_ns: int, arrival_s: float = 0.0) -> Message:
    return Message(camera, time_ns, b"", arrival_s)


@given(st.permutations([0, 0, 0, 1, 1, 1]))
def test_sets_are_complete_however_two_cameras_alternate(cameras: list[int]) -> None:
    matcher, rows, sets = SetMatcher(2, tolerance_ns=10), [0, 0], []
    for camera in cameras:
        complete = matcher.add(image(camera, 100 * rows[camera] + camera))
        rows[camera] += 1
        sets += [complete] if complete else []
    assert [[m.time_ns for m in s] for s in sets] == [[0, 1], [100, 101], [200, 201]]
    assert matcher.unmatched == [0, 0]


def test_an_image_without_partner_is_counted() -> None:
    matcher = SetMatcher(2, tolerance_ns=10)
    for message in (image(0, 0), image(0, 100), image(1, 101)):
        complete = matcher.add(message)
    assert [m.time_ns for m in complete] == [100, 101]
    assert matcher.unmatched == [1, 0]


def test_images_of_a_camera_alone_do_not_fill_the_memory() -> None:
    matcher = SetMatcher(2, tolerance_ns=10)
    for row in range(1000):
        assert matcher.add(image(0, 100 * row)) == ()
    assert matcher.unmatched == [980, 0]


def test_sets_that_wait_too_long_are_left_out_and_samples_are_not() -> None:
    inbox = Inbox(1, tolerance_ns=0, max_delay_s=1.0)
    inbox._began_s = -1000.0  # the beginning, with its longer limit, is over
    for row in range(100):
        inbox.put_imu(image(0, row))
        inbox.put_image(image(0, row, arrival_s=0.1 * row))
    arrivals = inbox.take(0.0)
    assert arrivals is not None
    assert len(arrivals.imu) == 100
    assert inbox.dropped_sets == 89
    assert arrivals.images[0].time_ns == 89


def test_nothing_is_taken_where_nothing_has_arrived() -> None:
    assert Inbox(1, 0, 1.0).take(0.01) is None


def test_stamps_that_do_not_increase_are_counted_and_left_out() -> None:
    counts = TopicCounts()
    stamps = [
        counts.stamp_of(imu_message(t, is_ros_2=True), is_ros_2=True) for t in (5, 5, 4, 6, 2)
    ]
    assert stamps == [5, None, None, 6, None]
    assert counts.not_later == 3
    assert counts.stamp_of(b"\x00\x01", is_ros_2=True) is None
    assert counts.damaged == 1


def test_the_accelerometer_is_interpolated_at_the_times_of_the_gyroscope() -> None:
    paired = paired_imu.PairedImu()
    joined = paired.add(1, 0, (0.0, 0.0, 0.0, 9.0, 9.0, 9.0))
    joined += paired.add(0, 5, (9.0, 9.0, 9.0, 1.0, 2.0, 3.0))
    assert joined == []  # the accelerometer has not got so far
    joined = paired.add(1, 10, (1.0, 2.0, 4.0, 9.0, 9.0, 9.0))
    assert joined == [(5, (0.5, 1.0, 2.0, 1.0, 2.0, 3.0))]


@given(st.binary(max_size=290), st.booleans())
def test_damaged_messages_are_errors_of_the_map(data: bytes, is_ros_2: bool) -> None:
    store = bag_files.message_types(is_ros_2=is_ros_2)
    for kind in ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"):
        with pytest.raises(MapError, match=r"^m: "):
            image_data(data, kind, CAMERA, "m", store, is_ros_2=is_ros_2).check()
    with pytest.raises(MapError, match="damaged"):
        imu_values(data, is_ros_2=is_ros_2)


def test_a_message_that_claims_a_huge_array_is_refused() -> None:
    head = b"\x00\x01\x00\x00" + struct.pack("<iII", 0, 0, 1) + b"\0" * 4
    head += struct.pack("<III", 6, 8, 6) + b"mono8\0" + b"\0\0" + struct.pack("<II", 8, 2**32 - 1)
    store = bag_files.message_types(is_ros_2=True)
    with pytest.raises(MapError, match=r"damaged|truncated"):
        image_data(head, "sensor_msgs/msg/Image", CAMERA, "m", store, is_ros_2=True).check()


def test_samples_that_are_no_numbers_are_refused() -> None:
    with pytest.raises(MapError, match="not a number"):
        imu_values(imu_message(1, is_ros_2=True, accel=float("nan")), is_ros_2=True)


def test_missing_messages_are_counted_by_the_holes_between_the_stamps() -> None:
    counts = TopicCounts()
    rng = np.random.default_rng(3)
    lost = set((30 + np.flatnonzero(rng.random(400) < 0.1)).tolist())
    for row in range(430):
        pause_ns = 5 * 10**9 if row >= 250 else 0  # the publisher was started again
        stamp_ns = 10**9 + 50_000_000 * row + int(rng.integers(-4_000_000, 4_000_000)) + pause_ns
        if row not in lost:
            counts.stamp_of(imu_message(stamp_ns, is_ros_2=True), is_ros_2=True)
    assert counts.received == 430 - len(lost)
    assert abs(counts.missing - len(lost)) <= 2
    assert counts.not_later == 0


@pytest.fixture(scope="module")
def device(tmp_path_factory: pytest.TempPathFactory) -> RecordedSensors:
    return small_device(tmp_path_factory.mktemp("device"))


@pytest.mark.parametrize("is_ros_2", [True, False])
def test_all_that_arrives_is_yielded(device: RecordedSensors, is_ros_2: bool) -> None:
    content, transport = gravity(make_content()), FakeTransport(is_ros_2=is_ros_2)
    recording = live(transport, device)
    for _, topic, data in messages_of(content, is_ros_2=is_ros_2):
        transport.send(topic, data)
    items = list(recording.items())
    samples = [item for item in items if isinstance(item, ImuBatch)]
    assert np.array_equal(np.concatenate([s.times_ns for s in samples]), content.imu_ns)
    assert np.array_equal(np.concatenate([s.accel_gyro for s in samples]), content.accel_gyro)
    images = [item for item in items if isinstance(item, CameraImage)]
    assert [image.camera for image in images] == [0, 1] * 8
    for image in images:
        row = int(np.flatnonzero(content.stamps_ns[image.camera] == image.stamp_ns)[0])
        assert np.array_equal(image.decode(), content.images[image.camera][row])
    assert recording.notes == ()


def test_the_stream_of_events_takes_it_as_a_recording(device: RecordedSensors) -> None:
    content, transport = gravity(make_content()), FakeTransport()
    recording = live(transport, device)
    for _, topic, data in messages_of(content):
        transport.send(topic, data)
    stream = EventStream(recording, StreamOptions())
    sets = [event for event in stream if isinstance(event, FrameSet)]
    assert [s.time_ns for s in sets] == content.stamps_ns[0].tolist()
    assert stream.statistics.unmatched_images == [0, 0]


def test_a_part_of_a_live_recording_is_refused(device: RecordedSensors) -> None:
    recording = live(FakeTransport(), device)
    with pytest.raises(UserError, match="is live: leave out --vio_rosbag_start_s"):
        list(EventStream(recording, StreamOptions(start_s=1.0)))


def test_damaged_and_late_messages_are_left_out_and_told(device: RecordedSensors) -> None:
    content, transport = gravity(make_content()), FakeTransport()
    recording = live(transport, device)
    messages = messages_of(content)
    for _, topic, data in messages:
        transport.send(topic, data)
    transport.problems += ["the cable was out"] * 2
    transport.send("/imu0", messages[0][2])
    transport.send("/imu0", b"\x00\x01\x00\x00")
    stamp_ns = int(content.imu_ns[-1]) + 1_000_000
    transport.send("/imu0", imu_message(stamp_ns, is_ros_2=True, accel=float("inf")))
    broken = FakeImage(messages, stamp_ns)
    transport.send("/cam0/image_raw", broken.damaged)
    transport.send("/cam1/image_raw", broken.whole)
    assert sum(isinstance(item, CameraImage) for item in recording.items()) == 16
    notes = " | ".join(recording.notes)
    assert "/imu0: 2 damaged messages left out" in notes
    assert "/imu0: 1 message left out whose stamps do not come after" in notes
    assert "/cam0/image_raw: 1 damaged message left out" in notes
    assert notes.count("the cable was out") == 1


class FakeImage:
    """The last images with a later stamp; that of the first camera is cut."""

    def __init__(self, messages: list[tuple[int, str, bytes]], stamp_ns: int) -> None:
        seconds, rest = divmod(stamp_ns, 10**9)
        stamp = seconds.to_bytes(4, "little") + rest.to_bytes(4, "little")
        image = next(data for _, topic, data in messages if topic == "/cam1/image_raw")
        self.whole = image[:4] + stamp + image[12:]
        self.damaged = self.whole[:200]


def test_images_of_another_size_end_the_run_with_the_remedy(device: RecordedSensors) -> None:
    transport = FakeTransport()
    recording = live(transport, device)
    content = gravity(make_content())
    for images in content.images:
        images[:] = [image[:20] for image in images]
    for _, topic, data in messages_of(content):
        transport.send(topic, data)
    with pytest.raises(MapError, match="64 x 20, the calibration is of 64 x 48: calibrate"):
        list(recording.items())


def test_a_topic_that_nobody_publishes_is_answered_with_those_there_are(
    device: RecordedSensors,
) -> None:
    source = SourceOptions(camera_topics="/cam0/image_raw,/cam9/image_raw")
    with pytest.raises(UserError) as problem:
        live(FakeTransport(), device, source)
    text = str(problem.value)
    assert text.startswith("fake robot: nobody publishes /cam9/image_raw (0.2 s waited)")
    assert "seen: /cam0/image_raw (sensor_msgs/msg/Image), /cam1/image_raw" in text


def test_a_topic_of_another_type_is_refused(device: RecordedSensors) -> None:
    topics = (Topic("/imu0", "sensor_msgs/msg/MagneticField"), *TOPICS[1:])
    with pytest.raises(
        UserError, match="type sensor_msgs/msg/MagneticField, needed is sensor_msgs"
    ):
        live(FakeTransport(topics), device)


def test_topics_that_nothing_names_are_asked_for(device: RecordedSensors) -> None:
    with pytest.raises(UserError, match="topics for 1 of 2 cameras: give --camera_topics"):
        live(FakeTransport(), device, SourceOptions(camera_topics="/cam0/image_raw"))
    with pytest.raises(UserError, match="two cameras have the same topic"):
        live(FakeTransport(), device, SourceOptions(camera_topics="/a,/a"))
    with pytest.raises(UserError, match="names no topic of the IMU"):
        live(FakeTransport(), device, SourceOptions(imu_topic="/a,/b,/c"))


def test_silence_from_the_beginning_is_an_error(device: RecordedSensors) -> None:
    transport, told = FakeTransport(), []
    transport.problems.append("the cable is out")
    recording = live(transport, device, tell=told.append)
    with pytest.raises(UserError, match=r"was silent for 0.3 s: check its publisher"):
        list(recording.items())
    assert told == ["the cable is out"]


@pytest.mark.parametrize(
    ("accel", "message"), [(1.0, "publish m/s\\^2 \\(not g\\)"), (9.81, "rad/s \\(not deg/s\\)")]
)
def test_wrong_units_are_recognised(device: RecordedSensors, accel: float, message: str) -> None:
    transport = FakeTransport()
    recording = live(transport, device)
    recording.started_s = time.monotonic() - 10.0
    for row in range(10):
        data = bytearray(imu_message(10**9 + row, is_ros_2=True, accel=accel))
        if accel > 2.0:  # degrees
            at = data.index(np.float64(accel).tobytes()) - 8 * 14
            data[at : at + 8] = np.float64(100.0).tobytes()
        transport.send("/imu0", bytes(data))
    with pytest.raises(UserError, match=message):
        list(recording.items())


def test_two_topics_of_an_imu_are_joined(device: RecordedSensors) -> None:
    transport = FakeTransport((Topic("/gyro", IMU), Topic("/accel", IMU), *TOPICS[1:]))
    recording = live(transport, device, SourceOptions(imu_topic="/gyro,/accel"))
    for row in range(20):
        transport.send("/accel", imu_message(10**9 + 10 * row, is_ros_2=True))
        transport.send("/gyro", imu_message(10**9 + 10 * row + 5, is_ros_2=True, accel=0.0))
    for topic in ("/cam0/image_raw", "/cam1/image_raw"):
        recording.counts[topic].received = 1  # they are not silent
    batches = [item for item in recording.items() if isinstance(item, ImuBatch)]
    samples = np.concatenate([batch.accel_gyro for batch in batches])
    assert len(samples) == 19
    assert np.allclose(samples[:, 2], 9.81)


def test_options_out_of_their_range_are_refused(device: RecordedSensors) -> None:
    with pytest.raises(UserError, match="--live_max_delay_s=0"):
        live(FakeTransport(), device, options=LiveOptions(max_delay_s=0.0))
    with pytest.raises(UserError, match="--ros_domain_id=300: a domain is a number from 0 to 232"):
        _ = NetworkOptions(ros_domain_id=300).domain
    with pytest.raises(UserError, match="--live_wait_s=0"):
        NetworkOptions(live_wait_s=0.0)


def test_the_domain_is_that_of_the_environment(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "12")
    assert NetworkOptions().domain == 12
    assert NetworkOptions(ros_domain_id=3).domain == 3
    monkeypatch.setenv("ROS_DOMAIN_ID", "home")
    with pytest.raises(UserError, match="ROS_DOMAIN_ID=home"):
        _ = NetworkOptions().domain


def test_a_consumer_that_is_too_slow_gets_all_samples_and_new_images(
    device: RecordedSensors, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Through real sockets: 40 sets at 20 Hz to a consumer that takes 120 ms for each."""
    monkeypatch.setattr(receiving, "_START_DELAY_S", 0.0)
    content = gravity(make_content(frames=40))
    messages = messages_of(content, is_ros_2=False)
    options = LiveOptions(silence_s=1.0, max_delay_s=0.3)
    with small_master() as master:
        network = NetworkOptions(ros_master_uri=master.uri)
        with open_transport("ros1", network) as robot, open_transport("ros1", network) as listener:
            publishers = {topic.name: robot.advertise(topic.name, topic.type) for topic in TOPICS}
            recording = live(listener, device, options=options, wait_s=5.0)
            assert wait_until(lambda: all(robot.subscribers(topic.name) for topic in TOPICS))
            sent_s: dict[int, float] = {}

            def send() -> None:
                begin_s = time.monotonic()
                for stamp_ns, topic, data in messages:
                    due_s = begin_s + (stamp_ns - messages[0][0]) * 1e-9
                    time.sleep(max(0.0, due_s - time.monotonic()))
                    sent_s[stamp_ns] = time.monotonic()
                    publishers[topic](data)

            thread = threading.Thread(target=send)
            thread.start()
            samples, delays_s = [], []
            for item in recording.items():
                if isinstance(item, ImuBatch):
                    samples.append(item.times_ns)
                elif item.camera == 0:
                    delays_s.append(time.monotonic() - sent_s[item.stamp_ns])
                    time.sleep(0.12)
            thread.join()
    assert np.array_equal(np.concatenate(samples), content.imu_ns)
    assert 10 <= len(delays_s) < 30
    assert recording.inbox.dropped_sets == 40 - len(delays_s)
    assert np.median(delays_s) < 1.0
    (note,) = [note for note in recording.notes if "left out because they had waited" in note]
    assert note.startswith(f"{recording.inbox.dropped_sets} sets of images")
