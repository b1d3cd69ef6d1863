"""Recognising that an estimate has diverged."""

import numpy as np

from maplab_py.array_types import F64
from maplab_py.frontend.odometry_options import HealthOptions
from maplab_py.vimap.nav_state import NavState

_TILT = slice(3, 5)
_VELOCITY = slice(6, 9)
_BLIND_NS = 500_000_000


class HealthMonitor:
    """Compares the estimates of one start with the limits."""

    def __init__(self, options: HealthOptions) -> None:
        self._options = options
        self._tracked_ns = -1
        self._newest_ns = -1

    @property
    def healthy_until_ns(self) -> int:
        """Time of the last frame with enough tracks."""
        return self._tracked_ns

    @property
    def is_blind(self) -> bool:
        """Whether tracks, and not the states before, are the reason of a divergence."""
        return self._newest_ns - self._tracked_ns > _BLIND_NS

    def problem(self, state: NavState, covariance: F64, tracks: int) -> str:
        """Return why an estimate has diverged, empty if it has not.

        Args:
            state: The estimate at one time.
            covariance: Of it (15, 15), order [p, theta, v, b_g, b_a].
            tracks: Number of keypoints that were seen in the frame before, too.
        """
        options, time_ns = self._options, int(state.time_ns[0])
        self._newest_ns = time_ns
        columns = (state.T_M_I, state.v_M, state.gyro_bias, state.accel_bias)
        if not all(np.isfinite(column).all() for column in columns):
            return "the estimate is not a number"
        if tracks >= options.min_tracks or self._tracked_ns < 0:
            self._tracked_ns = time_ns
        blind_s = (time_ns - self._tracked_ns) * 1e-9
        if blind_s > options.max_time_without_tracks_s:
            return f"fewer than {options.min_tracks} keypoints tracked for {blind_s:.1f} s"
        sigma = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
        velocity_sigma, tilt_deg = sigma[_VELOCITY].max(), np.degrees(sigma[_TILT].max())
        vectors = (state.v_M, state.accel_bias, state.gyro_bias)
        speed, accel_bias, gyro_bias = (float(np.linalg.norm(vector)) for vector in vectors)
        deviation = "standard deviation of the"
        checks = (
            (speed, options.max_speed, "speed {:.1f} m/s"),
            (velocity_sigma, options.max_velocity_sigma, f"{deviation} velocity {{:.2f}} m/s"),
            (tilt_deg, options.max_tilt_sigma_deg, f"{deviation} tilt {{:.1f}} deg"),
            (accel_bias, options.max_accel_bias, "bias of the accelerometer {:.2f} m/s^2"),
            (gyro_bias, options.max_gyro_bias, "bias of the gyroscope {:.2f} rad/s"),
        )
        for value, limit, text in checks:
            if not value <= limit:
                return text.format(value)
        return ""
