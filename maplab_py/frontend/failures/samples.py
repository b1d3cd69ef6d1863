"""Signs of an IMU whose axes repeat a value: stuck, or at a limit that the calibration does not know."""

import collections

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.estimation.window.frame import ImuPart

AXES = ("x", "y", "z")
PARTS = {ImuPart.ACCELEROMETER: slice(0, 3), ImuPart.GYROSCOPE: slice(3, 6)}
_LEAST_STUCK_NS = 200_000_000
_STUCK_FACTOR = 5
_FEWEST_AT_LIMIT = 4
"""Equal samples after which an axis is stuck (so long, and so many times the longest run before), or at a
limit."""
_REMEMBERED = 20
"""Calls, a second of frames, whose extremes an axis at a limit does not exceed: earlier ones may."""


class SampleWatch:
    """Counts equal samples of every axis."""

    def __init__(self) -> None:
        self._last: F64 | None = None
        self._run = np.zeros(6, dtype=np.int64)  # equal samples up to now
        self._run_ns = np.zeros(6, dtype=np.int64)  # time of the first of them
        self._longest = np.ones(6, dtype=np.int64)  # of runs that were no failure
        self._extremes: collections.deque[F64] = collections.deque(maxlen=_REMEMBERED)
        self.signs: dict[ImuPart, tuple[str, int]] = {}  # what is wrong now, and since when
        self.axes = np.zeros(6, dtype=np.bool_)  # that are wrong now

    def push(self, times_ns: I64, accel_gyro: F64) -> None:
        """Take samples (S, 6) as measured, without interpolated ones."""
        if not len(times_ns):
            return
        before = accel_gyro[:1] * np.nan if self._last is None else self._last[None]
        is_new = np.concatenate([before, accel_gyro[:-1]]) != accel_gyro
        row = np.arange(len(times_ns))[:, None]
        start = np.maximum.accumulate(np.where(is_new, row, -1))  # of the run of every sample
        length = np.where(start >= 0, row - start + 1, self._run + row + 1)
        is_over = np.where(self.axes & (start < 0), False, start < start[-1])
        ended = np.where(is_over, length, 0).max(axis=0)
        self._longest = np.maximum(self._longest, ended)
        self._run = length[-1]
        self._run_ns = np.where(start[-1] >= 0, times_ns[start[-1]], self._run_ns)
        self._last = accel_gyro[-1]
        self._extremes.append(np.array([accel_gyro.min(axis=0), accel_gyro.max(axis=0)]))
        self._judge(int(times_ns[-1]))

    def _judge(self, now_ns: int) -> None:
        assert self._last is not None
        duration_ns = now_ns - self._run_ns
        is_live = bool(np.any(self._run <= self._longest))  # the whole IMU does not rest
        is_stuck = (duration_ns > _LEAST_STUCK_NS) & (self._run > _STUCK_FACTOR * self._longest)
        recent = np.array(self._extremes)
        is_extreme = (self._last == recent[:, 0].min(axis=0)) | (
            self._last == recent[:, 1].max(axis=0)
        )
        at_limit = is_extreme & (self._run >= np.maximum(_FEWEST_AT_LIMIT, 2 * self._longest + 1))
        self.axes = (is_stuck | at_limit) & is_live
        self.signs = {}
        for part, columns in PARTS.items():
            rows = np.flatnonzero(self.axes[columns])
            if len(rows):
                names = ", ".join(AXES[row] for row in rows)
                since_ns = int(self._run_ns[columns][rows].min())
                self.signs[part] = f"{names} axis repeats one value, stuck or at a limit", since_ns
