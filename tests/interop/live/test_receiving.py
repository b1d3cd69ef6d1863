"""Images put together to sets, what is left out, and the samples of two IMU topics."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplab_py.errors import MapError
from maplab_py.interop.live.messages import image_data, imu_values
from maplab_py.interop.live.receiving import Inbox, Message, SetMatcher, TopicCounts
from maplab_py.interop.recordings.bag_files import message_types
from maplab_py.interop.recordings.paired_imu import PairedImu
from maplab_py.sensors import Camera, Distortion, Projection
from tests.interop.live.support import imu_message

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
    assert inbox.waiting_sets == 10


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
    paired = PairedImu()
    joined = paired.add(1, 0, (0.0, 0.0, 0.0, 9.0, 9.0, 9.0))
    joined += paired.add(0, 5, (9.0, 9.0, 9.0, 1.0, 2.0, 3.0))
    assert joined == []  # the accelerometer has not got so far
    joined = paired.add(1, 10, (1.0, 2.0, 4.0, 9.0, 9.0, 9.0))
    assert joined == [(5, (0.5, 1.0, 2.0, 1.0, 2.0, 3.0))]


@given(st.binary(max_size=290), st.booleans())
def test_damaged_messages_are_errors_of_the_map(data: bytes, is_ros_2: bool) -> None:
    store = message_types(is_ros_2=is_ros_2)
    for kind in ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"):
        with pytest.raises(MapError, match=r"^m: "):
            image_data(data, kind, CAMERA, "m", store, is_ros_2=is_ros_2).check()
    with pytest.raises(MapError, match="damaged"):
        imu_values(data, is_ros_2=is_ros_2)


def test_a_message_that_claims_a_huge_array_is_refused() -> None:
    head = b"\x00\x01\x00\x00" + struct.pack("<iII", 0, 0, 1) + b"\0" * 4
    head += struct.pack("<III", 6, 8, 6) + b"mono8\0" + b"\0\0" + struct.pack("<II", 8, 2**32 - 1)
    store = message_types(is_ros_2=True)
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
