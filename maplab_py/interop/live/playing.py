"""A recording published as topics, at its own pace or another."""

import dataclasses
import time
from collections.abc import Callable, Iterator

from maplab_py.errors import UserError
from maplab_py.interop.bags.sensor_messages import IMAGE, MessageMaker
from maplab_py.interop.live.connection import open_transport
from maplab_py.interop.live.options import NetworkOptions
from maplab_py.interop.live.transport import LOOK_EVERY_S, Publish, Transport
from maplab_py.interop.recordings import bags
from maplab_py.interop.recordings.protocol import CameraImage, ImuBatch, Recording
from maplab_py.options import Options, option
from maplab_py.progress import SILENT, Progress
from maplab_py.report import Report

_STATUS_EVERY = 50
_SETTLE_S = 0.5
"""Both sides have to learn of each other before the first message."""
_DRAIN_S = 1.0


class PlayingOptions(Options, prefix="play_"):
    """Playback of a recording."""

    rate: float = option(1.0, ge=0, lt=1e6)
    """Multiple of real time; 0 = as fast as possible"""
    wait_for_subscribers: bool = True
    """Begin when somebody listens to all topics (at most --live_wait_s)"""
    stamps_now: bool = False
    """Move the stamps so that the recording begins now (with --play_rate=1)"""


@dataclasses.dataclass(frozen=True)
class PlayedTopic:
    """Messages sent to one topic."""

    topic: str
    type: str
    messages: int
    subscribers: int


class PlayedRecording(Report):
    """Published messages."""

    recording: str
    target: str
    duration_s: float  # of the recording
    elapsed_s: float
    largest_delay_ms: float  # behind the pace
    topics: tuple[PlayedTopic, ...]
    notes: tuple[str, ...]


def play_recording(
    recording: Recording,
    kind: str,
    network: NetworkOptions,
    options: PlayingOptions,
    *,
    progress: Progress = SILENT,
    is_to_end: Callable[[], bool] = lambda: False,
) -> PlayedRecording:
    """Publish images and IMU samples of a recording.

    Args:
        kind: One of `TRANSPORTS`.
        is_to_end: Tells whether to end now.

    Raises:
        UserError: A library is missing, nobody answers, or two sensors have the same topic.
        MapError: The recording is damaged.
    """
    with open_transport(kind, network, is_server=True) as transport:
        player = _Player(recording, transport, options)
        if options.wait_for_subscribers:
            player.wait(network.live_wait_s, progress, is_to_end)
        player.play(progress, is_to_end)
        time.sleep(_DRAIN_S)
        return player.report()


class _Player:
    """Sends what a recording has."""

    def __init__(self, recording: Recording, transport: Transport, options: PlayingOptions) -> None:
        device = recording.device
        self._recording, self._transport, self._options = recording, transport, options
        self._maker = MessageMaker(is_ros_2=transport.is_ros_2)
        self._topics = {
            row: camera.topic or f"/cam{row}/image_raw" for row, camera in enumerate(device.cameras)
        }
        if device.imu is not None:
            self._topics[-1] = device.imu.topic or "/imu0"
        if len(set(self._topics.values())) < len(self._topics):
            raise UserError(
                f"{recording.name}: two sensors have the same topic: name others in sensors.yaml"
            )
        self._publishers: dict[int, Publish] = {
            sensor: transport.advertise(topic, bags.IMU_TYPE if sensor < 0 else IMAGE)
            for sensor, topic in self._topics.items()
        }
        self._sent = dict.fromkeys(self._topics, 0)
        self._listeners = dict.fromkeys(self._topics, 0)
        self._first_ns = self._last_ns = 0
        self._offset_ns: int | None = None
        self._begin_s = self._elapsed_s = self._largest_delay_s = 0.0

    def wait(self, wait_s: float, progress: Progress, is_to_end: Callable[[], bool]) -> None:
        """Wait for subscribers of all topics; go on without them when the time is over."""
        deadline_s = time.monotonic() + wait_s
        while time.monotonic() < deadline_s and not is_to_end():
            if all(self._transport.subscribers(topic) for topic in self._topics.values()):
                time.sleep(_SETTLE_S)
                return
            progress.step(0.0, 0.0, "waiting for subscribers")
            time.sleep(LOOK_EVERY_S)

    def play(self, progress: Progress, is_to_end: Callable[[], bool]) -> None:
        """Send everything at its time."""
        self._begin_s = time.monotonic()
        for number, (time_ns, sensor, message) in enumerate(self._messages()):
            if not number:
                self._first_ns = time_ns
            self._keep_pace(time_ns, is_to_end)
            if is_to_end():
                break
            self._last_ns = time_ns
            self._publishers[sensor](message())
            self._sent[sensor] += 1
            if number % _STATUS_EVERY == 0:
                progress.step((time_ns - self._first_ns) * 1e-9, 0.0, "s played")
        self._elapsed_s = time.monotonic() - self._begin_s
        for sensor, topic in self._topics.items():
            self._listeners[sensor] = self._transport.subscribers(topic)

    def report(self) -> PlayedRecording:
        """Return what was sent."""
        notes = [*self._recording.notes, *self._transport.problems]
        silent = [self._topics[row] for row, count in self._listeners.items() if not count]
        if silent:
            notes.append(f"nobody listened to {', '.join(silent)} at the end")
        return PlayedRecording(
            self._recording.name,
            self._transport.name,
            (self._last_ns - self._first_ns) * 1e-9,
            self._elapsed_s,
            1e3 * self._largest_delay_s,
            tuple(
                PlayedTopic(
                    topic,
                    bags.IMU_TYPE if row < 0 else IMAGE,
                    self._sent[row],
                    self._listeners[row],
                )
                for row, topic in sorted(self._topics.items())
            ),
            tuple(notes),
        )

    def _messages(self) -> Iterator[tuple[int, int, Callable[[], bytes]]]:
        """Yield time, sensor (-1 = IMU), and what makes the message."""
        for item in self._recording.items():
            if isinstance(item, ImuBatch):
                yield from self._samples(item)
            elif isinstance(item, CameraImage):
                yield item.time_ns, item.camera, lambda image=item: self._image(image)  # type: ignore[misc]
            else:
                raise UserError(
                    f"{self._recording.name} has keypoints in place of images: play a folder or bag"
                )

    def _samples(self, batch: ImuBatch) -> Iterator[tuple[int, int, Callable[[], bytes]]]:
        stamps_ns = batch.times_ns + self._clock_offset_ns(batch.time_ns)
        rows = self._maker.imu(stamps_ns, batch.accel_gyro, "imu")
        for time_ns, row in zip(batch.times_ns.tolist(), rows, strict=True):
            yield time_ns, -1, lambda data=row: data  # type: ignore[misc]

    def _image(self, image: CameraImage) -> bytes:
        stamp_ns = image.stamp_ns + self._clock_offset_ns(image.time_ns)
        return self._maker.image(stamp_ns, f"cam{image.camera}", image.decode())

    def _clock_offset_ns(self, time_ns: int) -> int:
        """Return what is added to stamps: the beginning becomes now, if the user wants it."""
        if not self._options.stamps_now:
            return 0
        if self._offset_ns is None:
            self._offset_ns = time.time_ns() - time_ns
        return self._offset_ns

    def _keep_pace(self, time_ns: int, is_to_end: Callable[[], bool]) -> None:
        """Wait until a message is due."""
        rate = self._options.rate
        if not rate:
            return
        due_s = self._begin_s + (time_ns - self._first_ns) * 1e-9 / rate
        while (left_s := due_s - time.monotonic()) > 0.0 and not is_to_end():
            time.sleep(min(left_s, LOOK_EVERY_S))
        self._largest_delay_s = max(self._largest_delay_s, -left_s)
