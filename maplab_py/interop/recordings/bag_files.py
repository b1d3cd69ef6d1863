"""Bags as files: which they are, opening them, and what to do about damaged ones."""

from __future__ import annotations

import contextlib
import dataclasses
import re
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from maplab_py.errors import MapError, MaplabError, UserError
from maplab_py.input_files import read_text
from maplab_py.interop.recordings import bag_kinds, clocks

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

    from maplab_py.interop.recordings.bag_reader import BagReader as BagReader

_REMEDY = "copy the bag again, or repair it with `rosbag reindex` or `ros2 bag reindex`"
_REMEDIES = (
    (r"not indexed|index looks damaged", "it was not closed: run `rosbag reindex {file}`"),
    (
        r"end magic|Truncated record|MCAP footer|MCAP summary|Unexpected record|Chunk ",
        "it is cut or was not closed: run `mcap recover {file} -o whole.mcap` and read whole.mcap",
    ),
    (
        r"malformed|not a database|disk I/O|has [\d,]+ of|no tables",
        "it is cut or was not closed: run `sqlite3 {file} .recover | sqlite3 whole.db3` and read whole.db3",
    ),
    (r"Profile is not", "convert it to an MCAP file of ROS 2, as with `rosbags-convert`"),
    (r"zstd|[Cc]ompress|frame", "its compressed data are damaged: copy it again"),
)
"""Words of the libraries' errors, and what helps."""
_S_TO_NS = 1_000_000_000
_IMU_NUMBERS, _GYRO, _ACCEL = 37, slice(13, 16), slice(25, 28)
"""Numbers behind the header of sensor_msgs/Imu, and which of them are the measurements."""
_IMU_LAYOUTS = tuple(
    (struct.Struct(f"{order}I").unpack_from, struct.Struct(f"{order}{_IMU_NUMBERS}d").unpack_from)
    for order in "><"
)
_SQLITE_HEADER = struct.Struct(">16xH6xII60xI4x")
"""Size of pages, counter of changes, number of pages, and the change at which they were counted."""
_METADATA = "metadata.yaml"
_SHOWN = 40
"""Bytes of a text that are shown where it stands for a bag."""
_MAX_METADATA_BYTES = 50_000_000
_STORAGE = re.compile(r".*\.(db3|mcap)(\.zstd?)?", re.IGNORECASE | re.DOTALL)


IMU, ACCELEROMETER = -1, -2


@dataclasses.dataclass(frozen=True)
class TopicStream:
    """One topic: the IMU's, its accelerometer's, or that of a camera."""

    topic: str
    camera: int  # row, or IMU, or ACCELEROMETER
    time_offset_ns: int = 0
    count: int = 0  # messages
    first_ns: int = 0  # time of the first message
    delay_ns: int = 0  # from its time to its arrival
    arrivals_ns: tuple[int, int] | None = None  # of the part that is read

    def of_run(self, run: clocks.Run) -> TopicStream:
        """Return the stream that ends with a run of its clock."""
        return dataclasses.replace(
            self,
            count=run.count,
            first_ns=run.first_ns,
            delay_ns=run.first_arrival_ns - run.first_ns,
            arrivals_ns=(run.first_arrival_ns, run.last_arrival_ns),
        )


def is_bag(path: Path) -> bool:
    """Tell whether a path is a ROS 1 bag, or a file or folder of a ROS 2 bag."""
    if path.is_dir():
        return (path / _METADATA).is_file() or bool(_storages_in(path))
    return path.suffix.lower() == ".bag" or _is_storage(path)


def check_bag(path: Path, flag: str) -> None:
    """Refuse a path that is no bag.

    Raises:
        UserError: It does not exist, or is something else.
    """
    if not path.exists():
        raise UserError(f"{flag}={path} does not exist: give a ROS 1 bag, or a ROS 2 bag")
    if not is_bag(path):
        raise UserError(
            f"{flag}={path} is no bag: wants a ROS 1 bag (.bag) or a ROS 2 bag (a folder, or a file .db3 or "
            ".mcap)"
        )


def message_types(*, is_ros_2: bool) -> Typestore:
    """Return the standard messages of ROS 2 Humble or ROS 1 Noetic, tf2_msgs included.

    Raises:
        UserError: The library is missing.
    """
    try:
        from maplab_py.interop.recordings import bag_reader
    except ImportError as error:
        raise _library_missing("bags") from error
    return bag_reader.message_types(is_ros_2=is_ros_2)


@contextlib.contextmanager
def opened_bag(path: Path) -> Iterator[BagReader]:
    """Open a bag; whatever its parser says of damage becomes a MapError.

    Raises:
        UserError: The library is missing.
        MapError: The bag is damaged, or without index.
    """
    try:
        from maplab_py.interop.recordings.bag_reader import BagReader
    except ImportError as error:
        raise _library_missing(str(path)) from error
    with damage_named(path):
        _check_databases(path)
        metadata = _metadata(path)
        with BagReader(path, _storage_files(path, metadata), metadata) as reader:
            yield reader


@contextlib.contextmanager
def damage_named(path: Path) -> Iterator[None]:
    """Raise whatever a parser says of damage as a MapError.

    Raises:
        MapError: The bag is damaged, or without index.
    """
    try:
        yield
    except MaplabError:
        raise
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise MapError(
            f"{path}: the bag cannot be read ({reason}): {_remedy(path, reason)}"
        ) from error


def _storage_files(path: Path, metadata: dict[str, Any]) -> list[Path]:
    """Return the files of a ROS 2 bag: those of its metadata.yaml, or all, where it has none.

    Raises:
        MapError: A file is missing.
    """
    if not path.is_dir():
        return [path]
    present = _storages_in(path)
    listed = metadata.get("relative_file_paths") or []
    named = [Path(str(name)).name for name in listed]
    if not named or not present:
        if not present:
            raise MapError(
                f"{path}: the bag cannot be read (there is no file .db3 or .mcap): copy the folder again"
            )
        return present
    files = []
    for name in named:
        stem = name.removesuffix(".zstd").removesuffix(".zst")
        matches = [
            file for file in present if file.name in (name, stem, f"{stem}.zstd", f"{stem}.zst")
        ]
        if not matches:
            raise MapError(
                f"{path}: the bag cannot be read ({name} of its {_METADATA} is missing): copy it there, or "
                f"remove {_METADATA} to read the other files"
            )
        files.append(matches[0])
    return files


def _metadata(path: Path) -> dict[str, Any]:
    """Return what the metadata.yaml of a folder says; nothing where there is none, or it is damaged."""
    import yaml

    try:
        remedy = "it is no such file"
        text = read_text(path / _METADATA, _MAX_METADATA_BYTES, remedy=remedy, error=MapError)
        content = yaml.load(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
        return dict(content["rosbag2_bagfile_information"])
    except (OSError, UnicodeDecodeError, yaml.YAMLError, KeyError, TypeError, ValueError):
        return {}


def _storages_in(folder: Path) -> list[Path]:
    """Return the storage files of a folder; a plain file hides its compressed copy."""
    files = {file.name: file for file in folder.iterdir() if _is_storage(file)}
    packed = (".zstd", ".zst")
    return sorted(f for f in files.values() if f.suffix not in packed or f.stem not in files)


def _is_storage(path: Path) -> bool:
    return path.is_file() and _STORAGE.fullmatch(path.name) is not None


def _remedy(path: Path, reason: str) -> str:
    """Return what the user can do about a bag that the library cannot read."""
    file = path
    if path.is_dir():
        files = _storages_in(path)
        file = next((part for part in files if part.name in reason or len(files) == 1), file)
    if file.is_file() and not file.stat().st_size:
        return "the file is empty: copy it again"
    if file.is_file():
        with file.open("rb") as stream:
            head = stream.readline(_SHOWN)
        if re.fullmatch(rb"[\x20-\x7e]+\n?", head) and not head.startswith(b"#ROSBAG"):
            return f"it is text, '{head.decode().strip()} ...': fetch the bag itself, as by `git lfs pull`"
    for words, remedy in _REMEDIES:
        if re.search(words, reason):
            return remedy.format(file=file)
    return _REMEDY


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
    form = "<II" if not is_ros_2 else "<iI" if data[1] & 1 else ">iI"
    seconds, nanoseconds = struct.unpack_from(form, data, 4)
    stamp_ns: int = seconds * _S_TO_NS + nanoseconds
    return stamp_ns


def imu_sample(data: bytes, *, is_ros_2: bool) -> tuple[float, ...]:
    """Return [ax ay az gx gy gz] of a serialised sensor_msgs/Imu, m/s^2 and rad/s.

    Raises:
        struct.error: The message is too short.
    """
    length, values = _IMU_LAYOUTS[not is_ros_2 or data[1] & 1 > 0]
    begin = 16 + length(data, 12)[0]  # behind the stamp is the frame's name
    if is_ros_2:
        begin += -(begin - 4) % 8
    numbers: tuple[float, ...] = values(data, begin)
    return numbers[_ACCEL] + numbers[_GYRO]


def topic_types(reader: BagReader) -> dict[str, str]:
    """Return the type of the messages of each topic."""
    return {connection.topic: connection.msgtype for connection in reader.connections}


def listed_topics(types: dict[str, str]) -> str:
    """Return topics and types in one line."""
    return ", ".join(f"{topic} ({kind})" for topic, kind in sorted(types.items())) or "none"


def topic_in_bag(
    path: Path,
    types: dict[str, str],
    asked: str,
    flag: str,
    wanted: Sequence[str],
    sensor: str = "",
) -> str:
    """Return the bag's name of a topic.

    Args:
        types: Types of the topics of the bag.
        asked: Name as it was given; empty = none was.
        flag: Flag that names it.
        wanted: Types that it may have.
        sensor: What its messages are of, for messages.

    Raises:
        UserError: It is not given, not there, or of another type.
    """
    usable = {topic: kind for topic, kind in types.items() if kind in wanted}
    known, owner = f"the bag has {listed_topics(usable or types)}", f" of {sensor}" * bool(sensor)
    topic = next((t for t in types if asked and t.strip("/") == asked.strip("/")), None)
    if topic is None and not usable:
        raise UserError(f"{path}: no topic has {' or '.join(wanted)}; {known}")
    if topic is None:
        problem = f"there is no topic {asked}{owner}" if asked else f"no topic{owner} is given"
        raise UserError(f"{path}: {problem}: give {flag}; {known}")
    if topic not in usable:
        is_video = any(word in types[topic].lower() for word in ("video", "ffmpeg"))
        hint = " (a video: decode it to images first, as with `image_transport republish`)"
        raise UserError(
            f"{path}: {topic} has messages of type {types[topic]}{hint if is_video else ''}, wanted is "
            f"{' or '.join(wanted)}: give {flag}; {known}"
        )
    return topic


def _check_databases(path: Path) -> None:
    """Refuse truncated databases; where their end is missing, SQLite reads zeros.

    Source: "Database File Format", section 1.3, sqlite.org.

    Raises:
        MapError: A file is shorter than its header says.
    """
    files = sorted(path.glob("*.db3")) if path.is_dir() else [path]
    for file in files:
        with file.open("rb") as stream:
            header = stream.read(_SQLITE_HEADER.size)
        if len(header) < _SQLITE_HEADER.size or not header.startswith(bag_kinds.SQLITE):
            continue  # no database: the library knows what it is
        page_bytes, changes, pages, counted_at = _SQLITE_HEADER.unpack(header)
        wanted, size = (65536 if page_bytes == 1 else page_bytes) * pages, file.stat().st_size
        if changes == counted_at and size < wanted:
            raise MapError(
                f"{path}: the bag cannot be read ({file.name} has {size:,} of {wanted:,} bytes): {_REMEDY}"
            )


def _library_missing(name: str) -> UserError:
    return UserError(
        f"{name}: bags are read and written with the library rosbags: install it with "
        "`pip install 'maplab-py[bags]'`"
    )
