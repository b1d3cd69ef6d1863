"""Frames before the start: kept while the odometry waits, and read backwards from a known state.

Reading backwards is the same estimation with time reversed: accelerations and attitudes stay as they are,
velocities, angular velocities and the gyroscope's bias change their sign.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.errors import EstimationError
from maplab_py.estimation.window.frame import Motion, StartState, WindowFrame
from maplab_py.estimation.window.smoother import FixedLagSmoother
from maplab_py.frontend.body_states import BodyStates

_LONGEST_S = 120.0
"""Frames that are older are forgotten: they would need memory without limit."""
_REVERSED_GYRO = np.array([1.0, 1.0, 1.0, -1.0, -1.0, -1.0])


@dataclasses.dataclass(frozen=True, eq=False)
class Backfill:
    """States of consecutive frames, from before the start to after it, in the order of time."""

    stamps_ns: I64  # (N,) of the images, without a delay that was estimated
    states: BodyStates  # (N,)
    frames: tuple[WindowFrame, ...]  # (N,) with the samples that lead to each


class WaitingFrames:
    """The latest frames without states, with all samples between them."""

    def __init__(self) -> None:
        """Begin without frames."""
        self.frames: list[WindowFrame] = []
        self.stamps_ns: list[int] = []
        self._before: tuple[I64, F64] = (np.zeros(0, dtype=np.int64), np.zeros((0, 6)))

    def push(self, stamp_ns: int, frame: WindowFrame, before: tuple[I64, F64]) -> None:
        """Add a frame; one without samples that lead to it is the first.

        Args:
            stamp_ns: Of its images.
            frame: The frame.
            before: Samples (S,), (S, 6) up to it, if it is the first.
        """
        if not self.frames or len(frame.imu_times_ns) < 3:
            self.frames, self.stamps_ns, self._before = [], [], before
        self.frames.append(frame)
        self.stamps_ns.append(stamp_ns)
        while frame.time_ns - self.frames[0].time_ns > _LONGEST_S * 1e9:
            del self.frames[0], self.stamps_ns[0]

    def samples(self) -> tuple[I64, F64]:
        """Return the samples (S,), (S, 6) from the first frame to the newest."""
        parts = [(frame.imu_times_ns[1:-1], frame.accel_gyro[1:-1]) for frame in self.frames[1:]]
        return (
            np.concatenate([times_ns for times_ns, _ in parts]),
            np.concatenate([values for _, values in parts]),
        )

    def delay(self, delay_ns: int, after: tuple[I64, F64]) -> None:
        """Cut the samples again at frames that are all later by a delay.

        Frames that no sample comes before are forgotten.

        Args:
            delay_ns: The delay; may be negative.
            after: Samples (S,), (S, 6) beyond the newest frame.
        """
        parts = [self._before, *((f.imu_times_ns, f.accel_gyro) for f in self.frames[1:]), after]
        times_ns, rows = np.unique(np.concatenate([t for t, _ in parts]), return_index=True)
        samples = np.concatenate([values for _, values in parts])[rows]
        frames, stamps_ns = self.frames, self.stamps_ns
        self.frames, self.stamps_ns = [], []
        for frame, stamp_ns in zip(frames, stamps_ns, strict=True):
            at_ns = frame.time_ns + delay_ns
            if not times_ns[0] <= at_ns <= times_ns[-1]:
                continue
            from_ns = self.frames[-1].time_ns if self.frames else at_ns
            cut_ns, cut = _cut(times_ns, samples, from_ns, at_ns)
            self.frames.append(
                dataclasses.replace(frame, time_ns=at_ns, imu_times_ns=cut_ns, accel_gyro=cut)
            )
            self.stamps_ns.append(stamp_ns)


def _cut(times_ns: I64, samples: F64, from_ns: int, to_ns: int) -> tuple[I64, F64]:
    """Return the samples from one time to another, interpolated at both."""
    inside = slice(
        int(np.searchsorted(times_ns, from_ns, side="right")), int(np.searchsorted(times_ns, to_ns))
    )
    cut_ns = np.concatenate([[from_ns], times_ns[inside], [to_ns]]).astype(np.int64)
    columns = [np.interp(cut_ns, times_ns, column) for column in samples.T]
    return cut_ns, np.stack(columns, axis=1)


class BackwardReading:
    """Estimates frames backwards, a few at a time."""

    def __init__(
        self,
        smoother: FixedLagSmoother,
        waiting: WaitingFrames,
        state: StartState,
        later: list[BodyStates],
        *,
        is_resting: bool,
    ) -> None:
        """Prepare.

        Args:
            smoother: A new one.
            waiting: The frames.
            state: State of one of them.
            later: States of those that come after it, all in the order of time.
            is_resting: Frames say truly whether the device rests.
        """
        self._smoother, self._waiting = smoother, waiting
        self._frames = waiting.frames[: len(waiting.frames) - len(later)]
        self._is_resting = is_resting
        self._row = len(self._frames) - 1  # of the frame that was read last
        self._origin_ns = self._frames[-1].time_ns
        self._states = {int(of_frame.times_ns[0]): of_frame for of_frame in later}
        reversed_state = dataclasses.replace(state, v_M=-state.v_M, gyro_bias=-state.gyro_bias)
        smoother.start(self._reversed(self._row), reversed_state)

    @property
    def is_finished(self) -> bool:
        """Whether all frames have been read, or the estimate has failed."""
        return self._row == 0

    def advance(self, frames: int) -> None:
        """Read some frames."""
        for _ in range(min(frames, self._row)):
            try:
                update = self._smoother.add(self._reversed(self._row - 1))
            except EstimationError:
                self._row = 0
                return
            self._row -= 1
            past = update.released
            motion = np.concatenate([past.v_M, past.gyro_bias, past.accel_bias], axis=1)
            self._keep(past.time_ns, past.T_M_I, motion)

    def result(self) -> Backfill:
        """Return the states of all frames that have been read."""
        states = self._smoother.states
        self._keep(self._smoother.times_ns, states.T_M_I, states.motion)
        rows = [row for row, f in enumerate(self._waiting.frames) if f.time_ns in self._states]
        frames = [self._waiting.frames[row] for row in rows]
        return Backfill(
            stamps_ns=np.array([self._waiting.stamps_ns[row] for row in rows], dtype=np.int64),
            states=BodyStates.concatenate([self._states[frame.time_ns] for frame in frames]),
            frames=tuple(frames),
        )

    def _keep(self, times_ns: I64, T_M_I: F64, motion: F64) -> None:
        """Keep states (N, 9) of reversed time."""
        for row, time_ns in enumerate((2 * self._origin_ns - times_ns).tolist()):
            v_M, gyro_bias, accel_bias = motion[row].reshape(3, 3)
            self._states[time_ns] = BodyStates.single(
                time_ns, T_M_I[row], -v_M, -gyro_bias, accel_bias
            )

    def _reversed(self, row: int) -> WindowFrame:
        """Return a frame of reversed time, with the samples that lead to it from the one after it."""
        frame, after = self._frames[row], self._frames[min(row + 1, len(self._frames) - 1)]
        return dataclasses.replace(
            frame,
            time_ns=2 * self._origin_ns - frame.time_ns,
            imu_times_ns=2 * self._origin_ns - after.imu_times_ns[::-1],
            accel_gyro=after.accel_gyro[::-1] * _REVERSED_GYRO,
            motion=after.motion if self._is_resting else Motion.MOVING,
        )
