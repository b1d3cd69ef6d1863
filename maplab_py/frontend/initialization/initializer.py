"""Decides when the estimator may start, and from which state."""

from __future__ import annotations

import numpy as np

from maplab_py.errors import UserError
from maplab_py.estimation.window.frame import StartState, WindowFrame
from maplab_py.frontend.initialization.motion import MotionStart, accel_bias_sigma
from maplab_py.frontend.initialization.options import InitializationOptions
from maplab_py.frontend.initialization.segment import History
from maplab_py.frontend.initialization.standstill import motionlessness, start_at_rest
from maplab_py.interop.recordings.protocol import RecordedSensors

_MOST_LENIENT = 3.0
"""Limits grow no further than by this factor while nothing better comes."""


class Initializer:
    """Takes frames until the state of the newest is known well enough.

    A device at rest starts by the mean of its samples; one in motion by a closed form and least squares over
    the latest seconds. `reason` says why it has not started yet.
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
        self._tried_ns: int | None = None
        self.reason = "no images yet"

    def push(self, frame: WindowFrame) -> StartState | None:
        """Take the next frame; return its state when the estimator may start with it.

        M has its origin at the IMU and gravity along -z.
        """
        options, history = self._options, self._history
        history.push(frame)
        if len(history) == 1:
            self._first_ns, self._tried_ns = frame.time_ns, None
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
        if self._tried_ns is not None and frame.time_ns - self._tried_ns < options.retry_s * 1e9:
            return None
        self._tried_ns = frame.time_ns
        interval_s = max(
            options.keyframe_interval_s, history.duration_s / (options.most_keyframes - 1)
        )
        waited_s = (frame.time_ns - (self._first_ns or 0)) * 1e-9
        leniency = min(max(waited_s / options.patience_s, 1.0), _MOST_LENIENT)
        attempt = self._motion.solve(history.segment(self._motion.imu, interval_s), leniency)
        self.reason = attempt.reason
        return attempt.state


def _sees_points_twice(frame: WindowFrame) -> bool:
    """Tell whether several cameras see common points."""
    return len(frame.track_id) - len(np.unique(frame.track_id)) >= 10
