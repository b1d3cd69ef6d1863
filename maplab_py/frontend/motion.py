"""Motion that does not show distances: standing still, and turning on the spot."""

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.estimation.window.frame import Motion
from maplab_py.frontend import disparity, imu_buffer, odometry_options
from maplab_py.vision.tracking.tracks import TrackedImages

_DISPARITY_TIME_S = 0.1
"""Time that the limit of the disparity is for."""
_LONG_SHARE = 0.5
"""Limit over half a second, noise removed, as a share of that of two images, which see a start earlier."""
_SURELY = 4.0
_NOISE_FACTOR = 1.25
"""The median disparity of two images is below this multiple of its expectation."""


class MotionDetector:
    """Classifies the motion between frames."""

    def __init__(self, options: odometry_options.RestOptions | None = None) -> None:
        self._options = options or odometry_options.RestOptions()
        self._keypoints = disparity.RecentKeypoints(self._options.imu_time_s)
        self.reset()

    def reset(self) -> None:
        """Forget samples and keypoints."""
        self._keypoints.clear()
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
        interval: imu_buffer.ImuInterval,
        tracked: TrackedImages,
        *,
        turn_rad: float,
        speed_mps: float,
        visible_mps: float = np.inf,
    ) -> Motion:
        """Return the motion of the interval between two frames.

        A body that turns about its IMU moves neither the accelerometer nor, once the turn is removed,
        the tracks: only the gyroscope tells it from one at rest.

        Args:
            interval: IMU samples between the frames.
            tracked: Keypoints of the later frame, and what they say about the motion.
            turn_rad: Angle of the turn between the frames, without the gyroscope's bias.
            speed_mps: Estimated speed before the interval; 0 while nothing has been estimated.
            visible_mps: Speed at which the tracks would surely be seen to move. An estimate above it, while
                they rest, is wrong, and must not keep the device from resting.
        """
        self._add(interval)
        self._keypoints.push(disparity.Keypoints.of_images(tracked))
        options = self._options
        if (
            turn_rad < options.max_turn_rate * interval.duration_s
            and self.acceleration_deviation < options.max_acceleration_deviation
            and (speed_mps < options.max_speed or speed_mps > visible_mps)
            and self._has_still_tracks(tracked.disparity_px, interval.duration_s)
        ):
            return Motion.RESTING
        return Motion.TURNING if tracked.is_turn_only else Motion.MOVING

    def is_moving(self, interval: imu_buffer.ImuInterval, turn_rad: float) -> bool:
        """Tell whether the samples alone say that the device does not rest."""
        is_turning = turn_rad > self._options.max_turn_rate * interval.duration_s
        return is_turning or self.acceleration_deviation > self._options.max_acceleration_deviation

    def visible_mps(self, depth_m: float, focal_px: float) -> float:
        """Return the speed at which points at a distance move surely faster than the limits of rest."""
        rate_px = self._options.max_disparity_px / _DISPARITY_TIME_S
        return _SURELY * rate_px * depth_m / focal_px

    def _has_still_tracks(self, disparity_px: float, duration_s: float) -> bool:
        """Tell whether keypoints rest but for their noise.

        Args:
            disparity_px: Median between the two newest frames, turn removed; NaN = unknown.
            duration_s: Time between these frames.
        """
        limit = self._options.max_disparity_px / _DISPARITY_TIME_S
        is_below = disparity_px < limit * duration_s
        if not self._keypoints.is_complete:
            return False
        half, whole = self._keypoints.rates()
        if np.isnan(half.px_per_s + whole.px_per_s):
            return is_below
        is_noise = self._keypoints.newest_px < _NOISE_FACTOR * whole.noise_px
        is_slow = half.px_per_s < limit and whole.px_per_s < _LONG_SHARE * limit
        return (is_below or is_noise) and is_slow

    def _add(self, interval: imu_buffer.ImuInterval) -> None:
        """Append samples, and forget those that are too old."""
        begin_ns = int(interval.times_ns[-1]) - round(self._options.imu_time_s * 1e9)
        # an interval repeats the last sample of the one before
        times_ns = np.concatenate([self._times_ns[:-1], interval.times_ns])
        acceleration = np.concatenate([self._acceleration[:-1], interval.accel_gyro[:, :3]])
        kept = times_ns >= begin_ns
        self._times_ns, self._acceleration = times_ns[kept], acceleration[kept]
