"""Reading of bags with the library rosbags: storage files, whatever their metadata say, and single types.

Only the definitions of messages that are deserialised are parsed, so that no other topic can stop a reader.
Where a bag has no definition of a type, or one that cannot be parsed, that of ROS 1 Noetic or ROS 2 Humble is
taken.
"""

from __future__ import annotations

import contextlib
import heapq
import itertools
import shutil
import sys
import tempfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

from rosbags import interfaces
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag2 import storage_mcap
from rosbags.rosbag2.metadata import ReaderMetadata, parse_qos
from rosbags.rosbag2.storage_mcap import McapReader
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from maplab_py.atomic import replaced_file
from maplab_py.errors import MapError
from maplab_py.interop.recordings.bag_kinds import full_type, storage_kind

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

_ZSTD_FRAME = b"\x28\xb5\x2f\xfd"
_FORMATS = {
    "ros2msg": interfaces.MessageDefinitionFormat.MSG,
    "ros2idl": interfaces.MessageDefinitionFormat.IDL,
    "omgidl": interfaces.MessageDefinitionFormat.IDL,
}
_NO_DEFINITION = interfaces.MessageDefinition(interfaces.MessageDefinitionFormat.NONE, "")
_IDL_SEPARATOR = "=" * 80 + "\n"
_LAST_NS = (1 << 63) - 1


class BagReader:
    """Connections and messages of a ROS 1 or ROS 2 bag.

    Attributes:
        is2: It is a ROS 2 bag.
        connections: One per topic and type (ROS 2) or publisher (ROS 1), types as package/msg/Name.
        message_count: Messages of all.
    """

    def __init__(self, path: Path, files: Sequence[Path], metadata: Mapping[str, Any]) -> None:
        """Name a bag; nothing is read but the beginning of its file.

        Args:
            metadata: What its metadata.yaml says; empty without one.
        """
        self._path, self._files, self._metadata = path, files, metadata
        self._stack = contextlib.ExitStack()
        self._storages: list[Any] = []
        self._sources: dict[int, list[tuple[Any, interfaces.Connection]]] = {}
        self._stores: dict[str, Typestore] = {}
        self.is2 = path.is_dir() or storage_kind(path) != "ros1"
        self.connections: list[interfaces.Connection] = []

    def __enter__(self) -> BagReader:
        try:
            self._open()
        except BaseException:
            self._stack.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    @property
    def message_count(self) -> int:
        """Number of messages."""
        return sum(connection.msgcount for connection in self.connections)

    @property
    def start_time(self) -> int:
        """Arrival [ns] of the first message."""
        return min((_times_ns(storage)[0] for storage in self._storages), default=_LAST_NS)

    @property
    def end_time(self) -> int:
        """Arrival [ns] of the last message."""
        return max((_times_ns(storage)[1] for storage in self._storages), default=0)

    def messages(
        self,
        connections: Collection[interfaces.Connection] = (),
        start: int | None = None,
        stop: int | None = None,
    ) -> Iterator[tuple[interfaces.Connection, int, bytes]]:
        """Yield connection, arrival [ns] and data of messages from start to stop, in their order.

        Args:
            connections: Of `connections`; () = all.
            start: Earliest arrival [ns].
            stop: Messages that arrive then or later are left out.
        """
        parts: list[Iterator[tuple[interfaces.Connection, int, bytes]]] = []
        for storage in self._storages:
            wanted = {
                source.id: (source, connection)
                for connection in connections or self.connections
                for owner, source in self._sources[connection.id]
                if owner is storage
            }
            if wanted:
                parts.append(self._read(storage, wanted, start, stop))
        spans = [_times_ns(storage) for storage in self._storages]
        if all(a[1] <= b[0] for a, b in itertools.pairwise(spans)):
            yield from itertools.chain.from_iterable(parts)
        else:
            yield from heapq.merge(*parts, key=lambda message: message[1])

    def deserialize(self, data: bytes, msgtype: str) -> Any:
        """Return the content of a message.

        Raises:
            MapError: The bag has no definition of its type, and the type is not a standard one.
        """
        store = self._stores.get(msgtype) or self._new_store(msgtype)
        if self.is2:
            return store.deserialize_cdr(data, msgtype)
        return store.deserialize_ros1(data, msgtype)

    def _open(self) -> None:
        if self.is2:
            channels: dict[tuple[str, str], list[tuple[Any, interfaces.Connection]]] = {}
            for file in self._files:
                unpacked = self._unpacked(file)
                is_mcap = storage_kind(unpacked) == "mcap"
                storage: Any = (_McapFile if is_mcap else _Database)(unpacked)
                storage.open()
                self._stack.callback(storage.close)
                self._storages.append(storage)
            self._storages.sort(key=_times_ns)
            for storage in self._storages:
                for source in storage.connections:
                    key = source.topic, full_type(source.msgtype)
                    channels.setdefault(key, []).append((storage, source))
            digests = _digests(self._metadata)
            for (topic, kind), sources in channels.items():
                first = sources[0][1]
                if not first.digest and topic in digests:
                    sources[0] = (sources[0][0], first._replace(digest=digests[topic]))
                self._add(sources, topic, kind)
        else:
            reader = Reader1(self._path)
            self._stack.enter_context(reader)
            self._storages.append(reader)
            for source in reader.connections:
                self._add([(reader, source)], source.topic, source.msgtype)

    def _add(self, sources: list[tuple[Any, interfaces.Connection]], topic: str, kind: str) -> None:
        number = len(self.connections)
        defined = [source for _, source in sources if source.msgdef.data] or [sources[0][1]]
        count = sum(source.msgcount for _, source in sources)
        self.connections.append(
            defined[0]._replace(id=number, topic=topic, msgtype=kind, msgcount=count)
        )
        self._sources[number] = sources

    def _unpacked(self, file: Path) -> Path:
        """Return a file that is not compressed as a whole; a temporary one for a file .zstd."""
        if file.suffix not in (".zstd", ".zst"):
            return file
        folder = Path(self._stack.enter_context(tempfile.TemporaryDirectory()))
        target = folder / file.stem
        with zstd.open(file, "rb") as source, replaced_file(target, durable=False) as copy:
            shutil.copyfileobj(source, copy)
        return target

    def _read(
        self,
        storage: Any,
        wanted: dict[int, tuple[interfaces.Connection, interfaces.Connection]],
        start: int | None,
        stop: int | None,
    ) -> Iterator[tuple[interfaces.Connection, int, bytes]]:
        """Yield messages of one file; those that are compressed one by one are decompressed."""
        sources = [source for source, _ in wanted.values()]
        named = {key: connection for key, (_, connection) in wanted.items()}
        is2 = self.is2
        for source, time_ns, data in storage.messages(sources, start, stop):
            if is2 and data[:4] == _ZSTD_FRAME:
                yield named[source.id], time_ns, zstd.decompress(data)
            else:
                yield named[source.id], time_ns, data

    def _new_store(self, msgtype: str) -> Typestore:
        """Return definitions of a type and its parts: the bag's, else the standard ones."""
        for connection in self.connections:
            if connection.msgtype == msgtype and connection.msgdef.data:
                with contextlib.suppress(Exception):
                    store = get_typestore(Stores.EMPTY)
                    store.register(_parsed(connection))
                    self._stores[msgtype] = store
                    return store
        standard = message_types(is_ros_2=self.is2)
        if msgtype not in standard.types:
            raise MapError(
                f"{self._path}: the bag has messages of type '{msgtype}' without a definition that can be "
                "read: record them with ROS 2 Iron or later, or leave their topic out with `ros2 bag convert`"
            )
        self._stores[msgtype] = standard
        return standard


def message_types(*, is_ros_2: bool) -> Typestore:
    """Return the standard messages of ROS 2 Humble or ROS 1 Noetic, tf2_msgs included."""
    if is_ros_2:
        return get_typestore(Stores.ROS2_HUMBLE)
    store = get_typestore(Stores.ROS1_NOETIC)
    tf = "tf2_msgs/msg/TFMessage"  # the library's messages of ROS 1 lack it
    if tf not in store.types:
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", tf))
    return store


def _digests(metadata: Mapping[str, Any]) -> dict[str, str]:
    """Return the digests of the types by topic, which MCAP files leave to metadata.yaml."""
    digests: dict[str, str] = {}
    with contextlib.suppress(AttributeError, KeyError, TypeError):  # the metadata may be anything
        for entry in metadata.get("topics_with_message_count") or []:
            topic = entry["topic_metadata"]
            digests[topic["name"]] = str(topic.get("type_description_hash", ""))
    return digests


def _parsed(connection: interfaces.Connection) -> Any:
    """Return the types that the definition of a connection has."""
    text = connection.msgdef.data
    if connection.msgdef.format == interfaces.MessageDefinitionFormat.MSG:
        return get_types_from_msg(text, connection.msgtype)
    if not text.startswith(f"{_IDL_SEPARATOR}IDL: "):
        return get_types_from_idl(text)
    types: dict[str, Any] = {}
    for part in text.split(_IDL_SEPARATOR)[1:]:
        types.update(get_types_from_idl(part.partition("\n")[2]))
    return types


def _times_ns(storage: Any) -> tuple[int, int]:
    """Return first and last arrival [ns] of a storage file."""
    if isinstance(storage, Reader1):
        return storage.start_time, storage.end_time
    return storage.metadata.start_time, storage.metadata.end_time


class _Schemas(dict[int, Any]):
    """Definitions of an MCAP file; those in languages that are not ROS' are empty."""

    def __setitem__(self, key: int, schema: Any) -> None:
        known = schema.encoding in _FORMATS
        super().__setitem__(key, schema if known else schema._replace(encoding="", data=""))


def _read_text(bio: BinaryIO) -> str:
    """Return a text of an MCAP file; definitions in languages that are not ROS' may be binary."""
    return bytes(storage_mcap.read_bytes(bio)).decode(errors="replace")


storage_mcap.read_string = _read_text  # the library decodes all definitions as it reads the index


class _McapFile(McapReader):
    """An MCAP file of which any channel may have any definition."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.schemas = _Schemas()


class _Database(Sqlite3Reader):
    """A database of ROS 2 of any version, of which any topic may have any definition."""

    def _open(self) -> None:
        database: Any = self.dbconn
        columns = {row[1] for row in database.execute("PRAGMA table_info(topics)")}
        if not columns or not list(database.execute("PRAGMA table_info(messages)")):
            raise ValueError("the database has no tables of topics and messages")
        definitions: dict[str, interfaces.MessageDefinition] = {}
        if list(database.execute("PRAGMA table_info(message_definitions)")):
            for kind, encoding, text in database.execute(
                "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            ):
                if encoding in _FORMATS:
                    definitions[kind] = interfaces.MessageDefinition(_FORMATS[encoding], text)
        counts = dict(database.execute("SELECT topic_id, COUNT(*) FROM messages GROUP BY topic_id"))
        optional = [
            name if name in columns else "''"
            for name in ("offered_qos_profiles", "type_description_hash")
        ]
        self.connections = []
        for key, topic, kind, form, qos, digest in database.execute(
            f"SELECT id, name, type, serialization_format, {', '.join(optional)} FROM topics ORDER BY id"
        ):
            profiles: list[Any] = []
            with contextlib.suppress(Exception):
                profiles = parse_qos(qos)
            ext = interfaces.ConnectionExtRosbag2(form, profiles)
            definition = definitions.get(kind, _NO_DEFINITION)
            self.connections.append(
                interfaces.Connection(
                    key, topic, kind, definition, digest, counts.get(key, 0), ext, self
                )
            )
        ((first_ns, last_ns),) = database.execute(
            "SELECT MIN(timestamp), MAX(timestamp) FROM messages"
        )
        is_empty = first_ns is None
        self.metadata = ReaderMetadata(
            0 if is_empty else last_ns + 1 - first_ns,
            _LAST_NS if is_empty else first_ns,
            0 if is_empty else last_ns + 1,
            sum(counts.values()),
            None,
            None,
            None,
            None,
        )
