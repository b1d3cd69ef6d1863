"""A connection without a network, a small device, and a small master of ROS 1."""

import contextlib
import dataclasses
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from xmlrpc.server import SimpleXMLRPCServer

import numpy as np

from maplab_py.interop.bags.sensor_messages import IMAGE, MessageMaker
from maplab_py.interop.calibration_import import import_calibration, read_calibration
from maplab_py.interop.live.options import LiveOptions
from maplab_py.interop.live.source import LiveRecording
from maplab_py.interop.live.transport import Publish, Take, Topic
from maplab_py.interop.recordings import protocol
from maplab_py.interop.recordings.options import SourceOptions
from tests.interop.recordings.written import Content, make_content, write_calibration, write_folder

IMU = "sensor_msgs/msg/Imu"
TOPICS = (Topic("/imu0", IMU), Topic("/cam0/image_raw", IMAGE), Topic("/cam1/image_raw", IMAGE))


class FakeTransport:
    """Topics that a test sends to."""

    name = "fake robot"

    def __init__(self, topics: tuple[Topic, ...] = TOPICS, *, is_ros_2: bool = True) -> None:
        self.is_ros_2 = is_ros_2
        self.problems: list[str] = []
        self.published: dict[str, list[bytes]] = {}
        self._topics = {topic.name: topic for topic in topics}
        self._takes: dict[str, Take] = {}

    def topics(self) -> dict[str, Topic]:
        return self._topics

    def subscribe(self, topic: Topic, take: Take) -> None:
        self._takes[topic.name] = take

    def advertise(self, topic: str, kind: str) -> Publish:
        self.published[topic] = []
        return self.published[topic].append

    def subscribers(self, topic: str) -> int:
        return 1

    def close(self) -> None:
        self._takes.clear()

    def send(self, topic: str, data: bytes) -> None:
        """Let a message arrive."""
        self._takes[topic](data)


def small_device(folder: Path) -> protocol.RecordedSensors:
    """The calibration of the small recording, with topics."""
    room = write_folder(make_content(frames=1), folder / "room")
    calibration = import_calibration(room / "mav0")
    return read_calibration(write_calibration(calibration, folder / "sensors.yaml"))


def gravity(content: Content) -> Content:
    """The recording with an accelerometer that shows gravity."""
    samples = 0.01 * content.accel_gyro
    samples[:, 2] += 9.81
    return dataclasses.replace(content, accel_gyro=samples)


def messages_of(content: Content, *, is_ros_2: bool = True) -> list[tuple[int, str, bytes]]:
    """Return (stamp_ns, topic, message) in the order of the stamps."""
    maker = MessageMaker(is_ros_2=is_ros_2)
    imu = maker.imu(content.imu_ns, content.accel_gyro, "imu")
    messages = [(int(t), "/imu0", m) for t, m in zip(content.imu_ns, imu, strict=True)]
    for camera, (stamps_ns, images) in enumerate(
        zip(content.stamps_ns, content.images, strict=True)
    ):
        for stamp_ns, image in zip(stamps_ns.tolist(), images, strict=True):
            data = maker.image(stamp_ns, f"cam{camera}", image)
            messages.append((stamp_ns, f"/cam{camera}/image_raw", data))
    return sorted(messages, key=lambda message: message[:2])


def live(
    transport: Any,
    device: protocol.RecordedSensors,
    source: SourceOptions | None = None,
    options: LiveOptions | None = None,
    *,
    wait_s: float = 0.2,
    tell: Callable[[str], None] = lambda _: None,
) -> LiveRecording:
    """Open a live recording that receives from now on, and ends soon after the last message."""
    recording = LiveRecording(
        transport,
        device,
        source or SourceOptions(),
        options or LiveOptions(silence_s=0.3),
        wait_s=wait_s,
        tolerance_ns=500_000,
        tell=tell,
    )
    recording.subscribe()
    return recording


class SmallMaster:
    """The part of a ROS 1 master that publishers and subscribers need."""

    def __init__(self, port: int = 0) -> None:
        self._types: dict[str, str] = {}
        self._publishers: dict[str, dict[str, str]] = {}
        self._server = SimpleXMLRPCServer(("127.0.0.1", port), logRequests=False, allow_none=True)
        self.port = self._server.server_address[1]
        self.uri = f"http://127.0.0.1:{self.port}"
        for name in (
            "getTopicTypes",
            "getSystemState",
            "registerPublisher",
            "registerSubscriber",
            "unregisterPublisher",
            "unregisterSubscriber",
        ):
            self._server.register_function(getattr(self, name), name)
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def getTopicTypes(self, _caller: str) -> list[Any]:
        return [1, "", [list(entry) for entry in self._types.items()]]

    def getSystemState(self, _caller: str) -> list[Any]:
        nodes = [[topic, list(nodes)] for topic, nodes in self._publishers.items() if nodes]
        return [1, "", [nodes, [], []]]

    def registerPublisher(self, caller: str, topic: str, kind: str, api: str) -> list[Any]:
        self._types[topic] = kind
        self._publishers.setdefault(topic, {})[caller] = api
        return [1, "", []]

    def registerSubscriber(self, _caller: str, topic: str, _kind: str, _api: str) -> list[Any]:
        return [1, "", list(self._publishers.get(topic, {}).values())]

    def unregisterPublisher(self, caller: str, topic: str, _api: str) -> list[Any]:
        self._publishers.get(topic, {}).pop(caller, None)
        return [1, "", 1]

    def unregisterSubscriber(self, _caller: str, _topic: str, _api: str) -> list[Any]:
        return [1, "", 1]

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()


@contextlib.contextmanager
def small_master(port: int = 0) -> Iterator[SmallMaster]:
    """Run a master for a block."""
    master = SmallMaster(port)
    try:
        yield master
    finally:
        master.close()


def imu_message(stamp_ns: int, *, is_ros_2: bool, accel: float = 9.81) -> bytes:
    """Return a message of an IMU at rest."""
    samples = np.array([[0.0, 0.0, accel, 0.0, 0.0, 0.0]])
    return MessageMaker(is_ros_2=is_ros_2).imu(np.array([stamp_ns]), samples, "imu")[0]
