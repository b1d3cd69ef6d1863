"""Decides when the estimator may start, and from which state."""

import dataclasses

import numpy as np

from maplab_py.errors import UserError
from maplab_py.estimation.linear.threads import single_thread
from maplab_py.estimation.window.frame import WindowFrame
from maplab_py.frontend.initialization import paced_work, segment, standstill
from maplab_py.frontend.initialization.motion import Attempt, Limits, MotionStart, accel_bias_sigma
from maplab_py.frontend.initialization.options import InitializationOptions
from maplab_py.frontend.starting import Start
from maplab_py.interop.recordings.protocol import RecordedSensors
from maplab_py.vision.tracking.views import focal_length_px

_MOST_LENIENT = 3.0
"""Limits grow no further than by this factor while nothing better comes."""
_SCALE_EXPONENT = 2.5
"""The standard deviation of the scale falls about with this power of the time in motion."""
_LONGEST_WAIT_S = (1.0, 5.0)
"""Largest time between attempts while the scale improves, and after a minute without success."""
_WAIT_SHARE = 0.1
"""Time between attempts as a share of the time that has passed since the patience ended."""
_UNITS_PER_S, _MOST_UNITS = 900.0, 60.0
"""Units of work of an attempt for each second between frames, and the most that a frame does."""
_ATTEMPT_FRAMES = 3.0
"""Frames over which an attempt is spread: where it has to end by some time it begins so much earlier."""


@dataclasses.dataclass(frozen=True, eq=False)
class _Pending:
    """An attempt in motion under way."""

    frame: WindowFrame  # whose state it looks for
    work: paced_work.PacedWork[Attempt]
    limits: Limits
    waited_s: float  # when it began
    early_s: float  # until larger deviations are allowed
    duration_s: float  # of the frames that it may use
    later: list[WindowFrame] = dataclasses.field(default_factory=list)


class Initializer:
    """Takes frames until the state of the newest is known well enough.

    A device at rest starts by the mean of its samples; one in motion by a closed form and least squares over
    the latest seconds. Such an attempt is spread over some frames, and gives the state of the frame with
    which it began (see decision 22). `reason` says why it has not started yet, `attempt` what the last
    attempt in motion has found.
    """

    def __init__(
        self, device: RecordedSensors, options: InitializationOptions | None = None
    ) -> None:
        """Prepare for the sensors of a device.

        Raises:
            UserError: The device has no IMU.
        """
        if device.imu is None:
            raise UserError("the start needs an IMU, and the calibration has none")
        self._options = options or InitializationOptions()
        self._imu = device.imu
        self._focal_px = min(focal_length_px(camera) for camera in device.cameras)
        self._history = segment.History(self._options.longest_s + 1e-3)
        self._motion = MotionStart(device.cameras, device.T_I_C, device.imu, self._options)
        self._first_ns: int | None = None
        self._next_ns = -1  # time before which there is no further attempt
        self._pending: _Pending | None = None
        self.reason = "no images yet"
        self.attempt: Attempt | None = None

    def push(self, frame: WindowFrame) -> Start | None:
        """Take the next frame; return a start when the estimator may start.

        M has its origin at the IMU and gravity along -z.
        """
        options, history = self._options, self._history
        history.push(frame)
        if len(history) == 1:
            self._first_ns, self._next_ns, self._pending = frame.time_ns, -1, None
        frames = history.latest(options.rest_s + 1e-3)
        duration_s = (frames[-1].time_ns - frames[0].time_ns) * 1e-9
        if duration_s >= options.rest_s - 0.5 * duration_s / max(len(frames) - 1, 1):
            times_ns, accel_gyro = history.samples(options.rest_s + 1e-3)
            seen = standstill.motionlessness(frames, accel_gyro)
            if seen.is_rest(options):
                self.reason = ""
                sigma = accel_bias_sigma(self._imu, options)
                rate_radps = seen.rate_radps(self._focal_px)
                state = standstill.start_at_rest(
                    self._imu, times_ns, accel_gyro, sigma, rate_radps=rate_radps
                )
                return Start(frame, state, is_resting=True)
        if self._pending is None:
            self._pending = self._begin(frame)
        else:
            self._pending.later.append(frame)
        return None if self._pending is None else self._advance(self._pending)

    def replace_frames(self, frames: list[WindowFrame]) -> None:
        """Exchange all frames so far by the same with other times."""
        self._history = segment.History(self._options.longest_s + 1e-3)
        for frame in frames:
            self._history.push(frame)
        self._first_ns = frames[0].time_ns if frames else None
        self._next_ns, self._pending = -1, None

    def _begin(self, frame: WindowFrame) -> _Pending | None:
        """Begin an attempt in motion if it is time to."""
        options, history = self._options, self._history
        has_rig = _sees_points_twice(frame)
        least_s = options.min_rig_s if has_rig else options.min_mono_s
        if history.duration_s < least_s - 5e-3:
            self.reason = f"{history.duration_s:.1f} of {least_s:g} s of images"
            return None
        if frame.time_ns < self._next_ns:
            return None
        most = options.most_keyframes if has_rig else options.most_mono_keyframes
        interval_s = max(options.keyframe_interval_s, history.duration_s / (most - 1))
        waited_s = (frame.time_ns - (self._first_ns or 0)) * 1e-9
        leniency = min(max(waited_s / options.patience_s, 1.0), _MOST_LENIENT)
        limits = Limits(leniency * options.max_scale_sigma, leniency * options.max_tilt_sigma_deg)
        early_s, until_s = np.inf, options.early_s - _ATTEMPT_FRAMES * _interval_s(frame)
        if not has_rig and waited_s < until_s - 5e-3:
            early_s = until_s - waited_s
            if early_s < options.retry_s - 5e-3:
                return None  # it would still be under way when larger deviations are allowed
            limits = dataclasses.replace(
                limits, scale_sigma=min(limits.scale_sigma, options.early_scale_sigma)
            )
        work = paced_work.PacedWork(
            self._motion.solving(history.segment(self._motion.imu, interval_s), limits)
        )
        return _Pending(frame, work, limits, waited_s, early_s, history.duration_s)

    def _advance(self, pending: _Pending) -> Start | None:
        """Do a frame's share of an attempt; return a start if it ends with one."""
        options = self._options
        newest = pending.later[-1] if pending.later else pending.frame
        units = min(_UNITS_PER_S * _interval_s(newest), _MOST_UNITS)
        with single_thread():
            attempt = pending.work.advance(units)
        if attempt is None:
            return None
        self._pending = None
        wait_s = min(self._wait_s(attempt, pending), pending.early_s)
        if pending.waited_s < options.provisional_s:
            wait_s = min(wait_s, max(options.provisional_s - pending.waited_s, options.retry_s))
        self._next_ns = pending.frame.time_ns + round((wait_s - 5e-3) * 1e9)
        self.attempt, self.reason = attempt, attempt.reason
        later = tuple(pending.later)
        if attempt.state is not None:
            return Start(pending.frame, attempt.state, later)
        waits_s = options.provisional_s
        if attempt.scale_sigma < options.provisional_scale_sigma:
            waits_s = options.promising_s - _ATTEMPT_FRAMES * _interval_s(pending.frame)
        if attempt.provisional is None or pending.waited_s < waits_s - 5e-3:
            return None
        return Start(pending.frame, attempt.provisional, later, scale_sigma=attempt.scale_sigma)

    def _wait_s(self, attempt: Attempt, pending: _Pending) -> float:
        """Return the time until the next attempt: those that reach the refinement take long."""
        options, refined, limits = self._options, attempt.refined, pending.limits
        if refined is None:
            return options.retry_s
        # when the scale will be known well enough
        missing = float(max(refined.scale_sigma / limits.scale_sigma, 1.0))
        later_s = pending.duration_s * (missing ** (1.0 / _SCALE_EXPONENT) - 1.0)
        since_s = pending.waited_s - options.patience_s
        wait_s = max(options.retry_s, min(0.75 * later_s, _LONGEST_WAIT_S[0]))
        return float(max(wait_s, min(_WAIT_SHARE * since_s, _LONGEST_WAIT_S[1])))


def _interval_s(frame: WindowFrame) -> float:
    """Return the time since the frame before."""
    return float(frame.imu_times_ns[-1] - frame.imu_times_ns[0]) * 1e-9


def _sees_points_twice(frame: WindowFrame) -> bool:
    """Tell whether several cameras see common points."""
    return len(frame.track_id) - len(np.unique(frame.track_id)) >= 10
