"""Bags as files: opening them with the library rosbags (the extra `bags`), and their topics."""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from maplab_py.errors import MapError, MaplabError, UserError

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.typesys.store import Typestore

    BagReader = AnyReader

_REMEDY = "copy the bag again, or repair it with `rosbag reindex` or `ros2 bag reindex`"
_S_TO_NS = 1_000_000_000
_IMU_NUMBERS, _GYRO, _ACCEL = 37, slice(13, 16), slice(25, 28)
"""Numbers behind the header of sensor_msgs/Imu, and which of them are the measurements."""
_SQLITE, _SQLITE_HEADER = b"SQLite format 3\x00", 100


def is_bag(path: Path) -> bool:
    """Tell whether a path is a ROS 1 bag, or a file or folder of a ROS 2 bag."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file()
    return path.suffix in (".bag", ".db3", ".mcap")


def check_bag(path: Path, flag: str) -> None:
    """Refuse a path that is no bag.

    Raises:
        UserError: It does not exist, or is something else.
    """
    if not path.exists():
        raise UserError(f"{flag}={path} does not exist: give a ROS 1 bag, or a ROS 2 bag")
    if not is_bag(path):
        raise UserError(
            f"{flag}={path} is no bag: wants a ROS 1 bag (.bag) or a ROS 2 bag (folder with "
            "metadata.yaml, .db3, .mcap)"
        )


def message_types(*, is_ros_2: bool) -> Typestore:
    """Return the standard messages of ROS 2 Humble or ROS 1 Noetic, tf2_msgs included.

    Raises:
        UserError: The library is missing.
    """
    try:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError as error:
        raise _library_missing("bags") from error
    if is_ros_2:
        return get_typestore(Stores.ROS2_HUMBLE)
    store = get_typestore(Stores.ROS1_NOETIC)
    tf = "tf2_msgs/msg/TFMessage"  # the library's messages of ROS 1 lack it
    if tf not in store.types:
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", tf))
    return store


@contextlib.contextmanager
def opened_bag(path: Path) -> Iterator[AnyReader]:
    """Open a bag; whatever its parser says of damage becomes a MapError.

    Raises:
        UserError: The library is missing.
        MapError: The bag is damaged, without index, or has messages of unknown types.
    """
    try:
        from rosbags.highlevel import AnyReader
    except ImportError as error:
        raise _library_missing(str(path)) from error
    try:
        # files of ROS 2 before Iron hold no definitions of their messages
        _check_databases(path)
        with AnyReader([path], default_typestore=message_types(is_ros_2=True)) as reader:
            yield reader
    except MaplabError:
        raise
    except KeyError as error:
        raise MapError(
            f"{path}: the bag has messages of type {error} without their definition: record them "
            "with ROS 2 Iron or later, or leave their topic out with `ros2 bag convert`"
        ) from error
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise MapError(f"{path}: the bag cannot be read ({reason}): {_REMEDY}") from error


def all_messages(
    path: Path, reader: BagReader, connections: list[Any]
) -> Iterator[tuple[Any, int, bytes]]:
    """Yield connection, time of arrival and data of the messages of some connections.

    Raises:
        MapError: There are fewer messages than the bag's index says, or more.
    """
    expected, count = sum(connection.msgcount for connection in connections), 0
    if connections:  # the library takes none for all
        for message in reader.messages(connections):
            count += 1
            yield message
    if count != expected:
        raise MapError(f"{path}: {count} messages can be read, the index has {expected}: {_REMEDY}")


def header_stamp_ns(data: bytes, *, is_ros_2: bool) -> int:
    """Return the stamp of a serialised message that begins with a header.

    Raises:
        struct.error: The message is too short.
    """
    if is_ros_2:
        seconds, nanoseconds = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, 4)
    else:
        seconds, nanoseconds = struct.unpack_from("<II", data, 4)
    return int(seconds) * _S_TO_NS + int(nanoseconds)


def imu_sample(data: bytes, *, is_ros_2: bool) -> tuple[float, ...]:
    """Return [ax ay az gx gy gz] of a serialised sensor_msgs/Imu, m/s^2 and rad/s.

    Raises:
        struct.error: The message is too short.
    """
    order = "<" if not is_ros_2 or data[1] & 1 else ">"
    text_at = 12  # behind the stamp
    begin = text_at + 4 + int(struct.unpack_from(f"{order}I", data, text_at)[0])
    if is_ros_2:
        begin += -(begin - 4) % 8
    numbers = struct.unpack_from(f"{order}{_IMU_NUMBERS}d", data, begin)
    return numbers[_ACCEL] + numbers[_GYRO]


def topic_types(reader: AnyReader) -> dict[str, str]:
    """Return the type of the messages of each topic."""
    return {connection.topic: connection.msgtype for connection in reader.connections}


def listed_topics(types: dict[str, str]) -> str:
    """Return topics and types in one line."""
    return ", ".join(f"{topic} ({kind})" for topic, kind in sorted(types.items())) or "none"


def _check_databases(path: Path) -> None:
    """Refuse truncated databases; where their end is missing, SQLite reads zeros.

    Source: "Database File Format", section 1.3, sqlite.org.

    Raises:
        MapError: A file is shorter than its header says.
    """
    files = sorted(path.glob("*.db3")) if path.is_dir() else [path]
    for file in files:
        with file.open("rb") as stream:
            header = stream.read(_SQLITE_HEADER)
        if len(header) < _SQLITE_HEADER or not header.startswith(_SQLITE):
            continue  # no database: the library knows what it is
        page_bytes, pages = struct.unpack_from(">H", header, 16)[0], _number(header, 28)
        page_bytes = 65536 if page_bytes == 1 else page_bytes
        is_counted = _number(header, 24) == _number(header, 92)
        if is_counted and file.stat().st_size < page_bytes * pages:
            raise MapError(
                f"{path}: the bag cannot be read ({file.name} has {file.stat().st_size:,} of "
                f"{page_bytes * pages:,} bytes): {_REMEDY}"
            )


def _number(data: bytes, offset: int) -> int:
    return int(struct.unpack_from(">I", data, offset)[0])


def _library_missing(name: str) -> UserError:
    return UserError(
        f"{name}: bags are read and written with the library rosbags: install it with "
        "`pip install 'maplab-py[bags]'`"
    )
