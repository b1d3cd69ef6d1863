"""A recording that is still going on: the topics of a running robot."""

import collections
import dataclasses
import math
import struct
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np

from maplab_py.array_types import F64
from maplab_py.cancellation import current_token
from maplab_py.errors import MapError, UserError
from maplab_py.interop.images import Pixels, bits_of
from maplab_py.interop.live import transport as transports
from maplab_py.interop.live.options import LiveOptions
from maplab_py.interop.live.receiving import Inbox, Message, TopicCounts
from maplab_py.interop.recordings import bag_files, bags, paired_imu, protocol
from maplab_py.interop.recordings.images import image_of_message
from maplab_py.interop.recordings.options import SourceOptions
from maplab_py.report import counted
from maplab_py.sensors import Camera

_MAX_REMEMBERED = 1000
_MAX_NOTED = 20
"""Latest problems of the connection that the report repeats."""
_CHECK_AFTER_S = 2.0
_TELL_AFTER_S = 2.0
"""Silence that is told."""
_GRAVITY = 9.81
_SMALLEST_ACCEL, _LARGEST_ACCEL = 4.0, 40.0  # medians that a moving device may have [m/s^2]
_LARGEST_RATE = 12.0  # median of the turn rate [rad/s]: more are degrees
_LARGEST_CLOCK_OFFSET_S = 1.0


@dataclasses.dataclass(frozen=True, eq=False)
class _Decoded:
    """Pixels of an image that were decoded when it was taken."""

    pixels: Pixels
    encoding: str
    bits: int

    def size_px(self) -> tuple[int, int]:
        """Return width and height as recorded."""
        height, width = self.pixels.shape[:2]
        return width, height

    def check(self) -> None:
        """Do nothing: they are whole."""

    def decode(self) -> Pixels:
        """Return the pixels."""
        return self.pixels


class LiveRecording:
    """Reads topics once, from now on, until the user ends it or nothing arrives any more.

    Images come as sets, all cameras one after the other; IMU samples come as they arrive, so some may
    be later than a set that follows them.
    """

    def __init__(
        self,
        transport: transports.Transport,
        device: protocol.RecordedSensors,
        source: SourceOptions,
        options: LiveOptions,
        *,
        wait_s: float,
        tolerance_ns: int,
        tell: Callable[[str], None] = lambda _: None,
    ) -> None:
        """Wait for the topics.

        Args:
            source: Topics; empty = as the sensors say.
            wait_s: Wait so long for the publishers.
            tolerance_ns: Largest difference between the times of the images of a set.
            tell: Is told what the user should know while it goes on.

        Raises:
            UserError: A topic is not published, not named, or of another type.
            Cancelled: The user does not want to wait.
        """
        self.device, self.name = device, transport.name
        self.kind = "live topics"
        self._transport, self._options, self._tell = transport, options, tell
        self._imu_names = _imu_topics(device, source)
        cameras = _camera_topics(device, source)
        topics = transports.wait_for_topics(transport, [*self._imu_names, *cameras], wait_s)
        for row, topic in enumerate(topics):
            is_imu = row < len(self._imu_names)
            wanted = (bags.IMU_TYPE,) if is_imu else bags.IMAGE_TYPES
            if topic.type not in wanted:
                raise UserError(
                    f"{transport.name}: {topic.name} has messages of type {topic.type}, needed is "
                    f"{' or '.join(wanted)}: choose another topic; live_topics lists what there is"
                )
        self._camera_types = [topic.type for topic in topics[len(self._imu_names) :]]
        self._offsets_ns = [camera.time_offset_ns for camera in device.cameras]
        self.inbox = Inbox(len(cameras), tolerance_ns, options.max_delay_s)
        self.counts = {topic.name: TopicCounts() for topic in topics}
        self._store = bag_files.message_types(is_ros_2=transport.is_ros_2)
        self._paired = paired_imu.PairedImu() if len(self._imu_names) == 2 else None
        self._arrivals: collections.OrderedDict[int, float] = collections.OrderedDict()
        self._latencies_ms: collections.deque[float] = collections.deque(maxlen=100_000)
        self._last_imu_ns, self._told = -1, 0
        self._given_bits = source.reading.image_bits
        self._bits: dict[int, int] = {}  # of the values of the images, by camera
        self._first_samples: list[F64] = []
        self._is_checked = False
        self.notes: tuple[str, ...] = ()
        self._topics, self._is_subscribed = topics, False
        self.started_s = time.monotonic()

    def subscribe(self) -> None:
        """Receive from now on; `items` does it, when whoever reads is ready."""
        if self._is_subscribed:
            return
        self._is_subscribed, self.started_s = True, time.monotonic()
        for row, topic in enumerate(self._topics):
            is_imu = row < len(self._imu_names)
            sensor = row if is_imu else row - len(self._imu_names)
            take = self._take_imu if is_imu else self._take_image
            self._transport.subscribe(topic, partial(take, sensor, self.counts[topic.name]))

    # -- in the receiving thread ------------------------------------------------------------------

    def _take_image(self, camera: int, counts: TopicCounts, data: bytes) -> None:
        stamp_ns = counts.stamp_of(data, is_ros_2=self._transport.is_ros_2)
        if stamp_ns is not None:
            time_ns = stamp_ns + self._offsets_ns[camera]
            self.inbox.put_image(Message(camera, time_ns, data, counts.last_s))

    def _take_imu(self, part: int, counts: TopicCounts, data: bytes) -> None:
        stamp_ns = counts.stamp_of(data, is_ros_2=self._transport.is_ros_2)
        if stamp_ns is not None:
            self.inbox.put_imu(Message(part, stamp_ns, data, counts.last_s))

    # -- in the thread that reads -----------------------------------------------------------------

    @property
    def start_ns(self) -> int:
        """Time of the first item; a live source begins now, so it has none."""
        return 0

    @property
    def end_ns(self) -> int:
        """Time of the last item: not known."""
        return 0

    def parts(self) -> tuple[protocol.PartSpan, ...]:
        """Return no parts: a live source has no end."""
        return ()

    def items(
        self, start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[protocol.Item]:
        """Yield what arrives; see `Recording.items`.

        Raises:
            UserError: A part of the recording is chosen, nothing has arrived at all, or images have
                another size than their camera's.
        """
        if start_ns is not None or end_ns is not None:
            raise UserError(
                f"{self.name} is live: leave out --vio_rosbag_start_s and --vio_rosbag_end_s"
            )
        self.subscribe()
        heard_s, has_told = time.monotonic(), False
        while not self._is_to_end():
            arrivals = self.inbox.take(transports.LOOK_EVERY_S)
            self._tell_problems()
            if arrivals is None:
                silent_s = time.monotonic() - heard_s
                if 0.0 < self._options.silence_s < silent_s:
                    break
                if silent_s > _TELL_AFTER_S and not has_told:
                    has_told, silence_s = True, self._options.silence_s
                    until = f" up to {silence_s:g} s" if silence_s else "; Ctrl-C ends"
                    self._tell(f"nothing arrives from {self.name}: waiting{until}")
                continue
            heard_s, has_told = time.monotonic(), False
            batch = self._batch(arrivals.imu)
            if batch is not None:
                self._check_samples(batch)
                yield batch
            if arrivals.images:
                images = self._images(arrivals.images)
                if images:
                    self._remember(arrivals.images)
                yield from images
        self._close()

    def processed(self, time_ns: int) -> None:
        """Note that a set of images has been used, for the latency."""
        arrival_s = self._arrivals.pop(time_ns, None)
        if arrival_s is not None:
            self._latencies_ms.append(1e3 * (time.monotonic() - arrival_s))

    def status(self) -> str:
        """Return rate, latency and what was left out, in a few words."""
        rates = [self.counts[name].rate_hz for name in list(self.counts)[len(self._imu_names) :]]
        recent = list(self._latencies_ms)[-20:]
        latency = f"  {np.median(recent):.0f} ms after arrival" if recent else ""
        return f"{min(rates):.1f} Hz{latency}  {self.inbox.dropped_sets} dropped"

    def _is_to_end(self) -> bool:
        token = current_token()
        token.check()
        return token.is_ending

    def _tell_problems(self) -> None:
        """Say what has gone wrong in the connection since the last time."""
        problems = self._transport.problems
        while self._told < len(problems):
            self._tell(problems[self._told])
            self._told += 1

    def _batch(self, messages: list[Message]) -> protocol.ImuBatch | None:
        """Return the samples of messages, None if there are none that can be used."""
        times_ns, samples = [], []
        for message in messages:
            counts = self.counts[self._imu_names[message.sensor]]
            try:
                values = imu_values(message.data, is_ros_2=self._transport.is_ros_2)
            except MapError:
                counts.damaged += 1
                continue
            ready = [(message.time_ns, values)]
            if self._paired is not None:
                ready = self._paired.add(message.sensor, message.time_ns, values)
            for time_ns, row in ready:
                if time_ns > self._last_imu_ns:
                    self._last_imu_ns = time_ns
                    times_ns.append(time_ns)
                    samples.append(row)
        if not samples or self.device.imu is None:
            return None
        return protocol.ImuBatch.of(
            self.device.imu, np.array(times_ns, dtype=np.int64), np.array(samples)
        )

    def _images(self, messages: tuple[Message, ...]) -> list[protocol.CameraImage]:
        """Return the decoded images of a set, none if one is damaged.

        Raises:
            MapError: The first image of a camera cannot be used.
        """
        names = list(self.counts)[len(self._imu_names) :]
        images = []
        for row, message in enumerate(messages):
            stamp_ns = message.time_ns - self._offsets_ns[row]
            name = f"{self.name}: {names[row]} at {stamp_ns}"
            kind, camera = self._camera_types[row], self.device.cameras[row]
            try:
                data = image_data(
                    message.data, kind, camera, name, self._store, is_ros_2=self._transport.is_ros_2
                )
                pixels = data.decode()
            except MapError:
                if row not in self._bits:
                    raise
                self.counts[names[row]].damaged += 1
                return []
            bits = self._bits.setdefault(row, self._given_bits or data.bits or bits_of([pixels]))
            decoded = _Decoded(pixels, data.encoding, bits)
            images.append(protocol.CameraImage(row, message.time_ns, stamp_ns, decoded, bits))
        return images

    def _remember(self, messages: tuple[Message, ...]) -> None:
        self._arrivals[messages[0].time_ns] = max(message.arrival_s for message in messages)
        if len(self._arrivals) > _MAX_REMEMBERED:
            self._arrivals.popitem(last=False)

    def _check_samples(self, batch: protocol.ImuBatch) -> None:
        """Compare units and clocks of the first seconds with what they must be.

        Raises:
            UserError: The units of the IMU are wrong.
        """
        if self._is_checked:
            return
        self._first_samples.append(batch.accel_gyro)
        if time.monotonic() - self.started_s < _CHECK_AFTER_S:
            return
        self._is_checked = True
        samples = np.concatenate(self._first_samples)
        self._first_samples = []
        imu = " and ".join(self._imu_names)
        accel = float(np.median(np.linalg.norm(samples[:, :3], axis=1)))
        if not _SMALLEST_ACCEL <= accel <= _LARGEST_ACCEL:
            raise UserError(
                f"{imu}: the accelerometer shows {accel:.2f} m/s^2 at the median, {_GRAVITY} are "
                "expected: publish m/s^2 (not g) in linear_acceleration, gravity included"
            )
        gyro = float(np.median(np.linalg.norm(samples[:, 3:], axis=1)))
        if gyro > _LARGEST_RATE:
            raise UserError(
                f"{imu}: the gyroscope shows {gyro:.1f} rad/s at the median: publish rad/s (not deg/s)"
            )
        self._check_clocks()

    def _check_clocks(self) -> None:
        delays_s = {name: c.stamp_delay_s for name, c in self.counts.items() if c.received}
        imu_delay_s = delays_s[self._imu_names[0]]
        for name, delay_s in delays_s.items():
            if abs(delay_s - imu_delay_s) > _LARGEST_CLOCK_OFFSET_S:
                self._tell(
                    f"{name}: its stamps are {imu_delay_s - delay_s:+.2f} s off those of "
                    f"{self._imu_names[0]}: let the drivers use one clock, or give "
                    "--imu_to_camera_time_offset_ns"
                )

    def _close(self) -> None:
        """Say what was left out.

        Raises:
            UserError: Nothing has arrived at all.
        """
        silent = [name for name, counts in self.counts.items() if not counts.received]
        if silent and not self._is_to_end():
            hint = f"; {self._transport.problems[-1]}" if self._transport.problems else ""
            raise UserError(
                f"{self.name}: {', '.join(silent)} was silent for {self._options.silence_s:g} s: check "
                f"its publisher, or raise --live_silence_s{hint}"
            )
        self.notes = tuple(self._summary())

    def _summary(self) -> Iterator[str]:
        if self.inbox.dropped_sets:
            yield (
                f"{counted(self.inbox.dropped_sets, 'set')} of images left out because they had waited "
                f"{self._options.max_delay_s:g} s: lower the rate or the size of the images"
            )
        for row, count in enumerate(self.inbox.unmatched):
            if count:
                name = list(self.counts)[len(self._imu_names) + row]
                yield f"{name}: {counted(count, 'image')} without a partner in the other cameras"
        for name, counts in self.counts.items():
            if counts.missing:
                yield (
                    f"{name}: about {counted(counts.missing, 'message')} missing by the stamps: where the "
                    "driver leaves none out, raise the receive buffers (on Linux "
                    f"`{transports.RAISE_RECEIVE_BUFFERS}`), or publish compressed images"
                )
            if counts.damaged:
                yield f"{name}: {counted(counts.damaged, 'damaged message')} left out"
            if counts.not_later:
                yield (
                    f"{name}: {counted(counts.not_later, 'message')} left out whose stamps do not come "
                    "after the one before: let its driver set header.stamp"
                )
        yield from dict.fromkeys(self._transport.problems[-_MAX_NOTED:])
        if self._latencies_ms:
            median, worst = np.percentile(list(self._latencies_ms), [50, 99])
            yield f"pose {median:.0f} ms after the arrival of its images (median; {worst:.0f} ms at 99 %)"


def _imu_topics(device: protocol.RecordedSensors, source: SourceOptions) -> list[str]:
    """Return the topic of the IMU, or those of gyroscope and accelerometer.

    Raises:
        UserError: There is no IMU, or its topic is not known.
    """
    if device.imu is None:
        raise UserError(
            "a live source needs an IMU, and the calibration has none: give "
            "--sensor_calibration_file=FILE with an IMU"
        )
    names = [word.strip() for word in (source.imu_topic or device.imu.topic).split(",")]
    if not 1 <= len(names) <= 2 or not all(names):
        raise UserError(
            "the calibration names no topic of the IMU: give --imu_topic=TOPIC, or two topics "
            "separated by a comma (gyroscope, accelerometer); live_topics lists what there is"
        )
    return [transports.topic_of(name) for name in names]


def _camera_topics(device: protocol.RecordedSensors, source: SourceOptions) -> list[str]:
    """Return the topic of each camera.

    Raises:
        UserError: Topics are missing, or there are too many.
    """
    names: Sequence[str] = source.topics_of_cameras
    names = names or [camera.topic for camera in device.cameras]
    if len(names) != len(device.cameras) or not all(names):
        known = sum(bool(name) for name in names)
        raise UserError(
            f"there are topics for {known} of {counted(len(device.cameras), 'camera')}: give "
            "--camera_topics, separated by commas in the order of the calibration; live_topics "
            "lists what there is"
        )
    if len(set(names)) < len(names):
        raise UserError("two cameras have the same topic: give different --camera_topics")
    return [transports.topic_of(name) for name in names]


# Messages as they arrive: decoded with the functions that bags use, damage told as such.


def imu_values(data: bytes, *, is_ros_2: bool) -> paired_imu.Sample:
    """Return [ax ay az gx gy gz] of a serialised sensor_msgs/Imu.

    Raises:
        MapError: The message is damaged, or a value is not a number.
    """
    try:
        values = bag_files.imu_sample(data, is_ros_2=is_ros_2)
    except (struct.error, IndexError) as error:
        raise MapError("the message is damaged") from error
    if not all(map(math.isfinite, values)):
        raise MapError("a value is not a number")
    return values


def image_data(
    data: bytes, kind: str, camera: Camera, name: str, store: Any, *, is_ros_2: bool
) -> protocol.ImageData:
    """Return the image of a serialised message.

    Args:
        kind: Type of the message, one of `IMAGE_TYPES`.
        name: What messages call it.
        store: Definitions of messages.
        is_ros_2: CDR, else ROS 1.

    Raises:
        MapError: The message is damaged.
    """
    if len(data) > transports.MAX_MESSAGE_BYTES:
        raise MapError(f"{name}: the message has {len(data):,} bytes: refused")
    decode = store.deserialize_cdr if is_ros_2 else store.deserialize_ros1
    try:
        message = decode(data, kind)
    except Exception as error:  # the parser's own, of any type
        raise MapError(f"{name}: the message is damaged: check its publisher") from error
    return image_of_message(message, name, camera)
