"""Fixes of satellite receivers in bags of ROS 1 and ROS 2, and bags without any."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from maplab_py.errors import MapError, UserError
from maplab_py.interop.bags.sensor_messages import MessageMaker
from maplab_py.interop.gps import NAV_SAT_FIX, read_fixes
from maplab_py.interop.recordings.bag_files import message_types
from maplab_py.interop.recordings.bag_writing import (
    BagFormat,
    BagMessage,
    Channel,
    messages_of_topic,
    write_bag,
)
from tests.interop.bags.small_bags import FORMATS, named

START_NS, COUNT = 1_700_000_000_123_456_789, 6
PLACES = np.array([[47.1, 8.2, 450.0]]) + np.arange(COUNT)[:, None] * [1e-6, 2e-6, 0.5]
TIMES_NS = START_NS + 200_000_000 * np.arange(COUNT)


def fix_messages(kind: BagFormat, status: Any, places: Any, times_ns: Any) -> list[bytes]:
    """Return serialised sensor_msgs/NavSatFix as the library rosbags writes them."""
    store = message_types(is_ros_2=kind.is_ros_2)
    types = store.types
    rows = []
    for t, state, (lat, lon, alt) in zip(times_ns.tolist(), status, places.tolist(), strict=True):
        stamp = types["builtin_interfaces/msg/Time"](t // 10**9, t % 10**9)
        extra = {} if kind.is_ros_2 else {"seq": 0}
        header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="gps_antenna", **extra)
        fix = types[NAV_SAT_FIX](
            header=header,
            status=types["sensor_msgs/msg/NavSatStatus"](status=state, service=1),
            latitude=lat,
            longitude=lon,
            altitude=alt,
            position_covariance=np.zeros(9),
            position_covariance_type=0,
        )
        write = store.serialize_cdr if kind.is_ros_2 else store.serialize_ros1
        rows.append(bytes(write(fix, NAV_SAT_FIX)))
    return rows


def write_fixes(
    folder: Path,
    kind: BagFormat,
    *topics: str,
    status: Any = (0,) * COUNT,
    places: Any = PLACES,
    times_ns: Any = TIMES_NS,
) -> Path:
    path, arrival_ns = named(folder, kind, "drive"), TIMES_NS + 5_000_000
    rows = fix_messages(kind, status, places, times_ns)
    messages = [
        m for topic in topics for m in messages_of_topic(arrival_ns, topic, NAV_SAT_FIX, rows)
    ]
    samples = MessageMaker(is_ros_2=kind.is_ros_2).imu(TIMES_NS, np.zeros((COUNT, 6)), "imu")
    imu = Channel("/imu", "sensor_msgs/msg/Imu")
    messages += [BagMessage(t, imu, m) for t, m in zip(TIMES_NS.tolist(), samples, strict=True)]
    write_bag(path, kind, sorted(messages, key=lambda message: message.time_ns))
    return path


@pytest.mark.parametrize("kind", FORMATS)
def test_fixes_are_read_to_the_last_bit(kind: BagFormat, tmp_path: Path) -> None:
    status, places = [0, 2, -1, 1, 0, 0], PLACES.copy()
    places[4] = np.nan
    path = write_fixes(tmp_path, kind, "/gps/fix", status=status, places=places)
    for topic in ("", "/gps/fix"):
        track = read_fixes(path, topic=topic)
        rows = [0, 1, 3, 5]
        np.testing.assert_array_equal(track.times_ns, TIMES_NS[rows])
        found = np.column_stack([track.latitude_deg, track.longitude_deg, track.altitude_m])
        np.testing.assert_array_equal(found, PLACES[rows])
        assert len(track) == 4
        assert dict(track.left_out) == {"without a fix (status -1)": 1, "not a finite number": 1}
        assert track.source == f"{path}: /gps/fix"


def test_places_that_no_receiver_has_are_left_out(tmp_path: Path) -> None:
    places = PLACES.copy()
    places[1:5], places[5, 0] = 0.0, 95.0
    track = read_fixes(write_fixes(tmp_path, FORMATS[0], "/fix", places=places))
    assert track.latitude_deg.tolist() == [PLACES[0, 0]]
    assert dict(track.left_out) == {"latitude 0, longitude 0": 4, "beyond 90 or 180 deg": 1}


def test_bags_without_the_wanted_fixes_are_refused(tmp_path: Path) -> None:
    kind = BagFormat.MCAP
    folders = [tmp_path / name for name in ("two", "none", "lost", "back")]
    for folder in folders:
        folder.mkdir()
    two = write_fixes(folders[0], kind, "/left", "/right")
    with pytest.raises(UserError, match=r"no topic is given: give --gps_topic; .*/left .*, /right"):
        read_fixes(two)
    assert len(read_fixes(two, topic="/right")) == COUNT
    with pytest.raises(
        UserError, match=r"/imu has messages of type sensor_msgs/msg/Imu.*--gps_topic"
    ):
        read_fixes(two, topic="/imu")
    with pytest.raises(
        UserError, match="there is no topic /fix: give --gps_topic; the bag has /left"
    ):
        read_fixes(two, topic="/fix")
    with pytest.raises(UserError, match="no topic has sensor_msgs/msg/NavSatFix; the bag has /imu"):
        read_fixes(write_fixes(folders[1], kind))
    with pytest.raises(MapError, match=r"no fixes: 6 without a fix \(status -1\)"):
        read_fixes(write_fixes(folders[2], kind, "/fix", status=(-1,) * COUNT))
    with pytest.raises(MapError, match="is not after the one before"):
        read_fixes(write_fixes(folders[3], kind, "/fix", times_ns=TIMES_NS[::-1]))
    with pytest.raises(UserError, match="is no bag: leave out --gps_topic"):
        read_fixes(tmp_path / "track.csv", topic="/fix")
