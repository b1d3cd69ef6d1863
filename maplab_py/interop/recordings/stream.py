"""The stream of events: synchronised frame sets between the IMU samples, and what was left out."""

from __future__ import annotations

import dataclasses
from array import array
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Executor, Future

import numpy as np

from maplab_py.errors import MapError, MaplabError, UserError
from maplab_py.interop.images import Pixels
from maplab_py.interop.recordings import protocol
from maplab_py.interop.recordings.options import StreamOptions


@dataclasses.dataclass
class Times:
    """Count, first, last and largest step of increasing times."""

    all_ns: array[int] = dataclasses.field(default_factory=lambda: array("q"))  # of images
    count: int = 0
    first_ns: int = 0
    last_ns: int = 0
    largest_step_ns: int = 0

    def add(self, time_ns: int) -> None:
        """Count one time."""
        if self.count:
            self.largest_step_ns = max(self.largest_step_ns, time_ns - self.last_ns)
        else:
            self.first_ns = time_ns
        self.all_ns.append(time_ns)
        self.count, self.last_ns = self.count + 1, time_ns

    @property
    def largest_hole_ns(self) -> tuple[int, int]:
        """Largest step between times, and where it begins; 0 for fewer than two."""
        times_ns = np.asarray(self.all_ns, dtype=np.int64)
        if len(times_ns) < 2:
            return 0, self.first_ns
        row = int(np.argmax(np.diff(times_ns)))
        return int(times_ns[row + 1] - times_ns[row]), int(times_ns[row])

    @property
    def rate_hz(self) -> float:
        """Mean rate; 0 for fewer than two times."""
        span_ns = self.last_ns - self.first_ns
        return (self.count - 1) * 1e9 / span_ns if span_ns > 0 else 0.0


@dataclasses.dataclass
class StreamStatistics:
    """Counts of the items that a stream has delivered and left out so far."""

    imu: Times = dataclasses.field(default_factory=Times)
    images: list[Times] = dataclasses.field(default_factory=list)  # by camera
    frame_sets: Times = dataclasses.field(default_factory=Times)
    saturated_samples: int = 0
    without_acceleration: int = 0  # samples whose accelerations are 0
    without_rate: int = 0  # samples whose angular rates are 0
    imu_gaps: int = 0
    first_imu_gap_ns: int = -1  # time at which the first gap begins
    unmatched_images: list[int] = dataclasses.field(default_factory=list)  # by camera
    dropped_before_imu: int = 0  # frame sets

    @property
    def zero_note(self) -> str:
        """One line on an IMU that measures rates or accelerations only; empty if it does both."""
        remedy = "--imu_topic=GYRO,ACCEL joins the topics of gyroscope and accelerometer"
        if self.imu.count and self.without_acceleration == self.imu.count:
            return f"all accelerations of the IMU are 0: {remedy}"
        if self.imu.count and self.without_rate == self.imu.count:
            return f"all angular rates of the IMU are 0: {remedy}"
        return ""


class EventStream:
    """Iterates once over the events of a recording, in the order of time.

    IMU samples up to and including the time of a frame set come before it. Frame sets before the
    first IMU sample are dropped, as are images without partners in the other cameras; `statistics`
    counts both. A gap between IMU samples is counted, and delivered as it is.
    """

    def __init__(self, recording: protocol.Recording, options: StreamOptions | None = None) -> None:
        self._recording = recording
        self._options = options or StreamOptions()
        cameras = len(recording.device.cameras)
        self.statistics = StreamStatistics(
            images=[Times() for _ in range(cameras)], unmatched_images=[0] * cameras
        )

    def __iter__(self) -> Iterator[protocol.Event]:
        """Yield the events.

        Raises:
            MapError: The recording is damaged.
            UserError: Nothing was recorded in the chosen time.
        """
        options, recording = self._options, self._recording
        origin_ns = recording.start_ns
        start_ns = origin_ns + round(options.start_s * 1e9) if options.start_s else None
        end_ns = origin_ns + round(options.end_s * 1e9) if options.end_s else None
        items = self._counted(recording.items(start_ns, end_ns))
        sets = Synchroniser(len(recording.device.cameras), options.nframe_sync_tolerance_ns)
        self.statistics.unmatched_images = sets.unmatched
        needs_imu = bool(recording.device.imu_id)
        for item in items:
            for event in sets.push(item):
                if isinstance(event, protocol.ImuBatch):
                    needs_imu = False
                    yield event
                elif needs_imu:
                    self.statistics.dropped_before_imu += 1
                else:
                    self.statistics.frame_sets.add(event.time_ns)
                    yield event
        for event in sets.finish():
            if isinstance(event, protocol.ImuBatch):
                yield event
        self._check_not_empty()

    def _counted(self, items: Iterator[protocol.Item]) -> Iterator[protocol.Item]:
        """Count items on their way."""
        for item in items:
            if isinstance(item, protocol.ImuBatch):
                self._count_samples(item)
            elif isinstance(item, protocol.CameraImage):
                self.statistics.images[item.camera].add(item.time_ns)
            else:
                for frame in item.frames:
                    if frame is not None:
                        self.statistics.images[frame.camera].add(item.time_ns)
            yield item

    def _count_samples(self, batch: protocol.ImuBatch) -> None:
        statistics, imu = self.statistics, self.statistics.imu
        times_ns = batch.times_ns
        if imu.count:
            times_ns = np.concatenate([[imu.last_ns], times_ns])
        else:
            imu.first_ns = batch.time_ns
        steps_ns = np.diff(times_ns)
        gaps = np.flatnonzero(steps_ns > self._options.imu_gap_s * 1e9)
        if len(gaps) and not statistics.imu_gaps:
            statistics.first_imu_gap_ns = int(times_ns[gaps[0]])
        statistics.imu_gaps += len(gaps)
        imu.largest_step_ns = max(imu.largest_step_ns, int(steps_ns.max(initial=0)))
        imu.count, imu.last_ns = imu.count + len(batch), int(times_ns[-1])
        statistics.saturated_samples += int(batch.is_saturated.sum())
        if not batch.accel_gyro.all():
            is_zero = batch.accel_gyro == 0.0
            statistics.without_acceleration += int(is_zero[:, :3].all(axis=1).sum())
            statistics.without_rate += int(is_zero[:, 3:].all(axis=1).sum())

    def _check_not_empty(self) -> None:
        statistics, options = self.statistics, self._options
        if statistics.imu.count or any(times.count for times in statistics.images):
            return
        if options.start_s or options.end_s:
            raise UserError(
                f"{self._recording.name}: nothing was recorded from {options.start_s:g} s on"
                + (f" until {options.end_s:g} s" if options.end_s else "")
                + ": choose another --vio_rosbag_start_s and --vio_rosbag_end_s"
            )
        raise MapError(f"{self._recording.name}: the recording is empty: record it again")


@dataclasses.dataclass(frozen=True, eq=False)
class _AheadImage(protocol.CameraImage):
    """An image that a thread decodes."""

    pixels: Future[Pixels] = dataclasses.field(kw_only=True)

    def decode(self) -> Pixels:
        """Wait for the pixels; see `ImageData.decode`."""
        return self.pixels.result()


def read_ahead(events: Iterable[protocol.Event], thread: Executor) -> Iterator[protocol.Event]:
    """Yield the events of a file; the images of the next frame set are decoded while one is used."""
    waiting: deque[protocol.Event] = deque()
    try:
        for event in events:
            if isinstance(event, protocol.FrameSet):
                images = tuple(
                    _AheadImage(**vars(image), pixels=thread.submit(image.decode))
                    for image in event.images
                )
                waiting.append(dataclasses.replace(event, images=images))
                while len(waiting) > 1:
                    yield waiting.popleft()
            else:
                waiting.append(event)
    except MaplabError:
        yield from waiting
        raise
    yield from waiting


class Synchroniser:
    """Puts images of several cameras together, and IMU samples before the sets they belong to."""

    def __init__(self, cameras: int, tolerance_ns: int) -> None:
        """Put images of so many cameras together whose times differ by at most the tolerance."""
        self.unmatched = [0] * cameras
        self._cameras, self._tolerance_ns = cameras, tolerance_ns
        self._open: dict[int, protocol.CameraImage] = {}
        self._held: list[protocol.ImuBatch] = []  # while a set is open

    def push(self, item: protocol.Item) -> Iterator[protocol.Event]:
        """Take the next item; yield what is complete by now."""
        if self._open and item.time_ns > self._oldest_ns + self._tolerance_ns:
            yield from self._give_up()
        if isinstance(item, protocol.ImuBatch):
            if not self._open:
                yield item
                return
            self._held.append(item)
            if int(item.times_ns[-1]) > self._oldest_ns + self._tolerance_ns:
                yield from self._give_up()
        elif isinstance(item, protocol.TrackedFrameSet):
            yield item
        else:
            if item.camera in self._open:
                self.unmatched[item.camera] += 1
            self._open[item.camera] = item
            if len(self._open) == self._cameras:
                yield from self._complete()

    def finish(self) -> Iterator[protocol.Event]:
        """Yield what is left at the end of the recording."""
        yield from self._give_up()

    @property
    def _oldest_ns(self) -> int:
        return min(image.time_ns for image in self._open.values())

    def _give_up(self) -> Iterator[protocol.Event]:
        for camera in self._open:
            self.unmatched[camera] += 1
        self._open = {}
        held, self._held = self._held, []
        yield from held

    def _complete(self) -> Iterator[protocol.Event]:
        images = tuple(self._open[camera] for camera in range(self._cameras))
        time_ns = images[0].time_ns
        self._open = {}
        later = []
        for batch in self._held:
            count = int(np.searchsorted(batch.times_ns, time_ns, side="right"))
            if count:
                yield batch.take(slice(count))
            if count < len(batch):
                later.append(batch.take(slice(count, None)))
        self._held = []
        yield protocol.FrameSet(time_ns, images)
        yield from later
