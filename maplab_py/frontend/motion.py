"""Motion that does not show distances: standing still, and turning on the spot."""

from __future__ import annotations

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.estimation.window.frame import Motion
from maplab_py.frontend.imu_buffer import ImuInterval
from maplab_py.frontend.odometry_options import RestOptions

_DISPARITY_TIME_S = 0.1
"""Time that the limit of the disparity is for."""


class MotionDetector:
    """Classifies the motion between frames."""

    def __init__(self, options: RestOptions | None = None) -> None:
        """Start without samples.

        Raises:
            FlagError: An option is wrong.
        """
        self._options = options or RestOptions()
        self._options.check()
        self.reset()

    def reset(self) -> None:
        """Forget the samples."""
        self._times_ns: I64 = np.zeros(0, dtype=np.int64)
        self._acceleration: F64 = np.zeros((0, 3))

    @property
    def acceleration_deviation(self) -> float:
        """Deviation of the accelerometer from its mean [m/s^2]; NaN until there are enough samples.

        It is the root of the summed variances of the three axes.
        """
        if not len(self._times_ns):
            return float("nan")
        span_ns = int(self._times_ns[-1] - self._times_ns[0])
        if span_ns < 0.9 * self._options.imu_time_s * 1e9:
            return float("nan")
        return float(np.sqrt(self._acceleration.var(axis=0).sum()))

    def classify(
        self,
        interval: ImuInterval,
        disparity_px: float,
        *,
        turn_rad: float,
        is_turn_only: bool,
        speed_mps: float,
    ) -> Motion:
        """Return the motion of the interval between two frames.

        A body that turns about its IMU moves neither the accelerometer nor, once the turn is removed,
        the tracks: only the gyroscope tells it from one at rest.

        Args:
            interval: IMU samples between the frames.
            disparity_px: Median disparity of the tracks between the frames, turn removed; NaN =
                unknown.
            turn_rad: Angle of the turn between the frames, without the gyroscope's bias.
            is_turn_only: The tracks agree with a turn without translation.
            speed_mps: Estimated speed before the interval; 0 while nothing has been estimated.
        """
        self._add(interval)
        options = self._options
        per_time = disparity_px * _DISPARITY_TIME_S / interval.duration_s
        if (
            per_time < options.max_disparity_px
            and turn_rad < options.max_turn_rate * interval.duration_s
            and self.acceleration_deviation < options.max_acceleration_deviation
            and speed_mps < options.max_speed
        ):
            return Motion.RESTING
        return Motion.TURNING if is_turn_only else Motion.MOVING

    def _add(self, interval: ImuInterval) -> None:
        """Append samples, and forget those that are too old."""
        begin_ns = int(interval.times_ns[-1]) - round(self._options.imu_time_s * 1e9)
        # an interval repeats the last sample of the one before
        times_ns = np.concatenate([self._times_ns[:-1], interval.times_ns])
        acceleration = np.concatenate([self._acceleration[:-1], interval.accel_gyro[:, :3]])
        kept = times_ns >= begin_ns
        self._times_ns, self._acceleration = times_ns[kept], acceleration[kept]
