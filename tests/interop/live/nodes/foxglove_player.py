"""Server of foxglove-sdk: plays frames and samples, listens to the poses, prints what it saw.

Runs in an environment of its own, not in that of the tests.
"""

from __future__ import annotations

import argparse
import json
import struct
import time
from pathlib import Path
from typing import Any

import events
import foxglove
import numpy as np
from foxglove import Channel, Schema
from foxglove.websocket import Capability, ServerListener
from rosbags.typesys import Stores, get_typestore

PORT = 8765
IMU, IMAGE = "sensor_msgs/msg/Imu", "sensor_msgs/msg/Image"
STORE = get_typestore(Stores.ROS2_JAZZY)


class Listener(ServerListener):
    """Counts subscriptions, and keeps the poses that a client sends."""

    def __init__(self) -> None:
        self.subscriptions = 0
        self.topics: dict[int, str] = {}
        self.odometry: list[bytes] = []
        self.sent_s: dict[int, float] = {}
        self.latencies_ms: list[float] = []

    def on_subscribe(self, client: Any, channel: Any) -> None:
        self.subscriptions += 1

    def on_client_advertise(self, client: Any, channel: Any) -> None:
        self.topics[channel.id] = channel.topic

    def on_message_data(self, client: Any, client_channel_id: int, data: bytes) -> None:
        if self.topics.get(client_channel_id) != "/maplab/odometry":
            return
        seconds, rest = struct.unpack_from("<iI", data, 4)
        stamp_ns = seconds * 10**9 + rest
        if stamp_ns in self.sent_s:
            self.latencies_ms.append(1e3 * (time.monotonic() - self.sent_s[stamp_ns]))
        self.odometry.append(bytes(data))


def header(stamp_ns: int) -> Any:
    time_type = STORE.types["builtin_interfaces/msg/Time"]
    return STORE.types["std_msgs/msg/Header"](time_type(*divmod(stamp_ns, 10**9)), "sensor")


def message_of(stamp_ns: int, sensor: int, content: Any) -> bytes:
    if sensor < 0:
        vector = STORE.types["geometry_msgs/msg/Vector3"]
        quaternion = STORE.types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
        values, unknown = list(map(float, content)), np.zeros(9)
        accel, gyro = vector(*values[:3]), vector(*values[3:])
        fields = (header(stamp_ns), quaternion, unknown, gyro, unknown, accel, unknown)
        return bytes(STORE.serialize_cdr(STORE.types[IMU](*fields), IMU))
    height, width = content.shape
    pixels = content.reshape(-1)
    fields = (header(stamp_ns), height, width, "mono8", 0, width, pixels)
    return bytes(STORE.serialize_cdr(STORE.types[IMAGE](*fields), IMAGE))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("recording", type=Path)
    parser.add_argument("--rate", type=float, default=1.0)
    options = parser.parse_args()
    recorded = events.load(options.recording)
    listener = Listener()
    server = foxglove.start_server(
        host="127.0.0.1",
        port=PORT,
        capabilities=[Capability.ClientPublish],
        server_listener=listener,
        supported_encodings=["cdr"],
    )
    channels = {}
    for sensor, topic in ((-1, "/imu0"), (0, "/cam0/image_raw"), (1, "/cam1/image_raw")):
        kind = IMU if sensor < 0 else IMAGE
        definition = STORE.generate_msgdef(kind, ros_version=2)[0].encode()
        schema = Schema(name=kind, encoding="ros2msg", data=definition)
        channels[sensor] = Channel(topic, message_encoding="cdr", schema=schema)
    deadline_s = time.monotonic() + 60.0
    while time.monotonic() < deadline_s and listener.subscriptions < len(channels):
        time.sleep(0.05)
    time.sleep(1.0)  # both sides know of each other
    sent = dict.fromkeys(channels, 0)
    for stamp_ns, sensor, content in events.paced(recorded, options.rate):
        data = message_of(stamp_ns, sensor, content)
        listener.sent_s[stamp_ns] = time.monotonic()
        channels[sensor].log(data, log_time=stamp_ns)
        sent[sensor] += 1
    events.wait_while_growing(listener.odometry)
    report = {
        "sent": {str(sensor): count for sensor, count in sent.items()},
        "odometry": len(listener.odometry),
        "latency_ms": sorted(listener.latencies_ms),
    }
    if listener.odometry:
        names = STORE.deserialize_cdr(listener.odometry[-1], "nav_msgs/msg/Odometry")
        report["frames"] = [names.header.frame_id, names.child_frame_id]
    print(json.dumps(report), flush=True)
    server.stop()


if __name__ == "__main__":
    main()
