"""Topics of ROS 2 by DDS, with the library cyclonedds (the extra `ros2`).

Messages pass as bytes (`_clayer`); this is the only file that knows the library's inside. Sources: ROS 2
documentation, "About internal ROS 2 interfaces" and "About Quality of Service settings"; Cyclone DDS,
"Configuration guide".
"""

import dataclasses
import functools
import os
import threading
import time
import types as class_types
from pathlib import Path
from typing import Any

from maplab_py.errors import UserError
from maplab_py.interop.live import options, transport
from maplab_py.interop.recordings.bag_files import message_types

# ROS's `sensor_msgs/msg/Image` is the type `sensor_msgs::msg::dds_::Image_` of DDS: the module `dds_`
# between, an underscore behind; final, without key. Source: design.ros2.org, "Topic and Service name
# mapping to DDS", and OMG IDL 4.2. The types only declare: messages pass as bytes, because decoding
# an image by its type makes a Python list of its pixels.

_BASE, _NAME, _ARRAY = 1, 2, 3
"""Kinds of fields in the definitions of the library rosbags; what remains are sequences."""
_SCALARS = {"bool": bool, "string": str}


def dds_type_name(kind: str) -> str:
    """Return the name that DDS has for a type of ROS, its modules separated by dots."""
    package, _, name = kind.split("/")
    return f"{package}.msg.dds_.{name}_"


def ros_type_name(dds_name: str) -> str:
    """Return the name that ROS has for a type of DDS; another type's name as it is."""
    words = dds_name.replace("::", ".").split(".")
    is_ros = len(words) == 4 and words[1:3] == ["msg", "dds_"]
    return f"{words[0]}/msg/{words[3].removesuffix('_')}" if is_ros else dds_name


@functools.cache
def type_hash(kind: str) -> str:
    """Return the hash of a standard message (REP 2011); tools of ROS 2 show it."""
    return str(message_types(is_ros_2=True).hash_rihs01(kind))


@functools.cache
def dds_type(kind: str) -> Any:
    """Return the class that declares a standard message of ROS 2 to DDS.

    Raises:
        UserError: The type is no standard message.
    """
    from cyclonedds.idl import IdlStruct
    from cyclonedds.idl.annotations import final

    definitions = message_types(is_ros_2=True).fielddefs
    if kind not in definitions:
        raise UserError(
            f"messages of type {kind} are not known: choose topics of standard messages"
        )
    fields = {name: _field_type(field) for name, field in definitions[kind][1]}
    name = dds_type_name(kind)
    made = class_types.new_class(
        name.rsplit(".", 1)[1],
        (IdlStruct,),
        {"typename": name},
        lambda body: body.update({"__annotations__": fields}),
    )
    return final(dataclasses.dataclass(made))


def _field_type(field: tuple[Any, Any]) -> Any:
    """Return the annotation of a field: (kind, (content, ...))."""
    from cyclonedds.idl import types

    idl: Any = types  # its `array` and `sequence` are indexed, which the library's hints deny
    kind, content = field
    if kind == _BASE:
        return _SCALARS.get(content[0]) or getattr(idl, content[0])
    if kind == _NAME:
        return dds_type(content)
    element, length = _field_type(content[0]), content[1]
    return idl.array[element, length] if kind == _ARRAY else idl.sequence[element]


_PREFIX = "rt"  # of the topics of ROS, in DDS
_MAX_PARTICIPANTS = 30
_ENOUGH_SOCKET_BYTES = 4_000_000
"""An image is sent as hundreds of packets at once; with the usual 208 kB a fifth of the images is lost."""
_RECEIVE_LIMIT = Path("/proc/sys/net/core/rmem_max")
_LARGEST_TAKE = 1000
_WAIT_MS = 100
_BLOCK_MS = 100
"""A writer that waits for a slow reader holds all threads of Python; so it does not wait long."""
_CHECK_EVERY_S = 1.0
_DEPTHS = {"sensor_msgs/msg/Imu": 2000}
_DEPTH = 30
"""Messages that wait while Python does something else: 10 s of an IMU, 1.5 s of a camera."""
_FAST_DDS = "1.15"
"""Vendor whose type information is ignored: Cyclone DDS cannot read that of ROS 2 Kilted, and would
wait for ever for one that it can (cyclonedds#2333). Topics then match by the names of their types."""


class Ros2:
    """A participant of a domain of ROS 2."""

    is_ros_2 = True

    def __init__(self, network: options.NetworkOptions) -> None:
        """Join a domain.

        Raises:
            UserError: The library is missing, or refuses the network or its configuration.
        """
        try:
            from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
            from cyclonedds.core import DDSException, WaitSet
            from cyclonedds.domain import Domain, DomainParticipant
        except ImportError as error:
            raise UserError(
                "topics of ROS 2 are read with the library cyclonedds: install it with "
                "`pip install 'maplab-py[ros2]'`; where it has no wheel (Linux on ARM), run "
                "foxglove_bridge and give --datasource_type=foxglove"
            ) from error
        self.name = f"ROS 2 domain {network.domain}"
        self.problems: list[str] = _socket_problems()
        try:
            self._domain = Domain(network.domain, _configuration(network))
            self._participant = DomainParticipant(network.domain)
        except DDSException as error:
            raise UserError(
                f"{self.name}: DDS cannot start ({' '.join(str(error).split())}): check "
                "--live_interface and CYCLONEDDS_URI, and that no other live source runs in this "
                "program"
            ) from error
        self._publications = BuiltinDataReader(self._participant, BuiltinTopicDcpsPublication)
        self._waits: Any = WaitSet(self._participant)
        self._readers: dict[str, _Reader] = {}
        self._writers: dict[str, Any] = {}
        self._lock = threading.Lock()
        self._is_closed = False
        self._thread = threading.Thread(target=self._receive, name="ros2", daemon=True)

    def topics(self) -> dict[str, transport.Topic]:
        """Return the topics that are published now, by name."""
        from cyclonedds.core import InstanceState, Policy, ReadCondition, SampleState, ViewState

        mask = SampleState.Any | ViewState.Any | InstanceState.Alive
        with self._lock:
            condition = ReadCondition(self._publications, mask)
            publications = self._publications.read(10 * _LARGEST_TAKE, condition=condition)
        published_here = {bytes(writer.guid.bytes) for writer in self._writers.values()}
        topics: dict[str, transport.Topic] = {}
        for publication in publications:
            name = getattr(publication, "topic_name", "")
            if not name.startswith(f"{_PREFIX}/") or publication.key.bytes in published_here:
                continue
            name = name.removeprefix(_PREFIX)
            reliability = publication.qos[Policy.Reliability]
            is_reliable = reliability != Policy.Reliability.BestEffort
            known = topics.get(name)
            topics[name] = transport.Topic(
                name,
                ros_type_name(publication.type_name),
                1 + (known.publishers if known else 0),
                is_reliable and (known is None or known.is_reliable),
            )
        return topics

    def subscribe(self, topic: transport.Topic, take: transport.Take) -> None:
        """Call a function with every message of a topic from now on."""
        reader = _Reader(self._participant, topic, take)
        with self._lock:
            self._readers[topic.name] = reader
            self._waits.attach(reader.condition)
        if not self._thread.is_alive():
            self._thread.start()

    def advertise(self, topic: str, kind: str) -> transport.Publish:
        """Announce messages of a type; return what sends them."""
        from cyclonedds._clayer import ddspy_write
        from cyclonedds.pub import DataWriter
        from cyclonedds.topic import Topic as DdsTopic

        dds_topic = DdsTopic(self._participant, f"{_PREFIX}{topic}", dds_type(kind))
        writer = DataWriter(self._participant, dds_topic, qos=_quality(kind, is_reliable=True))
        self._writers[topic] = writer

        def publish(data: bytes) -> None:
            # a reader that does not keep up misses messages; KeepLast says so
            ddspy_write(writer._ref, data + bytes(-len(data) % 4))

        return publish

    def subscribers(self, topic: str) -> int:
        """Return how many listen to an advertised topic."""
        return len(self._writers[topic].get_matched_subscriptions())

    def close(self) -> None:
        """End the thread, and leave the domain."""
        self._is_closed = True
        if self._thread.is_alive():
            self._thread.join()
        with self._lock:
            for reader in self._readers.values():
                self._waits.detach(reader.condition)
            self._readers.clear()
            self._writers.clear()
        del self._waits, self._publications, self._participant, self._domain

    def _receive(self) -> None:
        """Take messages as they come; the thread does nothing else, so that none is lost."""
        from cyclonedds.util import duration

        timeout, check_s = duration(milliseconds=_WAIT_MS), time.monotonic() + _CHECK_EVERY_S
        while not self._is_closed:
            self._waits.wait(timeout)
            with self._lock:
                readers = list(self._readers.values())
            for reader in readers:
                reader.take_all()
            if time.monotonic() >= check_s:
                check_s = time.monotonic() + _CHECK_EVERY_S
                self._follow_publishers()

    def _follow_publishers(self) -> None:
        """Ask for best effort where publishers have come that offer nothing else."""
        topics = self.topics()
        for reader in list(self._readers.values()):
            topic = topics.get(reader.topic.name)
            if topic is None or topic.is_reliable or not reader.topic.is_reliable:
                continue
            follower = _Reader(self._participant, topic, reader.take)
            with self._lock:
                self._waits.detach(reader.condition)
                self._readers[topic.name] = follower
                self._waits.attach(follower.condition)


class _Reader:
    """Takes the messages of one topic as bytes."""

    def __init__(self, participant: Any, topic: transport.Topic, take: transport.Take) -> None:
        from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState
        from cyclonedds.sub import DataReader
        from cyclonedds.topic import Topic as DdsTopic

        self.topic, self.take = topic, take
        dds_topic = DdsTopic(participant, f"{_PREFIX}{topic.name}", dds_type(topic.type))
        quality = _quality(topic.type, is_reliable=topic.is_reliable)
        self._reader: Any = DataReader(participant, dds_topic, qos=quality)
        any_state = ViewState.Any | InstanceState.Any
        self._mask = SampleState.Any | any_state
        self.condition = ReadCondition(self._reader, SampleState.NotRead | any_state)

    def take_all(self) -> None:
        """Hand on what has arrived."""
        from cyclonedds._clayer import ddspy_take

        messages = ddspy_take(self._reader._ref, self._mask, _LARGEST_TAKE)
        if isinstance(messages, int):
            return  # an error of DDS: what has arrived stays for the next time
        for data, info in messages:
            if info.valid_data:
                self.take(data)


def _quality(kind: str, *, is_reliable: bool) -> Any:
    from cyclonedds.qos import Policy, Qos
    from cyclonedds.util import duration

    reliable = Policy.Reliability.Reliable(duration(milliseconds=_BLOCK_MS))
    return Qos(
        reliable if is_reliable else Policy.Reliability.BestEffort,
        Policy.History.KeepLast(_DEPTHS.get(kind, _DEPTH)),
        Policy.Durability.Volatile,
        Policy.DataRepresentation(use_cdrv0_representation=True),
        Policy.Userdata(f"typehash={type_hash(kind)};".encode()),
    )


def _configuration(network: options.NetworkOptions) -> str:
    """Return Cyclone's configuration; the user's own (CYCLONEDDS_URI) is read after it and wins."""
    address = transport.listening_address(network)
    is_local = address == transport.LOOPBACK
    peers = [transport.LOOPBACK] if is_local else []
    peers += [peer for peer in os.environ.get("ROS_STATIC_PEERS", "").split(";") if peer]
    listed = "".join(f'<Peer Address="{peer}"/>' for peer in peers)
    multicast = "false" if is_local else "default"
    configuration = (
        '<CycloneDDS><Domain Id="any"><General><Interfaces>'
        f'<NetworkInterface address="{address}" multicast="{multicast}"/></Interfaces>'
        f"{'<AllowMulticast>false</AllowMulticast>' if is_local else ''}</General>"
        "<Discovery><ParticipantIndex>auto</ParticipantIndex>"
        f"<MaxAutoParticipantIndex>{_MAX_PARTICIPANTS}</MaxAutoParticipantIndex>"
        f"<Peers>{listed}</Peers></Discovery>"
        # a least size that the kernel refuses would end the domain
        f'<Internal><SocketReceiveBufferSize max="{transport.SOCKET_BYTES} B"/>'
        f"<MaxSampleSize>{transport.MAX_MESSAGE_BYTES} B</MaxSampleSize></Internal>"
        f"<Compatibility><IgnoreTypeInformation>{_FAST_DDS}</IgnoreTypeInformation></Compatibility>"
        "</Domain></CycloneDDS>"
    )
    given = os.environ.get("CYCLONEDDS_URI", "")
    return f"{configuration},{given}" if given else configuration


def _socket_problems() -> list[str]:
    """Return a warning where the kernel's limit of receive buffers loses images."""
    if not _RECEIVE_LIMIT.exists():
        return []
    limit = int(_RECEIVE_LIMIT.read_text())
    if limit >= _ENOUGH_SOCKET_BYTES:
        return []
    return [
        f"receive buffers are limited to {limit} bytes, so images will be lost: "
        f"`{transport.RAISE_RECEIVE_BUFFERS}`, or publish compressed images"
    ]
