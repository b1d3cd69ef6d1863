"""Bags that are written: messages equal those of rosbags, bags read back to the last bit."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from maplab_py.errors import MapError, UserError
from maplab_py.interop.bags.sensor_messages import IMU, POSE, TRANSFORM, TREE, MessageMaker
from maplab_py.interop.recordings.bag_files import message_types, opened_bag
from maplab_py.interop.recordings.bag_writing import (
    BagFormat,
    BagMessage,
    Channel,
    bag_files,
    format_of_bag,
    format_of_path,
    in_order,
    messages_of_topic,
    write_bag,
)
from maplab_py.output_files import planning

pytest.importorskip("rosbags")

FORMATS = list(BagFormat)


def named(folder: Path, kind: BagFormat) -> Path:
    return folder / ("walk" if kind.is_ros_2 else "walk.bag")


@pytest.mark.parametrize("is_ros_2", [False, True])
def test_fields_are_in_their_places(is_ros_2: bool) -> None:
    maker, store = MessageMaker(is_ros_2=is_ros_2), message_types(is_ros_2=is_ros_2)
    read: Any = store.deserialize_cdr if is_ros_2 else store.deserialize_ros1
    times_ns, values = np.array([7, 3_000_000_001]), np.arange(14.0).reshape(2, 7)
    sample = read(maker.imu(times_ns, values[:, :6], "imü")[1], IMU)
    assert (sample.header.frame_id, sample.header.stamp.sec, sample.header.stamp.nanosec) == (
        "imü",
        3,
        1,
    )
    a, w = sample.linear_acceleration, sample.angular_velocity
    assert [a.x, a.y, a.z, w.x, w.y, w.z] == values[1, :6].tolist()
    assert sample.orientation_covariance.tolist() == [-1.0, *[0.0] * 8]
    stamped = read(maker.poses(times_ns, values, "map")[1], POSE)
    p, q = stamped.pose.position, stamped.pose.orientation
    assert [q.x, q.y, q.z, q.w, p.x, p.y, p.z] == values[1].tolist()
    both = [(values, ("map", "odom")), (values[::-1], ("odom", "imu"))]
    first, second = read(maker.trees(times_ns, both)[1], TREE).transforms
    assert (first.header.frame_id, first.child_frame_id) == ("map", "odom")
    assert (second.header.frame_id, second.child_frame_id) == ("odom", "imu")
    assert (first.transform.rotation.w, second.transform.translation.z) == (
        values[1, 3],
        values[0, 6],
    )
    single = read(maker.transforms(times_ns, values, ("map", "odom"))[1], TRANSFORM)
    assert (single.header, single.child_frame_id) == (first.header, "odom")
    assert single.transform == first.transform


@pytest.mark.parametrize("is_ros_2", [False, True])
def test_odometry_has_the_velocity_of_the_body(is_ros_2: bool) -> None:
    store = message_types(is_ros_2=is_ros_2)
    half = np.sqrt(0.5)
    T_M_I = np.array([[0.0, 0.0, half, half, 1.0, 2.0, 3.0]])  # turned left by 90 degrees
    v_M = np.array([[0.0, 2.0, 0.5]])
    (row,) = MessageMaker(is_ros_2=is_ros_2).odometry(
        np.array([3_000_000_001]), T_M_I, v_M, ("mission", "imu")
    )
    read: Any = store.deserialize_cdr if is_ros_2 else store.deserialize_ros1
    message = read(row, "nav_msgs/msg/Odometry")
    assert (message.header.frame_id, message.child_frame_id) == ("mission", "imu")
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (3, 1)
    assert (message.pose.pose.position.y, message.pose.pose.orientation.w) == (2.0, half)
    v_I = message.twist.twist.linear
    np.testing.assert_allclose([v_I.x, v_I.y, v_I.z], [2.0, 0.0, 0.5], atol=1e-15)


@pytest.mark.parametrize("kind", FORMATS)
def test_20_000_imu_messages_read_back_to_the_last_bit(tmp_path: Path, kind: BagFormat) -> None:
    rng = np.random.default_rng(3)
    times_ns = 1_403_715_273_262_142_976 + np.cumsum(rng.integers(1, 10_000_000, 20_000))
    values = rng.normal(size=(20_000, 6)) * 10.0 ** rng.integers(-300, 300, (20_000, 6))
    rows = MessageMaker(is_ros_2=kind.is_ros_2).imu(times_ns, values, "imu")
    path = named(tmp_path, kind)
    counts = write_bag(path, kind, messages_of_topic(times_ns, "/imu0", IMU, rows))
    assert counts == {"/imu0": 20_000}
    assert format_of_bag(path) is kind
    with opened_bag(path) as reader:
        read = list(reader.messages())
        assert [data for _, _, data in read] == rows
        assert [arrival for _, arrival, _ in read] == times_ns.tolist()
        last = reader.deserialize(read[-1][2], IMU)
    a, w = last.linear_acceleration, last.angular_velocity
    assert [a.x, a.y, a.z, w.x, w.y, w.z] == values[-1].tolist()


def few(kind: BagFormat, topic: str = "/imu0", start: int = 10) -> Iterator[BagMessage]:
    times_ns = np.arange(start, start + 40, 10)
    rows = MessageMaker(is_ros_2=kind.is_ros_2).imu(times_ns, np.ones((4, 6)), "imu")
    return messages_of_topic(times_ns, topic, IMU, rows)


@pytest.mark.parametrize("kind", FORMATS)
def test_streams_are_merged_in_the_order_of_time(tmp_path: Path, kind: BagFormat) -> None:
    path = named(tmp_path, kind)
    assert write_bag(path, kind, in_order(few(kind), few(kind, "/b", 15))) == {"/imu0": 4, "/b": 4}
    with opened_bag(path) as reader:
        assert [time for _, time, _ in reader.messages()] == list(range(10, 50, 5))


@pytest.mark.parametrize("kind", FORMATS)
def test_it_replaces_only_on_request(tmp_path: Path, kind: BagFormat) -> None:
    path = named(tmp_path, kind)
    write_bag(path, kind, few(kind))
    before = [file.read_bytes() for file in bag_files(path, kind)]
    with pytest.raises(UserError, match="exists already: give --overwrite"):
        write_bag(path, kind, few(kind, "/other"))
    assert [file.read_bytes() for file in bag_files(path, kind)] == before
    write_bag(path, kind, few(kind, "/other"), overwrite=True)
    with opened_bag(path) as reader:
        assert {c.topic for c in reader.connections} == {"/other"}


@pytest.mark.parametrize("kind", FORMATS)
def test_a_failure_leaves_nothing(tmp_path: Path, kind: BagFormat) -> None:
    def failing() -> Iterator[BagMessage]:
        yield from few(kind)
        raise MapError("the images are damaged")

    with pytest.raises(MapError, match="the images are damaged"):
        write_bag(named(tmp_path, kind), kind, failing())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", FORMATS)
def test_planning_writes_nothing(tmp_path: Path, kind: BagFormat) -> None:
    path = named(tmp_path, kind)
    with planning() as planned:
        write_bag(path, kind, few(kind))
    assert [file.path for file in planned] == list(bag_files(path, kind))
    assert min(file.size_bytes for file in planned) > 100
    assert list(tmp_path.iterdir()) == []


def test_names_and_formats_fit(tmp_path: Path) -> None:
    assert format_of_path(tmp_path / "walk.bag") is BagFormat.ROS1
    assert format_of_path(tmp_path / "walk") is BagFormat.MCAP
    assert format_of_path(tmp_path / "walk", "sqlite3") is BagFormat.SQLITE3
    for name, kind in (("walk.bag", "mcap"), ("walk", "ros1")):
        with pytest.raises(UserError, match=f"--bag_format={kind} is a "):
            format_of_path(tmp_path / name, kind)
    with pytest.raises(UserError, match=r"leave out \.mcap"):
        format_of_path(tmp_path / "walk.mcap")


def test_foreign_files_are_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "walk").mkdir()
    (tmp_path / "walk" / "notes.txt").write_text("keep")
    with pytest.raises(UserError, match=r"has other files \(notes.txt\)"):
        write_bag(tmp_path / "walk", BagFormat.MCAP, few(BagFormat.MCAP), overwrite=True)
    (tmp_path / "file").write_text("keep")
    with pytest.raises(UserError, match="is a file: name a folder"):
        write_bag(tmp_path / "file", BagFormat.MCAP, few(BagFormat.MCAP), overwrite=True)


def test_what_cannot_be_written_is_refused(tmp_path: Path) -> None:
    unknown = [BagMessage(1, Channel("/odd", "my_msgs/msg/Odd"), b"")]
    with pytest.raises(MapError, match="/odd have the type my_msgs/msg/Odd, which has no definit"):
        write_bag(tmp_path / "walk", BagFormat.SQLITE3, unknown)
    for time_ns in (-1, 2**31 * 1_000_000_000):
        with pytest.raises(UserError, match="cannot be written into a bag"):
            MessageMaker(is_ros_2=True).imu(np.array([time_ns]), np.ones((1, 6)), "imu")
    assert list(tmp_path.iterdir()) == []


def test_the_extra_is_named_where_it_is_missing(tmp_path: Path) -> None:
    program = (
        "import sys; sys.modules['rosbags'] = None; from pathlib import Path\n"
        "from maplab_py.interop.recordings.bag_writing import BagFormat, write_bag\n"
        "write_bag(Path('walk.bag'), BagFormat.ROS1, [])"
    )
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=tmp_path,
        env=os.environ,
        capture_output=True,
        text=True,
        check=False,
    )
    assert "pip install 'maplab-py[bags]'" in done.stderr.splitlines()[-1]
    assert list(tmp_path.iterdir()) == []
