"""Server of foxglove-sdk: plays frames and samples, listens to the poses, prints what it saw.

Runs in an environment of its own, not in that of the tests.
"""

import struct
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
    """Counts subscriptions, and hands on the poses that a client sends."""

    def __init__(self, player: events.Player) -> None:
        self._player = player
        self._topics: dict[int, str] = {}
        self.subscriptions = 0
        self.last = b""

    def on_subscribe(self, client: Any, channel: Any) -> None:
        self.subscriptions += 1

    def on_client_advertise(self, client: Any, channel: Any) -> None:
        self._topics[channel.id] = channel.topic

    def on_message_data(self, client: Any, client_channel_id: int, data: bytes) -> None:
        if self._topics.get(client_channel_id) == "/maplab/odometry":
            seconds, rest = struct.unpack_from("<iI", data, 4)
            self._player.take(seconds * 10**9 + rest)
            self.last = bytes(data)


def main() -> None:
    player = events.Player(events.options())
    listener = Listener(player)
    server = foxglove.start_server(
        host="127.0.0.1",
        port=PORT,
        capabilities=[Capability.ClientPublish],
        server_listener=listener,
        supported_encodings=["cdr"],
    )
    channels = {-1: _channel("/imu0", IMU)}
    for camera in player.cameras:
        channels[camera] = _channel(f"/cam{camera}/image_raw", IMAGE)

    def send(stamp_ns: int, sensor: int, content: Any) -> None:
        channels[sensor].log(_message(stamp_ns, sensor, content), log_time=stamp_ns)

    player.play(lambda: listener.subscriptions >= len(channels), send)
    frames = []
    if listener.last:
        odometry = STORE.deserialize_cdr(listener.last, "nav_msgs/msg/Odometry")
        frames = [odometry.header.frame_id, odometry.child_frame_id]
    player.report(frames=frames)
    server.stop()


def _channel(topic: str, kind: str) -> Channel:
    definition = STORE.generate_msgdef(kind, ros_version=2)[0].encode()
    schema = Schema(name=kind, encoding="ros2msg", data=definition)
    return Channel(topic, message_encoding="cdr", schema=schema)


def _message(stamp_ns: int, sensor: int, content: Any) -> bytes:
    stamp = STORE.types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9))
    header = STORE.types["std_msgs/msg/Header"](stamp, "sensor")
    if sensor < 0:
        vector = STORE.types["geometry_msgs/msg/Vector3"]
        quaternion = STORE.types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
        values, unknown = list(map(float, content)), np.zeros(9)
        accel, gyro = vector(*values[:3]), vector(*values[3:])
        fields = (header, quaternion, unknown, gyro, unknown, accel, unknown)
        return bytes(STORE.serialize_cdr(STORE.types[IMU](*fields), IMU))
    height, width = content.shape
    fields = (header, height, width, "mono8", 0, width, content.reshape(-1))
    return bytes(STORE.serialize_cdr(STORE.types[IMAGE](*fields), IMAGE))


if __name__ == "__main__":
    main()
