"""ROS 1 and ROS 2 bags, read with the library rosbags (the extra `bags`).

A bag is in the order in which messages arrived; items are yielded in the order of their
headers' stamps, as messages of one topic are. So some seconds of messages are kept.
"""

from __future__ import annotations

import contextlib
import dataclasses
import heapq
import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from maplab_py.array_types import F64
from maplab_py.errors import MapError, UserError
from maplab_py.interop.images import CONTAINER_BITS, SAMPLES
from maplab_py.interop.recordings.bag_files import (
    header_stamp_ns,
    imu_sample,
    listed_topics,
    opened_bag,
    topic_types,
)
from maplab_py.interop.recordings.images import bits_note, camera_bits, image_of_message
from maplab_py.interop.recordings.protocol import (
    CameraImage,
    ImuBatch,
    Item,
    RecordedSensors,
)

if TYPE_CHECKING:
    from maplab_py.interop.recordings.bag_files import BagReader

IMU_TYPE = "sensor_msgs/msg/Imu"
IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_IMU = -1
_LARGEST_BATCH = 200
_DELAY_MARGIN_NS = 1_000_000_000
"""How much the delay between stamp and arrival may vary beyond that of the first messages."""
_SEEK_MARGIN_NS = 5_000_000_000


@dataclasses.dataclass(frozen=True)
class _Stream:
    """One topic: the IMU's, or that of a camera."""

    topic: str
    camera: int  # row, or _IMU
    time_offset_ns: int = 0
    first_ns: int = 0  # time of the first message
    delay_ns: int = 0  # from its time to its arrival


class BagRecording:
    """Reads a bag."""

    def __init__(
        self,
        path: Path,
        device: RecordedSensors,
        *,
        imu_topic: str = "",
        camera_topics: Sequence[str] = (),
        image_bits: int = 0,
    ) -> None:
        """Open a bag.

        Args:
            path: ROS 1 bag, or file or folder of a ROS 2 bag.
            device: Sensors.
            imu_topic: Topic of the IMU; empty = as the sensor says.
            camera_topics: Topic of each camera; () = as the cameras say.
            image_bits: Bits of values that are stored in 16; 0 = found.

        Raises:
            UserError: The library is missing, or a topic is unknown, of another type, or not given.
            MapError: The bag is damaged, or a topic has no messages.
        """
        self.name, self.device, self._path = str(path), device, path
        self._given_bits, self._bits = image_bits, [CONTAINER_BITS] * len(device.cameras)
        topics = tuple(camera_topics) or tuple(camera.topic for camera in device.cameras)
        if len(topics) != len(device.cameras):
            raise UserError(
                f"--camera_topics names {len(topics)} topics, {len(device.cameras)} cameras are read"
            )
        streams = [
            _Stream(topic, row, device.cameras[row].time_offset_ns)
            for row, topic in enumerate(topics)
        ]
        if device.imu is not None:
            streams.insert(0, _Stream(imu_topic or device.imu.topic, _IMU))
        elif imu_topic:
            raise UserError(f"--imu_topic={imu_topic}: the calibration has no IMU")
        with opened_bag(self._path) as reader:
            self.kind = f"ROS {2 if reader.is2 else 1} bag"
            self._streams = [self._examined(reader, stream) for stream in streams]
        if len({stream.topic for stream in self._streams}) < len(self._streams):
            raise UserError(f"{path}: two sensors have the same topic: give --camera_topics")

    @property
    def notes(self) -> tuple[str, ...]:
        """Parts of the recording that are not read, and how the others are."""
        notes = [bits_note(c, bits) for c, bits in enumerate(self._bits) if bits < CONTAINER_BITS]
        if not self.device.imu_id:
            notes.append(
                "no IMU is read: the calibration has none, --imu_calibration_file names its file"
            )
        return tuple(notes)

    @property
    def start_ns(self) -> int:
        """Time of the first item."""
        return min(stream.first_ns for stream in self._streams)

    def items(self, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Item]:
        """Yield images and the IMU samples between them; see `Recording.items`."""
        read_bits = self._read_bits(start_ns, end_ns)
        times_ns: list[int] = []
        samples: list[tuple[float, ...]] = []
        for time_ns, stream, message in self._in_order(start_ns, end_ns):
            if stream.camera == _IMU:
                times_ns.append(time_ns)
                samples.append(message)
            if times_ns and (stream.camera != _IMU or len(times_ns) == _LARGEST_BATCH):
                yield self._batch(times_ns, samples)
                times_ns, samples = [], []
            if stream.camera != _IMU:
                yield self._image(stream, time_ns, message, read_bits[stream.camera])
        if times_ns:
            yield self._batch(times_ns, samples)

    def _read_bits(self, start_ns: int | None, end_ns: int | None) -> list[int]:
        """Return the bits of each camera, sought in messages that are spread over a time."""
        cameras = [stream for stream in self._streams if stream.camera != _IMU]
        read: list[int] = []
        with opened_bag(self._path) as reader:
            first_ns = reader.start_time if start_ns is None else start_ns
            last_ns = reader.end_time if end_ns is None else min(end_ns, reader.end_time)
            for stream in cameras:
                connections = [c for c in reader.connections if c.topic == stream.topic]
                images: list[CameraImage] = []
                for place_ns in np.linspace(first_ns, last_ns, SAMPLES, endpoint=False).tolist():
                    message = next(reader.messages(connections, int(place_ns)), None)
                    if message is None or self._given_bits:
                        break
                    content = reader.deserialize(message[2], message[0].msgtype)
                    images.append(self._image(stream, int(place_ns), content, CONTAINER_BITS))
                    with contextlib.suppress(MapError):
                        if images[0].data.bits:
                            break
                bits = self._given_bits or camera_bits(images)
                self._bits[stream.camera] = (
                    CONTAINER_BITS if bits == 8 or self._given_bits else bits
                )
                read.append(bits)
        return read

    def _in_order(
        self, start_ns: int | None, end_ns: int | None
    ) -> Iterator[tuple[int, _Stream, Any]]:
        """Yield time, stream and message in the order of time, the IMU's first among equals."""
        delays_ns = [stream.delay_ns for stream in self._streams]
        window_ns = max(delays_ns) - min(delays_ns) + _DELAY_MARGIN_NS
        waiting: list[tuple[int, int, int, _Stream, Any]] = []
        newest_ns = delivered_ns = -1
        number = itertools.count()
        for time_ns, stream, message in self._messages(start_ns, end_ns):
            if time_ns < delivered_ns:
                raise MapError(
                    f"{self._path}: a message of {stream.topic} was recorded more than "
                    f"{window_ns / 1e9:g} s after others of its time: correct its header stamps"
                )
            heapq.heappush(waiting, (time_ns, stream.camera, next(number), stream, message))
            newest_ns = max(newest_ns, time_ns)
            while waiting[0][0] < newest_ns - window_ns:
                delivered_ns, _, _, ready, content = heapq.heappop(waiting)
                yield delivered_ns, ready, content
        while waiting:
            delivered_ns, _, _, ready, content = heapq.heappop(waiting)
            yield delivered_ns, ready, content

    def _messages(
        self, start_ns: int | None, end_ns: int | None
    ) -> Iterator[tuple[int, _Stream, Any]]:
        """Yield time, stream and message in the order of arrival."""
        delays_ns = [stream.delay_ns for stream in self._streams]
        begin = None if start_ns is None else start_ns + min(delays_ns) - _SEEK_MARGIN_NS
        end = None if end_ns is None else end_ns + max(delays_ns) + _SEEK_MARGIN_NS
        streams = {stream.topic: stream for stream in self._streams}
        last_ns = dict.fromkeys(streams, -1)
        with opened_bag(self._path) as reader:
            connections = [c for c in reader.connections if c.topic in streams]
            for connection, _, data in reader.messages(connections, begin, end):
                stream = streams[connection.topic]
                time_ns = header_stamp_ns(data, is_ros_2=reader.is2) + stream.time_offset_ns
                message: Any
                if stream.camera == _IMU:
                    message = imu_sample(data, is_ros_2=reader.is2)
                else:
                    message = reader.deserialize(data, connection.msgtype)
                if time_ns <= last_ns[stream.topic]:
                    raise MapError(
                        f"{self._path}: {stream.topic}: the stamp "
                        f"{time_ns - stream.time_offset_ns} does not come after that of the message "
                        "before it: correct it, or leave it out with --vio_rosbag_start_s and "
                        "--vio_rosbag_end_s"
                    )
                last_ns[stream.topic] = time_ns
                if (start_ns is None or time_ns >= start_ns) and (
                    end_ns is None or time_ns < end_ns
                ):
                    yield time_ns, stream, message

    def _examined(self, reader: BagReader, stream: _Stream) -> _Stream:
        """Return the stream with the bag's name of its topic and the times of its first message."""
        sensor = "IMU" if stream.camera == _IMU else f"camera {stream.camera}"
        flag = "--imu_topic" if stream.camera == _IMU else "--camera_topics"
        types = topic_types(reader)
        present = listed_topics(types)
        if not stream.topic:
            raise UserError(
                f"{self._path}: the calibration names no topic of {sensor}: give {flag}; the bag "
                f"has {present}"
            )
        topic = next((t for t in types if t.strip("/") == stream.topic.strip("/")), None)
        if topic is None:
            raise UserError(
                f"{self._path}: there is no topic {stream.topic} ({sensor}): give {flag}; the bag "
                f"has {present}"
            )
        wanted = (IMU_TYPE,) if stream.camera == _IMU else IMAGE_TYPES
        if types[topic] not in wanted:
            raise UserError(
                f"{self._path}: {topic} has messages of type {types[topic]}, {sensor} needs "
                f"{' or '.join(wanted)}: give {flag}; the bag has {present}"
            )
        connections = [c for c in reader.connections if c.topic == topic]
        for _, arrival_ns, data in reader.messages(connections):
            first_ns = header_stamp_ns(data, is_ros_2=reader.is2) + stream.time_offset_ns
            delay_ns = arrival_ns - first_ns
            return dataclasses.replace(stream, topic=topic, first_ns=first_ns, delay_ns=delay_ns)
        raise MapError(f"{self._path}: the recording is empty: {topic} has no messages")

    def _batch(self, times_ns: list[int], samples: list[tuple[float, ...]]) -> ImuBatch:
        assert self.device.imu is not None  # its topic is read
        values: F64 = np.array(samples, dtype=np.float64)
        if not np.isfinite(values).all():
            row = int(np.flatnonzero(~np.isfinite(values).all(axis=1))[0])
            raise MapError(
                f"{self._path}: {self._streams[0].topic}: the sample at {times_ns[row]} is not a "
                "number: leave it out with --vio_rosbag_start_s and --vio_rosbag_end_s"
            )
        return ImuBatch.of(self.device.imu, np.array(times_ns, dtype=np.int64), values)

    def _image(self, stream: _Stream, time_ns: int, message: Any, bits: int) -> CameraImage:
        stamp_ns = time_ns - stream.time_offset_ns
        camera = self.device.cameras[stream.camera]
        name = f"{self._path}: {stream.topic} at {stamp_ns}"
        data = image_of_message(message, name, camera)
        return CameraImage(stream.camera, time_ns, stamp_ns, data, bits)
