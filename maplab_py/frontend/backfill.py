"""Frames before the start: kept while the odometry waits, and read backwards once the scale is known.

Reading backwards is the same estimation with time reversed: accelerations and attitudes stay as they are,
velocities, angular velocities and the gyroscope's bias change their sign.
"""

import dataclasses
from collections.abc import Callable

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.errors import EstimationError
from maplab_py.estimation.window.frame import Motion, StartState, WindowFrame
from maplab_py.estimation.window.smoother import FixedLagSmoother
from maplab_py.frontend.starting import Start
from maplab_py.vimap.nav_state import NavState

_LONGEST_S = 120.0
"""Frames that are older are forgotten: they would need memory without limit."""
_FRAMES_PER_FRAME = 2
"""Frames that are read backwards with each new frame."""
_TRUSTED_SCALE_SIGMA = 0.05
_SCALE_CHECK_S = 0.5
"""Time between two looks at the scale."""
_POSITION_SIGMA_M = 1e-4
_REVERSED_GYRO = np.array([1.0, 1.0, 1.0, -1.0, -1.0, -1.0])


@dataclasses.dataclass(frozen=True, eq=False)
class Backfill:
    """States of consecutive frames, from before the start to after it, in the order of time."""

    stamps_ns: I64  # (N,) of the images, without a delay that was estimated
    states: NavState  # (N,)
    frames: tuple[WindowFrame, ...]  # (N,) with the samples that lead to each


class WaitingFrames:
    """The latest frames without states, with all samples between them."""

    def __init__(self) -> None:
        self.frames: list[WindowFrame] = []
        self.stamps_ns: list[int] = []
        self._before: tuple[I64, F64] = (np.zeros(0, dtype=np.int64), np.zeros((0, 6)))

    def push(self, stamp_ns: int, frame: WindowFrame, before: tuple[I64, F64]) -> None:
        """Add a frame; one without samples that lead to it is the first.

        Args:
            stamp_ns: Of its images.
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

    def delay(self, delay_ns: int, after: tuple[I64, F64], delay_s: float) -> None:
        """Cut the samples again at frames that are all later by a delay.

        Frames that no sample comes before are forgotten.

        Args:
            delay_ns: The delay; may be negative.
            after: Samples (S,), (S, 6) beyond the newest frame.
            delay_s: That of all frames from now on; see `WindowFrame`.
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
            cut_ns, cut = cut_samples(times_ns, samples, from_ns, at_ns)
            self.frames.append(
                dataclasses.replace(
                    frame, time_ns=at_ns, imu_times_ns=cut_ns, accel_gyro=cut,
                    delay_s=delay_s,
                )
            )  # fmt: skip
            self.stamps_ns.append(stamp_ns)


def cut_samples(times_ns: I64, samples: F64, from_ns: int, to_ns: int) -> tuple[I64, F64]:
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
        later: list[NavState],
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
        self._states = {int(of_frame.time_ns[0]): of_frame for of_frame in later}
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
            self._keep(update.released)

    def result(self) -> Backfill:
        """Return the states of all frames that have been read."""
        states = self._smoother.states
        self._keep(NavState.of_motion(self._smoother.times_ns, states.T_M_I, states.motion))
        rows = [row for row, f in enumerate(self._waiting.frames) if f.time_ns in self._states]
        frames = [self._waiting.frames[row] for row in rows]
        return Backfill(
            stamps_ns=np.array([self._waiting.stamps_ns[row] for row in rows], dtype=np.int64),
            states=NavState.stack([self._states[frame.time_ns] for frame in frames]),
            frames=tuple(frames),
        )

    def _keep(self, past: NavState) -> None:
        """Keep states of reversed time."""
        states = NavState(
            2 * self._origin_ns - past.time_ns,
            past.T_M_I,
            -past.v_M,
            -past.gyro_bias,
            past.accel_bias,
        )
        for row, time_ns in enumerate(states.time_ns.tolist()):
            self._states[time_ns] = states.row(row)

    def _reversed(self, row: int) -> WindowFrame:
        """Return a frame of reversed time, with the samples that lead to it from the one after it."""
        frame, after = self._frames[row], self._frames[min(row + 1, len(self._frames) - 1)]
        return dataclasses.replace(
            frame,
            time_ns=2 * self._origin_ns - frame.time_ns,
            imu_times_ns=2 * self._origin_ns - after.imu_times_ns[::-1],
            accel_gyro=after.accel_gyro[::-1] * _REVERSED_GYRO,
            motion=after.motion if self._is_resting else Motion.MOVING,
            delay_s=-frame.delay_s,
        )


class Backfiller:
    """Keeps frames until the scale is known, and then reads them backwards beside the new ones."""

    def __init__(self, make_smoother: Callable[[], FixedLagSmoother], *, is_wanted: bool) -> None:
        """Begin without frames.

        Args:
            make_smoother: Makes a smoother that reads backwards.
            is_wanted: Read backwards; otherwise the scale is looked at only.
        """
        self.waiting = WaitingFrames()
        self.trusted_ns: int | None = None  # since when the scale of this mission is known
        self.scale_sigma = 0.0  # as a share of the scale, when it was looked at last
        self._make_smoother, self._is_wanted = make_smoother, is_wanted
        self._reading: BackwardReading | None = None
        self._scale_check_ns: int | None = None  # time of the next; None = the scale is trusted

    @property
    def is_reading(self) -> bool:
        """Whether frames are being read backwards."""
        return self._reading is not None

    @property
    def is_idle(self) -> bool:
        """Whether the scale is known, and no frames are read backwards."""
        return self._reading is None and self._scale_check_ns is None

    def reset(self) -> None:
        """Forget the frames, for a new start."""
        self.waiting, self._reading = WaitingFrames(), None
        self._scale_check_ns = None

    def start(self, start: Start, newest: NavState, later: list[NavState]) -> None:
        """Read backwards from a start, or watch its scale while that is not known.

        Args:
            newest: State of the newest frame.
            later: States of the frames that have come since the start, to the newest.
        """
        newest_ns = int(newest.time_ns[0])
        if start.scale_sigma > _TRUSTED_SCALE_SIGMA:
            self._scale_check_ns, self.trusted_ns = newest_ns, None
            return
        self._scale_check_ns, self.trusted_ns = None, newest_ns
        if self._is_wanted and len(self.waiting.frames) > 1 + len(later):
            self._read_from(start.state, later, is_resting=start.is_resting)

    def check_scale(
        self,
        smoother: FixedLagSmoother,
        stamp_ns: int,
        frame: WindowFrame,
        before: tuple[I64, F64],
    ) -> None:
        """Look whether the scale is known now, and begin to read backwards once it is.

        Args:
            smoother: The estimator, with the frame.
            stamp_ns: Of the frame's images.
            frame: The newest frame.
            before: See `WaitingFrames.push`.
        """
        if self._scale_check_ns is None:
            return
        if self._is_wanted:
            self.waiting.push(stamp_ns, frame, before)
        if frame.time_ns < self._scale_check_ns:
            return
        self._scale_check_ns = frame.time_ns + round(_SCALE_CHECK_S * 1e9)
        self.scale_sigma = smoother.scale_sigma()
        if self.scale_sigma <= _TRUSTED_SCALE_SIGMA:
            self.trusted_ns = frame.time_ns
            self._read_from_newest(smoother)

    def advance(self) -> Backfill | None:
        """Read some frames backwards; return all when the last has been read."""
        if self._reading is None:
            return None
        self._reading.advance(_FRAMES_PER_FRAME)
        return self._taken() if self._reading.is_finished else None

    def finish(self, smoother: FixedLagSmoother | None) -> Backfill | None:
        """Read backwards to the end, even with an unknown scale; None when there is nothing left."""
        if self._scale_check_ns is not None and smoother is not None:
            self._read_from_newest(smoother)
        if self._reading is None:
            return None
        self._reading.advance(len(self.waiting.frames))
        return self._taken()

    def _read_from_newest(self, smoother: FixedLagSmoother) -> None:
        """Begin to read backwards from the newest state."""
        self._scale_check_ns = None
        states = smoother.states
        if not self._is_wanted or len(self.waiting.frames) < 2:
            return
        sigma = np.sqrt(np.maximum(np.diagonal(smoother.newest_covariance), 0.0))
        if not np.isfinite(sigma).all():
            return
        sigma[:3] = _POSITION_SIGMA_M
        v_M, gyro_bias, accel_bias = np.split(states.motion[-1:], 3, axis=1)
        state = StartState(
            smoother.times_ns[-1:], states.T_M_I[-1:], v_M, gyro_bias, accel_bias, sigma
        )
        self._read_from(state, [], is_resting=False)

    def _read_from(self, state: StartState, later: list[NavState], *, is_resting: bool) -> None:
        self._reading = BackwardReading(
            self._make_smoother(), self.waiting, state, later, is_resting=is_resting
        )

    def _taken(self) -> Backfill | None:
        """Return what has been read, and stop reading."""
        reading, self._reading = self._reading, None
        return None if reading is None else reading.result()
