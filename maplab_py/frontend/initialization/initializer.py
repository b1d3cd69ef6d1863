"""Decides when the estimator may start, and from which state."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.errors import UserError
from maplab_py.estimation.window.frame import StartState, WindowFrame
from maplab_py.frontend.initialization.motion import Attempt, Limits, MotionStart, accel_bias_sigma
from maplab_py.frontend.initialization.options import InitializationOptions
from maplab_py.frontend.initialization.segment import History
from maplab_py.frontend.initialization.standstill import motionlessness, start_at_rest
from maplab_py.interop.recordings.protocol import RecordedSensors

_MOST_LENIENT = 3.0
"""Limits grow no further than by this factor while nothing better comes."""
_SCALE_EXPONENT = 2.5
"""The standard deviation of the scale falls about with this power of the time in motion."""
_LONGEST_WAIT_S = (1.0, 5.0)
"""Largest time between attempts while the scale improves, and after a minute without success."""
_WAIT_SHARE = 0.1
"""Time between attempts as a share of the time that has passed since the patience ended."""


class Initializer:
    """Takes frames until the state of the newest is known well enough.

    A device at rest starts by the mean of its samples; one in motion by a closed form and least squares over
    the latest seconds. `reason` says why it has not started yet, `attempt` what the last attempt in
    motion has found.
    """

    def __init__(
        self, device: RecordedSensors, options: InitializationOptions | None = None
    ) -> None:
        """Prepare for the sensors of a device.

        Raises:
            FlagError: An option is wrong.
            UserError: The device has no IMU.
        """
        if device.imu is None:
            raise UserError("the start needs an IMU, and the calibration has none")
        self._options = options or InitializationOptions()
        self._options.check()
        self._imu = device.imu
        self._history = History(self._options.longest_s + 1e-3)
        self._motion = MotionStart(device.cameras, device.T_I_C, device.imu, self._options)
        self._first_ns: int | None = None
        self._next_ns = -1  # time before which there is no further attempt
        self.reason = "no images yet"
        self.attempt: Attempt | None = None

    def push(self, frame: WindowFrame) -> StartState | None:
        """Take the next frame; return its state when the estimator may start with it.

        M has its origin at the IMU and gravity along -z.
        """
        options, history = self._options, self._history
        history.push(frame)
        if len(history) == 1:
            self._first_ns, self._next_ns = frame.time_ns, -1
        frames = history.latest(options.rest_s + 1e-3)
        duration_s = (frames[-1].time_ns - frames[0].time_ns) * 1e-9
        if duration_s >= options.rest_s - 0.5 * duration_s / max(len(frames) - 1, 1):
            times_ns, accel_gyro = history.samples(options.rest_s + 1e-3)
            if motionlessness(frames, accel_gyro).is_rest(options):
                self.reason = ""
                sigma = accel_bias_sigma(self._imu, options)
                return start_at_rest(self._imu, times_ns, accel_gyro, sigma)
        return self._start_in_motion(frame)

    def _start_in_motion(self, frame: WindowFrame) -> StartState | None:
        options, history = self._options, self._history
        least_s = options.min_rig_s if _sees_points_twice(frame) else options.min_mono_s
        if history.duration_s < least_s - 5e-3:
            self.reason = f"{history.duration_s:.1f} of {least_s:g} s of images"
            return None
        if frame.time_ns < self._next_ns:
            return None
        has_rig = _sees_points_twice(frame)
        most = options.most_keyframes if has_rig else options.most_mono_keyframes
        interval_s = max(options.keyframe_interval_s, history.duration_s / (most - 1))
        waited_s = (frame.time_ns - (self._first_ns or 0)) * 1e-9
        leniency = min(max(waited_s / options.patience_s, 1.0), _MOST_LENIENT)
        limits = Limits(leniency * options.max_scale_sigma, leniency * options.max_tilt_sigma_deg)
        is_early = not has_rig and waited_s < options.early_s - 5e-3
        if is_early:
            limits = dataclasses.replace(
                limits, scale_sigma=min(limits.scale_sigma, options.early_scale_sigma)
            )
        attempt = self._motion.solve(history.segment(self._motion.imu, interval_s), limits)
        wait_s = self._wait_s(attempt, limits, waited_s)
        if is_early:
            wait_s = min(wait_s, options.early_s - waited_s)
        self._next_ns = frame.time_ns + round((wait_s - 5e-3) * 1e9)
        self.attempt, self.reason = attempt, attempt.reason
        return attempt.state

    def _wait_s(self, attempt: Attempt, limits: Limits, waited_s: float) -> float:
        """Return the time until the next attempt: those that reach the refinement take long."""
        options, refined = self._options, attempt.refined
        if refined is None:
            return options.retry_s
        # when the scale will be known well enough
        missing = float(max(refined.scale_sigma / limits.scale_sigma, 1.0))
        later_s = self._history.duration_s * (missing ** (1.0 / _SCALE_EXPONENT) - 1.0)
        since_s = waited_s - options.patience_s
        wait_s = max(options.retry_s, min(0.75 * later_s, _LONGEST_WAIT_S[0]))
        return float(max(wait_s, min(_WAIT_SHARE * since_s, _LONGEST_WAIT_S[1])))


def _sees_points_twice(frame: WindowFrame) -> bool:
    """Tell whether several cameras see common points."""
    return len(frame.track_id) - len(np.unique(frame.track_id)) >= 10
