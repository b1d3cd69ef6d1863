"""Writing of bags: ROS 1, and ROS 2 with sqlite3 or mcap; complete or not at all."""

from __future__ import annotations

import heapq
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from enum import Enum
from functools import partial
from itertools import repeat
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

from maplab_py.array_types import I64
from maplab_py.cancellation import check_cancelled, cleaned_up
from maplab_py.errors import MapError, UserError
from maplab_py.interop.recordings.bag_files import all_messages, message_types
from maplab_py.interop.recordings.bag_kinds import storage_kind
from maplab_py.output_files import check_writable, copy_file
from maplab_py.progress import Progress

if TYPE_CHECKING:
    from maplab_py.interop.recordings.bag_files import BagReader

_METADATA = "metadata.yaml"
_PROGRESS_EVERY = 200


class BagFormat(Enum):
    """Formats of bags (values: names in flags)."""

    ROS1 = "ros1"
    SQLITE3 = "sqlite3"
    MCAP = "mcap"

    @property
    def is_ros_2(self) -> bool:
        """Whether messages are serialised as CDR."""
        return self is not BagFormat.ROS1


class Channel(NamedTuple):
    """Messages of one topic, type and publisher."""

    topic: str
    type: str
    definition: str = ""  # empty = a standard message
    digest: str = ""
    qos: tuple[Any, ...] = ()  # ROS 2
    caller: str | None = None  # ROS 1
    latching: int | None = None  # ROS 1


class BagMessage(NamedTuple):
    """A serialised message."""

    time_ns: int  # of its arrival
    channel: Channel
    data: bytes


def format_of_path(path: Path, name: str = "") -> BagFormat:
    """Return the format of a new bag.

    Args:
        name: Name of the format; empty = ROS 1 for files .bag, else ROS 2 with mcap.

    Raises:
        UserError: Path and format do not fit.
    """
    if path.suffix in (".db3", ".mcap"):
        raise UserError(
            f"{path}: a ROS 2 bag is written as a folder: leave out {path.suffix} and give --bag_format"
        )
    is_file = path.suffix == ".bag"
    kind = BagFormat(name) if name else BagFormat.ROS1 if is_file else BagFormat.MCAP
    if kind.is_ros_2 == is_file:
        raise UserError(
            f"{path}: --bag_format={kind.value} is a {'folder' if is_file else 'file .bag'}: "
            "name it so, or give another --bag_format"
        )
    return kind


def format_of_bag(path: Path) -> BagFormat:
    """Return the format of a bag that exists; that of a folder is told by the names of its files."""
    if path.is_dir():
        has_mcap = any(".mcap" in file.name.lower() for file in path.iterdir())
        return BagFormat.MCAP if has_mcap else BagFormat.SQLITE3
    return BagFormat(storage_kind(path))


def messages_of_topic(
    times_ns: I64,
    topic: str,
    kind: str,
    rows: Iterable[bytes],
    channels: Mapping[tuple[str, str], Channel] = MappingProxyType({}),
) -> Iterator[BagMessage]:
    """Yield serialised messages of a topic, each arriving at its time (N,).

    They are standard messages unless their topic and type have a channel already.
    """
    channel = channels.get((topic, kind), Channel(topic, kind))
    return map(BagMessage, times_ns.tolist(), repeat(channel), rows)


def messages_of_bag(
    path: Path, reader: BagReader, *, without: Sequence[str] = ()
) -> Iterator[BagMessage]:
    """Yield the messages of a bag as they are, but for some topics, in the order of arrival.

    Raises:
        MapError: There are not as many messages as the bag's index says.
    """
    connections = [c for c in reader.connections if c.topic not in without]
    channels = {id(connection): channel_of(connection) for connection in connections}
    for connection, time_ns, data in all_messages(path, reader, connections):
        yield BagMessage(time_ns, channels[id(connection)], data)


def channel_of(connection: Any) -> Channel:
    """Return topic, type and definition of a connection of the library."""
    ext = connection.ext
    return Channel(
        connection.topic,
        connection.msgtype,
        connection.msgdef.data,
        connection.digest if connection.msgdef.data else "",
        tuple(getattr(ext, "offered_qos_profiles", ())),
        getattr(ext, "callerid", None),
        getattr(ext, "latching", None),
    )


def watched(messages: Iterable[BagMessage], total: int, progress: Progress) -> Iterator[BagMessage]:
    """Yield messages, and tell how many of a total are done."""
    for done, message in enumerate(messages):
        if done % _PROGRESS_EVERY == 0:
            progress.step(min(done, total), total, "messages")
        yield message


def in_order(*streams: Iterable[BagMessage]) -> Iterator[BagMessage]:
    """Yield the messages of streams, each in the order of time, in the order of time."""
    return heapq.merge(*streams, key=lambda message: message.time_ns)


def bag_files(path: Path, kind: BagFormat) -> tuple[Path, ...]:
    """Return the files of a bag; the last makes it a bag."""
    if kind is BagFormat.ROS1:
        return (path,)
    suffix = "mcap" if kind is BagFormat.MCAP else "db3"
    return path / f"{path.name}.{suffix}", path / _METADATA


def check_bag_writable(path: Path, kind: BagFormat, *, overwrite: bool) -> None:
    """Refuse a bag that cannot be written, before any work is done.

    Raises:
        UserError: It exists and `overwrite` is not set, a file is a folder or the other way round, or
            the folder of a ROS 2 bag has other files.
    """
    files = bag_files(path, kind)
    if kind.is_ros_2 and path.exists():
        if not path.is_dir():
            raise UserError(f"{path} is a file: name a folder for a ROS 2 bag")
        others = sorted(entry.name for entry in path.iterdir() if path / entry.name not in files)
        if others:
            raise UserError(f"{path} has other files ({others[0]}): name a new folder for the bag")
    check_writable(*files, overwrite=overwrite)


def write_bag(
    path: Path, kind: BagFormat, messages: Iterable[BagMessage], *, overwrite: bool = False
) -> dict[str, int]:
    """Write a bag; return the number of messages of each topic.

    The bag is written in the system's temporary folder first, and then to its place.

    Args:
        path: File of a ROS 1 bag, or folder of a ROS 2 bag.
        messages: Messages in the order of their times.

    Raises:
        UserError: The library is missing, or the bag cannot be written.
        MapError: A type of messages has no definition.
    """
    check_bag_writable(path, kind, overwrite=overwrite)
    message_types(is_ros_2=kind.is_ros_2)  # says what to install
    with (
        tempfile.TemporaryDirectory(prefix="maplab_bag_", ignore_cleanup_errors=True) as folder,
        cleaned_up(partial(shutil.rmtree, folder, ignore_errors=True)),
    ):
        scratch = Path(folder) / path.name
        counts = _written(scratch, kind, messages, path)
        for source, target in zip(bag_files(scratch, kind), bag_files(path, kind), strict=True):
            copy_file(source, target, overwrite=overwrite)
    return counts


def _written(
    scratch: Path, kind: BagFormat, messages: Iterable[BagMessage], path: Path
) -> dict[str, int]:
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2

    writer: Any
    if kind is BagFormat.ROS1:
        writer = Writer1(scratch)
    else:
        plugin = StoragePlugin.MCAP if kind is BagFormat.MCAP else StoragePlugin.SQLITE3
        writer = Writer2(scratch, version=9, storage_plugin=plugin)
    store = message_types(is_ros_2=kind.is_ros_2)
    connections: dict[Channel, Any] = {}
    counts: Counter[str] = Counter()
    try:
        with writer:
            for time_ns, channel, data in messages:
                connection = connections.get(channel)
                if connection is None:
                    check_cancelled()
                    connection = _connection(writer, channel, store, kind, path)
                    connections[channel] = connection
                writer.write(connection, time_ns, data)
                counts[channel.topic] += 1
    except OSError as error:
        raise UserError(
            f"{path}: the bag cannot be written in {scratch.parent} ({error.strerror}): free space "
            "there, or name another folder by the environment variable TMPDIR"
        ) from error
    return dict(counts)


def _connection(writer: Any, channel: Channel, store: Any, kind: BagFormat, path: Path) -> Any:
    definition = channel.definition or None
    if definition is None and channel.type not in store.types:
        raise MapError(
            f"{path}: messages of {channel.topic} have the type {channel.type}, which has no "
            "definition: record them with ROS 2 Iron or later, which stores it"
        )
    digest, described = channel.digest or None, {"typestore": store, "msgdef": definition}
    if kind is BagFormat.ROS1:
        described |= {"md5sum": digest, "callerid": channel.caller, "latching": channel.latching}
    else:
        described |= {"rihs01": digest, "offered_qos_profiles": channel.qos}
    return writer.add_connection(channel.topic, channel.type, **described)
