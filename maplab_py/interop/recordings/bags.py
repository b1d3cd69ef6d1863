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

from maplab_py.errors import MapError, UserError
from maplab_py.interop.images import CONTAINER_BITS, SAMPLES
from maplab_py.interop.recordings import bag_files, clocks
from maplab_py.interop.recordings.images import bits_note, camera_bits, image_of_message
from maplab_py.interop.recordings.options import ReadingOptions
from maplab_py.interop.recordings.paired_imu import ACCEL, GYRO, PairedImu
from maplab_py.interop.recordings.protocol import (
    CameraImage,
    ImuBatch,
    Item,
    PartSpan,
    RecordedSensors,
)

if TYPE_CHECKING:
    from maplab_py.interop.recordings.bag_files import BagReader

IMU_TYPE = "sensor_msgs/msg/Imu"
IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_EXAMINED = 8
"""Messages of a topic, at most, from which its clock is known."""
_DEFAULT = ReadingOptions()
_LARGEST_BATCH = 200
_DELAY_MARGIN_NS = 1_000_000_000
"""Largest variation of the delay between stamp and arrival beyond that of the first messages."""
_SEEK_MARGIN_NS = 5_000_000_000


class BagRecording:
    """Reads a bag."""

    def __init__(
        self,
        path: Path,
        device: RecordedSensors,
        *,
        imu_topics: Sequence[str] = (),
        camera_topics: Sequence[str] = (),
        reading: ReadingOptions = _DEFAULT,
    ) -> None:
        """Open a bag.

        Args:
            path: ROS 1 bag, or file or folder of a ROS 2 bag.
            imu_topics: Topic of the IMU, or those of gyroscope and accelerometer; () = as the sensor says.
            camera_topics: Topic of each camera; () = as the cameras say.

        Raises:
            UserError: The library is missing, or a topic is unknown, of another type, or not given.
            MapError: The bag is damaged, or a topic has no messages.
        """
        self.name, self.device, self._path, self._reading = str(path), device, path, reading
        self._bits = [CONTAINER_BITS] * len(device.cameras)
        # width and height of the first image of cameras, where it can be read
        self.first_sizes_px: dict[int, tuple[int, int]] = {}
        self._clocks: list[clocks.ClockFilter[Any]] = []
        self._is_apart = False
        topics = tuple(camera_topics) or tuple(camera.topic for camera in device.cameras)
        if len(topics) != len(device.cameras):
            raise UserError(
                f"--camera_topics names {len(topics)} topics, {len(device.cameras)} cameras are read"
            )
        streams = [
            bag_files.TopicStream(topic, row, device.cameras[row].time_offset_ns)
            for row, topic in enumerate(topics)
        ]
        if device.imu is not None:
            named = zip(
                imu_topics or (device.imu.topic,),
                (bag_files.IMU, bag_files.ACCELEROMETER),
                strict=False,
            )
            streams = [*(bag_files.TopicStream(topic, sensor) for topic, sensor in named), *streams]
        elif imu_topics:
            raise UserError(f"--imu_topic={','.join(imu_topics)}: the calibration has no IMU")
        with bag_files.opened_bag(self._path) as reader:
            self.kind = f"ROS {2 if reader.is2 else 1} bag"
            self._arrivals_ns = reader.start_time, reader.end_time
            self._streams = [self._examined(reader, stream) for stream in streams]
        if len({stream.topic for stream in self._streams}) < len(self._streams):
            raise UserError(f"{path}: two sensors have the same topic: give --camera_topics")
        if reading.recording_part:
            self._choose_part(reading.recording_part)

    @property
    def notes(self) -> tuple[str, ...]:
        """Parts of the recording that are not read, and how the others are."""
        notes = [bits_note(c, bits) for c, bits in enumerate(self._bits) if bits < CONTAINER_BITS]
        notes += [
            clocks.dropped_note(f"{self._path}: {stream.topic}", clock.dropped, clock.first)
            for stream, clock in zip(self._streams, self._clocks, strict=False)
            if clock.dropped
        ]
        if self._reading.use_arrival_time:
            notes.append("times are those of arrival: --use_arrival_time")
        if not self.device.imu_id:
            notes.append(
                "no IMU is read: the calibration has none, --imu_calibration_file names its file"
            )
        return tuple(notes)

    @property
    def start_ns(self) -> int:
        """Time of the first item."""
        return min(stream.first_ns for stream in self._streams)

    @property
    def end_ns(self) -> int:
        """Approximate time of the last item; not known if the clock restarts."""
        first_ns, last_ns = self._arrivals_ns
        return 0 if self._reading.recording_part else self.start_ns + last_ns - first_ns

    def parts(self) -> tuple[PartSpan, ...]:
        """Return the parts into which restarts of the clock divide the recording; reads all stamps."""
        runs = self._runs()
        spans = []
        for part in range(max(len(of_stream) for of_stream in runs)):
            having = [
                (stream, of_stream[part])
                for stream, of_stream in zip(self._streams, runs, strict=True)
                if part < len(of_stream)
            ]
            first_ns, last_ns = (
                min(run.first_ns for _, run in having),
                max(run.last_ns for _, run in having),
            )
            images = sum(run.count for stream, run in having if stream.camera >= 0)
            samples = sum(run.count for stream, run in having if stream.camera == bag_files.IMU)
            duration_s = (last_ns - first_ns) * 1e-9
            spans.append(PartSpan(part + 1, first_ns, duration_s, samples, images))
        return tuple(spans)

    def items(self, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Item]:
        """Yield images and the IMU samples between them; see `Recording.items`."""
        with bag_files.opened_bag(self._path) as reader:
            yield from self._items(reader, start_ns, end_ns)

    def _items(self, reader: BagReader, start_ns: int | None, end_ns: int | None) -> Iterator[Item]:
        read_bits = self._read_bits(reader, start_ns, end_ns)
        times_ns: list[int] = []
        samples: list[tuple[float, ...]] = []
        for time_ns, stream, message in self._in_order(reader, start_ns, end_ns):
            if stream.camera == bag_files.IMU:
                times_ns.append(time_ns)
                samples.append(message)
            if times_ns and (stream.camera != bag_files.IMU or len(times_ns) == _LARGEST_BATCH):
                yield from self._batch(times_ns, samples)
                times_ns, samples = [], []
            if stream.camera != bag_files.IMU:
                yield self._image(stream, time_ns, message, read_bits[stream.camera])
        if times_ns:
            yield from self._batch(times_ns, samples)

    def _read_bits(self, reader: BagReader, start_ns: int | None, end_ns: int | None) -> list[int]:
        """Return the bits of each camera, sought in messages that are spread over a time."""
        given = self._reading.image_bits
        if given:
            return [given] * len(self.device.cameras)
        first_ns = reader.start_time if start_ns is None else start_ns
        last_ns = reader.end_time if end_ns is None else min(end_ns, reader.end_time)
        places_ns = np.linspace(first_ns, last_ns, SAMPLES, endpoint=False, dtype=np.int64).tolist()
        read: list[int] = []
        for stream in (stream for stream in self._streams if stream.camera >= 0):
            bits = camera_bits(self._images_at(reader, stream, places_ns))
            self._bits[stream.camera] = CONTAINER_BITS if bits == 8 else bits
            read.append(bits)
        return read

    def _images_at(
        self, reader: BagReader, stream: bag_files.TopicStream, places_ns: list[int]
    ) -> Iterator[CameraImage]:
        """Yield the first image of a camera after each of some times of arrival."""
        connections = [c for c in reader.connections if c.topic == stream.topic]
        for place_ns in places_ns:
            message = next(reader.messages(connections, place_ns), None)
            if message is None:
                return
            content = reader.deserialize(message[2], message[0].msgtype)
            yield self._image(stream, place_ns, content, CONTAINER_BITS)

    def _in_order(
        self, reader: BagReader, start_ns: int | None, end_ns: int | None
    ) -> Iterator[tuple[int, bag_files.TopicStream, Any]]:
        """Yield time, stream and message in the order of time, the IMU's first among equals."""
        delays_ns = [stream.delay_ns for stream in self._streams]
        window_ns = max(delays_ns) - min(delays_ns) + _DELAY_MARGIN_NS
        waiting: list[tuple[int, int, int, bag_files.TopicStream, Any]] = []
        newest_ns = delivered_ns = -1
        number = itertools.count()
        restart: clocks.ClockRestart | None = None
        messages = self._messages(reader, start_ns, end_ns)
        while True:
            try:
                time_ns, stream, message = next(messages)
            except StopIteration:
                break
            except clocks.ClockRestart as error:
                restart = error
                break
            if time_ns < delivered_ns:
                clock = self._clocks[self._streams.index(stream)]
                clock.leave_out(time_ns, delivered_ns)
                self._check_late(stream, clock)
                continue
            heapq.heappush(waiting, (time_ns, stream.camera, next(number), stream, message))
            newest_ns = max(newest_ns, time_ns)
            while waiting[0][0] < newest_ns - window_ns:
                delivered_ns, _, _, ready, content = heapq.heappop(waiting)
                yield delivered_ns, ready, content
        while waiting:
            delivered_ns, _, _, ready, content = heapq.heappop(waiting)
            yield delivered_ns, ready, content
        if restart is not None:
            raise restart

    def _messages(
        self, reader: BagReader, start_ns: int | None, end_ns: int | None
    ) -> Iterator[tuple[int, bag_files.TopicStream, Any]]:
        """Yield time, stream and message in the order of arrival, accelerations with angular rates."""
        delays_ns = [stream.delay_ns for stream in self._streams]
        begin = None if start_ns is None else start_ns + min(delays_ns) - _SEEK_MARGIN_NS
        end = None if end_ns is None else end_ns + max(delays_ns) + _SEEK_MARGIN_NS
        self._clocks = [
            clocks.ClockFilter(None if begin is not None else stream.first_ns)
            for stream in self._streams
        ]
        rows = {s.topic: (s, clock) for s, clock in zip(self._streams, self._clocks, strict=True)}
        is_ros_2, has_stamps = reader.is2, not self._reading.use_arrival_time
        joined = (
            PairedImu(None)
            if any(s.camera == bag_files.ACCELEROMETER for s in self._streams)
            else None
        )
        connections = [c for c in reader.connections if c.topic in rows]
        for connection, arrival_ns, data in reader.messages(connections, begin, end):
            stream, clock = rows[connection.topic]
            bounds = stream.arrivals_ns
            if bounds is not None and not bounds[0] <= arrival_ns <= bounds[1]:
                continue
            stamp_ns = (
                bag_files.header_stamp_ns(data, is_ros_2=is_ros_2) if has_stamps else arrival_ns
            )
            is_image = stream.camera >= 0
            message: Any = connection.msgtype, data
            if not is_image:
                message = bag_files.imu_sample(data, is_ros_2=is_ros_2)
            time_ns = stamp_ns + stream.time_offset_ns
            if clock.passes(time_ns):
                if joined is None and not is_image and start_ns is end_ns is None:  # most messages
                    yield time_ns, stream, message
                    continue
                ready = [(time_ns, message)]
            else:
                part = clock.part
                ready = self._pushed(stream, clock, stamp_ns, message, (start_ns, end_ns))
                if clock.part > part and clock.restart is not None:
                    if end_ns is not None and (clock.restart.before_ns or 0) >= end_ns:
                        return
                    raise clocks.restart_error(f"{self._path}: {stream.topic}", clock.restart)
            for time_ns, content in ready:
                if not clocks.is_within(time_ns, start_ns, end_ns):
                    continue
                if is_image:
                    yield time_ns, stream, reader.deserialize(content[1], content[0])
                elif joined is None:
                    yield time_ns, stream, content
                else:
                    sensor = GYRO if stream.camera == bag_files.IMU else ACCEL
                    for joint_ns, sample in joined.add(sensor, time_ns, content):
                        yield joint_ns, self._streams[0], sample
        for stream, clock in zip(self._streams, self._clocks, strict=True):
            clock.finish()
            self._check_late(stream, clock)

    def _pushed(
        self,
        stream: bag_files.TopicStream,
        clock: clocks.ClockFilter[Any],
        stamp_ns: int,
        message: Any,
        span_ns: tuple[int | None, int | None],
    ) -> list[tuple[int, Any]]:
        """Return the messages that are in line after one out of line; those left out of a span count."""
        dropped = clock.dropped
        ready = clock.push(stamp_ns + stream.time_offset_ns, message)
        if clock.dropped > dropped and not clocks.is_within(stamp_ns, *span_ns):
            clock.dropped = dropped
        elif clock.dropped > dropped:
            self._check_late(stream, clock)
        return ready

    def _stamp_ns(self, data: bytes, arrival_ns: int, *, is_ros_2: bool) -> int:
        is_stamped = not self._reading.use_arrival_time
        return bag_files.header_stamp_ns(data, is_ros_2=is_ros_2) if is_stamped else arrival_ns

    def _check_late(self, stream: bag_files.TopicStream, clock: clocks.ClockFilter[Any]) -> None:
        clocks.check_dropped(
            f"{self._path}: {stream.topic}",
            clock.dropped,
            stream.count,
            clock.first,
            self._reading.max_late_share,
            "" if self._reading.use_arrival_time else "; --use_arrival_time takes those of arrival",
        )

    def _runs(self) -> list[list[clocks.Run]]:
        """Return the runs of each stream's clock; reads the stamps of the whole bag."""
        rows = {stream.topic: row for row, stream in enumerate(self._streams)}
        filters: list[clocks.ClockFilter[int]] = [
            clocks.ClockFilter(s.first_ns) for s in self._streams
        ]
        runs: list[list[clocks.Run]] = [[clocks.Run()] for _ in self._streams]
        with bag_files.opened_bag(self._path) as reader:
            connections = [c for c in reader.connections if c.topic in rows]
            for connection, arrival_ns, data in reader.messages(connections):
                row = rows[connection.topic]
                stamp_ns = self._stamp_ns(data, arrival_ns, is_ros_2=reader.is2)
                time_ns = stamp_ns + self._streams[row].time_offset_ns
                for ready_ns, ready_arrival_ns in filters[row].push(time_ns, arrival_ns):
                    if filters[row].part == len(runs[row]):
                        runs[row].append(clocks.Run())
                    runs[row][-1].add(ready_ns, ready_arrival_ns)
        return runs

    def _choose_part(self, part: int) -> None:
        """Read one part only.

        Raises:
            UserError: There is no such part.
            MapError: The sensors have different numbers of parts.
        """
        runs = self._runs()
        counts = {s.camera: len(run) for s, run in zip(self._streams, runs, strict=True)}
        count = max(counts.values())
        clocks.check_part(self.name, part, count)
        sensors = [counts[s.camera] for s in self._streams if s.camera < 0]
        cameras = [counts[s.camera] for s in self._streams if s.camera >= 0]
        self._is_apart = part > 1 and min(counts.values()) < count
        clocks.common_part_count(self.name, max(sensors, default=None), cameras)
        divided = [of_stream for of_stream in runs if len(of_stream) == count]
        if part > 1:
            before_ns = max(of_stream[part - 2].last_arrival_ns for of_stream in divided)
            self._arrivals_ns = before_ns + 1, self._arrivals_ns[1]
        if part < count:
            after_ns = min(of_stream[part].first_arrival_ns for of_stream in divided)
            self._arrivals_ns = self._arrivals_ns[0], after_ns - 1
        with bag_files.opened_bag(self._path) as reader:
            self._streams = [
                stream.of_run(of_stream[part - 1])
                if len(of_stream) == count
                else self._examined(reader, stream, self._arrivals_ns)
                for stream, of_stream in zip(self._streams, runs, strict=True)
            ]

    def check_common_time(self, *, has_shift: bool) -> None:
        """Check that IMU and images have some time in common, as far as first stamps tell.

        Args:
            has_shift: The shift between their clocks was given.

        Raises:
            MapError: They have none, or are of clocks that differ.
        """
        spans_ns: tuple[list[tuple[int, int]], ...] = [], []  # of the IMU, of cameras
        for stream in self._streams:
            last_ns = (stream.arrivals_ns or self._arrivals_ns)[1] - stream.delay_ns
            spans_ns[stream.camera >= 0].append((stream.first_ns, last_ns))
        if all(spans_ns):
            imu, images = ((min(s)[0], max(end for _, end in s)) for s in spans_ns)
            delay_ns = self._streams[-1].delay_ns - self._streams[0].delay_ns
            shift_ns = self.device.cameras[-1].time_offset_ns + delay_ns
            clocks.check_common_time(
                self.name,
                imu,
                images,
                f"{shift_ns} by the times of arrival",
                is_apart=self._is_apart and not has_shift,
            )

    def _examined(
        self,
        reader: BagReader,
        stream: bag_files.TopicStream,
        within_ns: tuple[int, int] | None = None,
    ) -> bag_files.TopicStream:
        """Return the stream with the bag's name of its topic and the times of its first message.

        Args:
            stream: Topic as it was given.
            within_ns: First and last arrival of messages that count; None = all.
        """
        sensor = f"camera {stream.camera}" if stream.camera >= 0 else "IMU"
        flag = "--camera_topics" if stream.camera >= 0 else "--imu_topic"
        types = bag_files.topic_types(reader)
        topic = bag_files.topic_in_bag(
            self._path,
            types,
            stream.topic,
            flag,
            IMAGE_TYPES if stream.camera >= 0 else (IMU_TYPE,),
            sensor,
        )
        connections = [c for c in reader.connections if c.topic == topic]
        arrivals_ns: list[int] = []
        stamps_ns: list[int] = []
        begin_ns, end_ns = (None, None) if within_ns is None else (within_ns[0], within_ns[1] + 1)
        messages = reader.messages(connections, begin_ns, end_ns)
        for _, at_ns, data in itertools.islice(messages, _EXAMINED):
            if stream.camera >= 0 and not stamps_ns:
                with contextlib.suppress(MapError), bag_files.damage_named(self._path):
                    image = self._image(
                        stream, at_ns, reader.deserialize(data, types[topic]), CONTAINER_BITS
                    )
                    self.first_sizes_px[stream.camera] = image.data.size_px()
            arrivals_ns.append(at_ns)
            stamps_ns.append(self._stamp_ns(data, at_ns, is_ros_2=reader.is2))
            if len(stamps_ns) > 1 and clocks.follows(*stamps_ns[-2:]):
                break
        if not stamps_ns:
            raise MapError(f"{self._path}: the recording is empty: {topic} has no messages")
        if not any(stamps_ns) and len(stamps_ns) > 1:
            raise MapError(
                f"{self._path}: {topic}: the stamps of its messages are all 0, as of a driver that sets "
                "none: give --use_arrival_time to take the times of arrival"
            )
        stamp_ns = clocks.first_stamp_ns(stamps_ns)
        arrival_ns = arrivals_ns[stamps_ns.index(stamp_ns)]
        first_ns = stamp_ns + stream.time_offset_ns
        return dataclasses.replace(
            stream,
            topic=topic,
            count=sum(connection.msgcount for connection in connections),
            first_ns=first_ns,
            delay_ns=arrival_ns - first_ns,
            arrivals_ns=within_ns,
        )

    def _batch(self, times_ns: list[int], samples: list[tuple[float, ...]]) -> Iterator[ImuBatch]:
        assert self.device.imu is not None  # its topic is read
        values, times = np.array(samples, dtype=np.float64), np.array(times_ns, dtype=np.int64)
        is_number = np.isfinite(values).all(axis=1)
        if not is_number.all():
            stream, clock = self._streams[0], self._clocks[0]
            for time_ns in times[~is_number].tolist():
                clock.leave_out(time_ns)
            self._check_late(stream, clock)
        if is_number.any():
            yield ImuBatch.of(self.device.imu, times[is_number], values[is_number])

    def _image(
        self, stream: bag_files.TopicStream, time_ns: int, message: Any, bits: int
    ) -> CameraImage:
        stamp_ns = time_ns - stream.time_offset_ns
        name, camera = f"{self._path}: {stream.topic} at {stamp_ns}", stream.camera
        data = image_of_message(message, name, self.device.cameras[camera])
        return CameraImage(camera, time_ns, stamp_ns, data, bits)
