"""Stamps that do not increase: repeated, late and wild ones are dropped, restarts of a clock begin parts."""

import dataclasses
import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Generic, TypeVar

import numpy as np

from maplab_py.array_types import I64
from maplab_py.errors import MapError, UserError
from maplab_py.report import counted

_LARGEST_STEP_NS = 86_400_000_000_000
"""Stamps that lie further ahead are of another clock."""
_RESTART_COUNT, _RESTART_NS = 5, 400_000_000
"""A run of so many stamps over such a time is a clock that has started again, not late messages."""
_LATE_SHARE, _EVEN = 0.01, 3.0
"""Rows out of order up to which a table counts as sorted; largest step of one that was not, in medians."""

T = TypeVar("T")


class ClockRestart(MapError):
    """The clock of a recording starts again, and no part of it is chosen."""


@dataclasses.dataclass(frozen=True)
class Dropped:
    """A stamp that was left out, and the one before it; None where values beside it are no numbers."""

    stamp_ns: int
    before_ns: int | None


@dataclasses.dataclass
class Run:
    """Stamps between two starts of a clock."""

    count: int = 0
    first_ns: int = 0
    last_ns: int = 0
    first_arrival_ns: int = 0
    last_arrival_ns: int = 0

    def add(self, time_ns: int, arrival_ns: int) -> None:
        """Add a message."""
        if not self.count:
            self.first_ns, self.first_arrival_ns = time_ns, arrival_ns
        self.count, self.last_ns, self.last_arrival_ns = self.count + 1, time_ns, arrival_ns


class ClockFilter(Generic[T]):
    """Passes items of one sensor whose stamps increase, in the order of arrival."""

    def __init__(self, first_ns: int | None = None) -> None:
        """Start; stamps before `first_ns` are left out."""
        # dropped: items that were left out
        # part: number of the clock's run, from 0
        self.part, self.dropped = 0, 0
        self.first: Dropped | None = None  # the first of them
        self.restart: Dropped | None = None  # stamps after and before the last start of the clock
        self._first_ns = first_ns
        self._last_ns = None if first_ns is None else first_ns - 1
        self._waiting: list[tuple[int, T]] = []  # out of line: late, or the beginning of a part

    def passes(self, stamp_ns: int) -> bool:
        """Take a stamp that simply comes after the one before it; others are for `push`."""
        last_ns = self._last_ns
        if last_ns is None or self._waiting or not 0 < stamp_ns - last_ns <= _LARGEST_STEP_NS:
            return False  # as `follows`, which is called too often here
        self._last_ns = stamp_ns
        return True

    def push(self, stamp_ns: int, item: T) -> list[tuple[int, T]]:
        """Take the next item; return those that are in line now, with their stamps."""
        if self._last_ns is None or follows(self._last_ns, stamp_ns):
            if self._waiting:
                self._drop()
            self._last_ns = stamp_ns
            return [(stamp_ns, item)]
        if self._waiting and not follows(self._waiting[-1][0], stamp_ns):
            self._drop()
        self._waiting.append((stamp_ns, item))
        span_ns = stamp_ns - self._waiting[0][0]
        if len(self._waiting) < _RESTART_COUNT or span_ns < _RESTART_NS:
            return []
        self.restart = Dropped(self._waiting[0][0], self._last_ns)
        self.part, self._first_ns, self._last_ns = self.part + 1, None, stamp_ns
        ready, self._waiting = self._waiting, []
        return ready

    def finish(self) -> None:
        """Leave out what still waits at the end."""
        self._drop()

    def leave_out(self, stamp_ns: int, before_ns: int | None = None) -> None:
        """Count an item that is left out; without a stamp before it for its values."""
        self.dropped += 1
        self.first = self.first or Dropped(stamp_ns, before_ns)

    def _drop(self) -> None:
        before_ns = max(self._last_ns or 0, self._first_ns or 0)
        for stamp_ns, _ in self._waiting:
            self.leave_out(stamp_ns, before_ns)
        self._waiting = []


def is_within(time_ns: int, start_ns: int | None, end_ns: int | None) -> bool:
    """Return whether a time lies in a half-open span; None = no bound."""
    return (start_ns is None or time_ns >= start_ns) and (end_ns is None or time_ns < end_ns)


def follows(before_ns: int, stamp_ns: int) -> bool:
    """Return whether a stamp comes after another, of the same clock."""
    return 0 < stamp_ns - before_ns <= _LARGEST_STEP_NS


def first_stamp_ns(stamps_ns: list[int]) -> int:
    """Return the first stamp that the one after it follows, of the first stamps of a sensor."""
    for before, after in itertools.pairwise(stamps_ns):
        if follows(before, after):
            return before
    return stamps_ns[0]


def parts_of(stamps_ns: I64) -> tuple[list[I64], I64]:
    """Return the rows of each part of a table, and the rows that are left out."""
    rows = np.arange(len(stamps_ns))
    steps_ns = np.diff(stamps_ns)
    if np.all((steps_ns > 0) & (steps_ns <= _LARGEST_STEP_NS)):
        return [rows], rows[:0]
    clock: ClockFilter[int] = ClockFilter(first_stamp_ns(stamps_ns[:_RESTART_COUNT].tolist()))
    parts: list[list[int]] = [[]]
    for row, stamp_ns in enumerate(stamps_ns.tolist()):
        ready = clock.push(stamp_ns, row)
        if clock.part == len(parts):
            parts.append([])
        parts[-1].extend(number for _, number in ready)
    kept = [np.array(part, dtype=np.int64) for part in parts]
    return kept, np.setdiff1d(rows, np.concatenate(kept))


def order_of_time(stamps_ns: I64) -> I64:
    """Return the rows of a table in the order in which they are read: that of time, of an unsorted file.

    A file is unsorted, and has no late rows and no clock that starts again, if sorting gives even steps.
    """
    rows, steps_ns = np.arange(len(stamps_ns)), np.diff(stamps_ns)
    if np.count_nonzero(steps_ns < 0) <= _LATE_SHARE * len(stamps_ns):
        return rows
    order = np.argsort(stamps_ns, kind="stable")
    sorted_ns = np.diff(stamps_ns[order])
    is_even = sorted_ns.min() > 0 and sorted_ns.max() <= _EVEN * np.median(sorted_ns)
    return np.asarray(order if is_even else rows)


def check_dropped(
    name: str, dropped: int, count: int, first: Dropped | None, share: float, remedy: str = ""
) -> None:
    """Check that no more items are left out than a share of all; `remedy` helps where stamps are wrong.

    Raises:
        MapError: There are more; names the first one and the flags that help.
    """
    if first is not None and dropped > math.ceil(share * count):
        reason = (
            f"samples are left out, the one at {first.stamp_ns} is no number"
            if first.before_ns is None
            else "stamps do not come after the one before them, the first is "
            f"{first.stamp_ns} after {first.before_ns}"
        )
        raise MapError(
            f"{name}: {dropped} of {count} {reason}: skip them by --vio_rosbag_start_s and "
            f"--vio_rosbag_end_s, or raise --max_late_share={share:g}"
            + remedy
            * (first.before_ns is not None)
        )


def dropped_note(name: str, dropped: int, first: Dropped | None) -> str:
    """Return a line on items that were left out."""
    if first is not None and first.before_ns is None:
        return f"{name}: left out {dropped} that are no numbers, the first at {first.stamp_ns}"
    where = f", the first is {first.stamp_ns} beside {first.before_ns}" if first is not None else ""
    return f"{name}: left out {dropped} with repeated, late or wild stamps{where}"


def restart_error(name: str, restart: Dropped) -> ClockRestart:
    """Return the error that a clock starts again."""
    return ClockRestart(
        f"{name}: the clock starts again: {restart.stamp_ns} comes after {restart.before_ns}: recording_info "
        "lists the parts, --recording_part=N reads one of them"
    )


def check_common_time(
    name: str,
    imu_ns: tuple[int, int],
    images_ns: tuple[int, int],
    proposal: str,
    *,
    is_apart: bool = False,
) -> None:
    """Check that the spans (first, last) of IMU and images have some time in common.

    Args:
        images_ns: Times of the images in the clock of the IMU.
        proposal: Shift of the images that would help, and why.
        is_apart: Only one of their clocks has started again, and no shift was given.

    Raises:
        MapError: They have none, or are of clocks that differ.
    """
    is_common = imu_ns[0] <= images_ns[1] and images_ns[0] <= imu_ns[1]
    if is_common and not is_apart:
        return
    reason = (
        "only one of the clocks of IMU and images starts again before this part"
        if is_apart
        else "IMU and images have no time in common"
    )
    raise MapError(
        f"{name}: {reason}: the IMU is from {imu_ns[0]} to {imu_ns[1]} ns, the images from {images_ns[0]} to "
        f"{images_ns[1]} ns: if only a clock is shifted, give --imu_to_camera_time_offset_ns ({proposal})"
    )


def check_part(name: str, part: int, count: int) -> None:
    """Check that a recording has a part.

    Raises:
        UserError: There is no such part.
    """
    if part > count:
        raise UserError(
            f"{name}: --recording_part={part}: the recording has {counted(count, 'part')}"
        )


def common_part_count(name: str, imu: int | None, cameras: Sequence[int]) -> int:
    """Return into how many parts a recording falls whose IMU or cameras have restarting clocks.

    A clock that never starts again beside others that do is divided where they start again.

    Raises:
        MapError: The sensors have different numbers of parts.
    """
    counts: set[int] = {*cameras, *(() if imu is None else (imu,))}
    if len(set(cameras)) > 1:
        listed = ", ".join(f"camera {row} {count}" for row, count in enumerate(cameras))
        raise MapError(
            f"{name}: the clocks of the cameras do not start again together (parts: {listed}): read "
            "cameras of one clock with --rovio_active_camera_indices"
        )
    if len(counts - {1}) > 1:
        raise MapError(
            f"{name}: the clocks of the sensors do not start again together (parts: IMU {imu}, cameras "
            f"{cameras[0]}): without --recording_part the first part is read, --vio_rosbag_end_s ends it"
        )
    return max(counts)


def listed_rows(numbers: I64) -> Iterator[str]:
    """Yield line numbers as ranges, as in "7" or "285-289"."""
    for run in np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1):
        yield str(run[0]) if len(run) == 1 else f"{run[0]}-{run[-1]}"
