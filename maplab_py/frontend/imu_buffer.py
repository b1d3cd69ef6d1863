"""IMU samples that wait for images: cut and interpolated at the times of frames."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.errors import MapError
from maplab_py.interop.recordings.protocol import ImuBatch


@dataclasses.dataclass(frozen=True, eq=False)
class ImuInterval:
    """Samples between two frames; the first and last are interpolated at the times of the frames."""

    times_ns: I64  # (S,) both ends included
    accel_gyro: F64  # (S, 6) as measured
    largest_step_ns: int  # between the measured samples that the interval needs

    @property
    def duration_s(self) -> float:
        """Length of the interval."""
        return float(self.times_ns[-1] - self.times_ns[0]) * 1e-9


_KEPT_NS = 300_000_000
"""Used samples are kept for so long: frames that turn out to be earlier than their stamps need them."""


class ImuBuffer:
    """Samples that no interval has used yet, and the latest that one has."""

    def __init__(self) -> None:
        self._times_ns = np.zeros(0, dtype=np.int64)
        self._accel_gyro = np.zeros((0, 6))

    @property
    def first_ns(self) -> int | None:
        """Time of the oldest sample, None if there is none."""
        return int(self._times_ns[0]) if len(self._times_ns) else None

    @property
    def last_ns(self) -> int | None:
        """Time of the newest sample, None if there is none."""
        return int(self._times_ns[-1]) if len(self._times_ns) else None

    def push(self, batch: ImuBatch) -> None:
        """Append samples.

        Raises:
            MapError: Their times do not increase, or a value is not a number.
        """
        times_ns = batch.times_ns
        if len(self._times_ns):
            times_ns = np.concatenate([self._times_ns[-1:], times_ns])
        late = np.flatnonzero(np.diff(times_ns) <= 0)
        if len(late):
            raise MapError(
                f"the IMU sample at {times_ns[late[0] + 1]} ns does not come after the sample at "
                f"{times_ns[late[0]]} ns: send samples in the order of their stamps, each once"
            )
        bad = np.flatnonzero(~np.isfinite(batch.accel_gyro).all(axis=1))
        if len(bad):
            raise MapError(
                f"the IMU sample at {batch.times_ns[bad[0]]} ns has a value that is not a number: "
                "leave it out"
            )
        self._times_ns = np.concatenate([self._times_ns, batch.times_ns])
        self._accel_gyro = np.concatenate([self._accel_gyro, batch.accel_gyro])

    @property
    def samples(self) -> tuple[I64, F64]:
        """Return times (S,) and samples (S, 6)."""
        return self._times_ns, self._accel_gyro

    def covers(self, time_ns: int) -> bool:
        """Tell whether there is a sample at this time or later."""
        return self.last_ns is not None and time_ns <= self.last_ns

    def cut(self, from_ns: int, to_ns: int) -> ImuInterval:
        """Return the samples from one time to a later one, and forget those long before the end.

        Raises:
            ValueError: The samples do not reach from the one time to the other.
        """
        times_ns = self._times_ns
        if not len(times_ns) or not times_ns[0] <= from_ns < to_ns <= times_ns[-1]:
            raise ValueError(f"the samples do not reach from {from_ns} to {to_ns} ns")
        first = int(np.searchsorted(times_ns, from_ns, side="right")) - 1
        last = int(np.searchsorted(times_ns, to_ns, side="left"))
        inside = slice(first + 1, last)
        ends = self._at(np.array([from_ns, to_ns], dtype=np.int64))
        samples = np.concatenate([ends[:1], self._accel_gyro[inside], ends[1:]])
        needed = slice(first, last + 1)
        interval = ImuInterval(
            np.concatenate([[from_ns], times_ns[inside], [to_ns]]).astype(np.int64),
            samples,
            int(np.diff(times_ns[needed]).max()),
        )
        self.forget_before(to_ns)
        return interval

    def forget_before(self, time_ns: int) -> None:
        """Forget samples that are not needed to interpolate shortly before this time or later."""
        kept = int(np.searchsorted(self._times_ns, time_ns - _KEPT_NS, side="right")) - 1
        kept = max(0, kept)
        self._times_ns = self._times_ns[kept:]
        self._accel_gyro = self._accel_gyro[kept:]

    def _at(self, query_ns: I64) -> F64:
        """Return samples (Q, 6) interpolated linearly at times within those of the samples."""
        times_ns = self._times_ns
        right = np.clip(np.searchsorted(times_ns, query_ns, side="left"), 1, len(times_ns) - 1)
        left = right - 1
        share = (query_ns - times_ns[left]) / (times_ns[right] - times_ns[left])
        low, high = self._accel_gyro[left], self._accel_gyro[right]
        return np.asarray(low + share[:, None] * (high - low))


def joined_samples(parts: Sequence[tuple[I64, F64]]) -> tuple[I64, F64]:
    """Join times (S,) and samples (S, 6) of pieces that begin with the last sample of the one before."""
    if not parts:
        return np.zeros(0, dtype=np.int64), np.zeros((0, 6))
    times_ns, samples = zip(*parts, strict=True)
    return (
        np.concatenate([times_ns[0], *(later[1:] for later in times_ns[1:])]),
        np.concatenate([samples[0], *(later[1:] for later in samples[1:])]),
    )
