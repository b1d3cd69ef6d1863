"""Queue of messages from topics until they are used: images put together to sets, and IMU samples.

One thread receives and does nothing else; another takes. IMU samples are never left out; sets of
images are, the oldest first, when they have waited too long.
"""

import collections
import dataclasses
import struct
import threading
import time

from maplab_py.interop.recordings.bag_files import header_stamp_ns

_MAX_PENDING = 20
"""Images of a camera that may wait for their partners."""
_FIRST_STEPS = 20
"""Steps between stamps from which the usual step is taken."""
_TRACKING_RATE = 0.02  # by which the usual step follows later ones
_LONGEST_HOLE_NS = 10**9
"""A longer pause is the publisher's: it was stopped, or started again."""
_START_S, _START_DELAY_S = 30.0, 10.0
"""In the beginning images may wait longer: the estimator loads its kernels, and catches up."""


@dataclasses.dataclass
class TopicCounts:
    """Messages of one topic."""

    received: int = 0
    missing: int = 0  # as the holes between the stamps tell: lost on the way, or never sent
    not_later: int = 0  # stamps that do not come after their predecessor's: left out
    damaged: int = 0
    first_s: float = 0.0  # arrival, monotonic
    last_s: float = 0.0
    first_stamp_ns: int = 0
    last_stamp_ns: int = -1
    stamp_delay_s: float = 0.0  # from the last stamp to its arrival, by the clock of this computer
    _first_steps_ns: list[int] = dataclasses.field(default_factory=list)
    _usual_step_ns: float = 0.0

    @property
    def rate_hz(self) -> float:
        """Mean rate by the stamps."""
        span_s = (self.last_stamp_ns - self.first_stamp_ns) * 1e-9
        count = self.received - self.not_later - self.damaged - 1
        return count / span_s if span_s > 0.0 else 0.0

    def stamp_of(self, data: bytes, *, is_ros_2: bool) -> int | None:
        """Count a message; return the stamp of its header, None if it is to be left out."""
        now_s = time.monotonic()
        self.received += 1
        self.first_s, self.last_s = self.first_s or now_s, now_s
        try:
            stamp_ns = header_stamp_ns(data, is_ros_2=is_ros_2)
        except (struct.error, IndexError):
            self.damaged += 1
            return None
        if stamp_ns <= self.last_stamp_ns:
            self.not_later += 1
            return None
        if self.last_stamp_ns < 0:
            self.first_stamp_ns = stamp_ns
        else:
            self._note_step(stamp_ns - self.last_stamp_ns)
        self.last_stamp_ns = stamp_ns
        self.stamp_delay_s = time.time() - stamp_ns * 1e-9
        return stamp_ns

    def _note_step(self, step_ns: int) -> None:
        """Count the messages that are missing in a step, by the usual one (a running median)."""
        if not self._usual_step_ns:
            self._first_steps_ns.append(step_ns)
            if len(self._first_steps_ns) == _FIRST_STEPS:
                self._usual_step_ns = float(sorted(self._first_steps_ns)[_FIRST_STEPS // 4])
            return
        if step_ns < _LONGEST_HOLE_NS:
            self.missing += max(round(step_ns / self._usual_step_ns) - 1, 0)
        is_longer = step_ns > self._usual_step_ns
        self._usual_step_ns *= 1.0 + (_TRACKING_RATE if is_longer else -_TRACKING_RATE)


@dataclasses.dataclass(frozen=True, eq=False)
class Message:
    """A message, and when it was taken and received."""

    sensor: int  # row of the camera; of IMU topics 0, 1
    time_ns: int  # in the clock of the IMU
    data: bytes
    arrival_s: float  # monotonic


@dataclasses.dataclass(frozen=True, eq=False)
class Arrivals:
    """Arrived messages: IMU messages, then a set of images if there is one."""

    imu: list[Message]
    images: tuple[Message, ...]  # by camera


class SetMatcher:
    """Puts images of several cameras together by their times; they may arrive in any order."""

    def __init__(self, cameras: int, tolerance_ns: int) -> None:
        """Put images of so many cameras together whose times differ by at most the tolerance."""
        self.unmatched = [0] * cameras
        self._tolerance_ns = tolerance_ns
        self._pending: list[collections.deque[Message]] = [
            collections.deque() for _ in range(cameras)
        ]

    def add(self, image: Message) -> tuple[Message, ...]:
        """Take an image; return the set that it completes, () if it completes none."""
        self._pending[image.sensor].append(image)
        partners = [self._partner(images, image.time_ns) for images in self._pending]
        complete = tuple(partner for partner in partners if partner is not None)
        if len(complete) < len(partners):
            if len(self._pending[image.sensor]) > _MAX_PENDING:
                self._pending[image.sensor].popleft()
                self.unmatched[image.sensor] += 1
            return ()
        for images, partner in zip(self._pending, complete, strict=True):
            while images and images[0].time_ns < partner.time_ns:
                self.unmatched[images.popleft().sensor] += 1
            images.popleft()
        return complete

    def _partner(self, images: collections.deque[Message], time_ns: int) -> Message | None:
        nearest = min(images, key=lambda image: abs(image.time_ns - time_ns), default=None)
        if nearest is None or abs(nearest.time_ns - time_ns) > self._tolerance_ns:
            return None
        return nearest


class Inbox:
    """Keeps what has arrived until it is taken."""

    def __init__(self, cameras: int, tolerance_ns: int, max_delay_s: float) -> None:
        """Wait for images of so many cameras.

        Args:
            tolerance_ns: Largest difference between the times of the images of a set.
            max_delay_s: Sets that have waited longer are left out while others come.
        """
        self.dropped_sets = 0
        self._matcher = SetMatcher(cameras, tolerance_ns)
        self._max_delay_s, self._began_s = max_delay_s, time.monotonic()
        self._sets: collections.deque[tuple[Message, ...]] = collections.deque()
        self._imu: list[Message] = []
        self._changed = threading.Condition()

    @property
    def unmatched(self) -> list[int]:
        """Images without partners in the other cameras, by camera."""
        return self._matcher.unmatched

    def put_image(self, image: Message) -> None:
        """Take an image."""
        with self._changed:
            complete = self._matcher.add(image)
            if not complete:
                return
            self._sets.append(complete)
            limit_s = self._max_delay_s
            if image.arrival_s - self._began_s < _START_S:
                limit_s = max(limit_s, _START_DELAY_S)
            while image.arrival_s - self._sets[0][0].arrival_s > limit_s:
                self._sets.popleft()
                self.dropped_sets += 1
            self._changed.notify()

    def put_imu(self, message: Message) -> None:
        """Take a message of the IMU."""
        with self._changed:
            self._imu.append(message)
            self._changed.notify()

    def take(self, wait_s: float) -> Arrivals | None:
        """Return what has arrived, with the oldest set; None if nothing arrives in time."""
        with self._changed:
            if not self._sets and not self._imu:
                self._changed.wait(wait_s)
            if not self._sets and not self._imu:
                return None
            imu, self._imu = self._imu, []
            return Arrivals(imu, self._sets.popleft() if self._sets else ())
