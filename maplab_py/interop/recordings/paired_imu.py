"""IMUs whose gyroscope and accelerometer are topics of their own, as RealSense cameras publish them."""

import collections

Sample = tuple[float, ...]
GYRO, ACCEL = 0, 1
"""Parts of two joined topics, in this order."""
_HISTORY = 400


class PairedImu:
    """Joins a topic of the gyroscope with one of the accelerometer; each has its own times.

    The accelerometer's values are interpolated at the times of the gyroscope.
    """

    def __init__(self, history: int | None = _HISTORY) -> None:
        """Start without samples; so many of each topic may wait for the other, None = any."""
        self._gyro: collections.deque[tuple[int, Sample]] = collections.deque(maxlen=history)
        self._accel: collections.deque[tuple[int, Sample]] = collections.deque(maxlen=history)

    def add(self, part: int, time_ns: int, values: Sample) -> list[tuple[int, Sample]]:
        """Take a message of the gyroscope (part 0) or accelerometer (1); return joined samples."""
        if part == GYRO:
            self._gyro.append((time_ns, values[3:]))
        else:
            self._accel.append((time_ns, values[:3]))
        joined = []
        while self._gyro and self._accel and self._gyro[0][0] <= self._accel[-1][0]:
            gyro_ns, gyro = self._gyro.popleft()
            while len(self._accel) > 1 and self._accel[1][0] <= gyro_ns:
                self._accel.popleft()
            if self._accel[0][0] > gyro_ns:
                continue  # before the first of the accelerometer
            joined.append((gyro_ns, (*self._accel_at(gyro_ns), *gyro)))
        return joined

    def _accel_at(self, time_ns: int) -> Sample:
        before_ns, before = self._accel[0]
        if len(self._accel) == 1 or before_ns == time_ns:
            return before
        after_ns, after = self._accel[1]
        share = (time_ns - before_ns) / (after_ns - before_ns)
        return tuple(a + share * (b - a) for a, b in zip(before, after, strict=True))
