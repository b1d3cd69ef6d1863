"""Start at rest: gravity from the accelerometer, the gyroscope's bias from its mean."""

import dataclasses
import itertools

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.estimation.window.frame import StartState, WindowFrame
from maplab_py.frontend.disparity import Keypoints, disparity_px, rate
from maplab_py.frontend.initialization.options import InitializationOptions
from maplab_py.frontend.initialization.refinement import mission_frame
from maplab_py.geometry import se3
from maplab_py.sensors import Imu

_COMPARED_S = 0.1
_LONG_S = 0.5
"""Keypoints with noise are compared over this time or longer."""
_LONG_SHARE = 0.5
"""Limit over that time, noise removed, as a share of the limit of 0.1 s."""
_VELOCITY_SIGMA_MPS = 0.02
_POSITION_SIGMA_M = 1e-4
_LEAST_GYRO_SIGMA_RADPS = 2e-4
_DISTANCE_M = 3.0
"""Distance of the keypoints, to tell a velocity from their motion while nothing is known of it."""


@dataclasses.dataclass(frozen=True)
class Motionlessness:
    """Evidence for rest over some time; NaN where nothing can be said."""

    disparity_px: float  # largest median in 0.1 s
    rate_px: float  # over longer times, noise removed: per 0.1 s
    accel_deviation_mps2: float
    gyro_deviation_radps: float

    def is_rest(self, options: InitializationOptions) -> bool:
        """Tell whether the device rests.

        A slow steady turn is below the limit of 0.1 s, and the samples do not show it: only the longer
        times do.
        """
        limit = options.rest_disparity_px
        is_slow = self.rate_px < _LONG_SHARE * limit
        if np.isnan(self.rate_px):
            is_slow = self.disparity_px < limit
        return (
            is_slow
            and self.accel_deviation_mps2 < options.rest_accel_deviation_mps2
            and self.gyro_deviation_radps < options.rest_gyro_deviation_radps
        )

    def rate_radps(self, focal_px: float) -> float:
        """Return the angular velocity with which keypoints move; 0 where nothing can be said."""
        return 0.0 if np.isnan(self.rate_px) else self.rate_px / _COMPARED_S / focal_px


def motionlessness(frames: list[WindowFrame], accel_gyro: F64) -> Motionlessness:
    """Compare frames about 0.1 s apart, and IMU samples (S, 6) with their mean."""
    deviation = np.sqrt(np.sum(np.var(accel_gyro, axis=0).reshape(2, 3), axis=1))
    chosen = _spaced(frames)
    times_s = np.array([image.time_ns for image in chosen]) * 1e-9
    short_px = np.array([disparity_px(a, b) for a, b in itertools.pairwise(chosen)])
    in_limit_time = short_px * _COMPARED_S / np.diff(times_s)
    is_long = times_s[-1] - times_s >= _LONG_S - 5e-3
    long_px = [disparity_px(image, chosen[-1]) for image in itertools.compress(chosen, is_long)]
    mean_s = float(times_s[-1] - times_s[0]) / max(len(chosen) - 1, 1)
    apart = rate(short_px, mean_s, np.array(long_px), (times_s[-1] - times_s)[is_long])
    return Motionlessness(
        float(np.max(in_limit_time)) if len(in_limit_time) else float("nan"),
        apart.px_per_s * _COMPARED_S,
        float(deviation[0]),
        float(deviation[1]),
    )


def start_at_rest(
    imu: Imu, times_ns: I64, accel_gyro: F64, accel_bias_sigma: float, *, rate_radps: float = 0.0
) -> StartState:
    """Return the state of a device that rests, or nearly so.

    What the accelerometer measures is gravity and bias; of the bias only the part along gravity can be told,
    so that the tilt is as uncertain as the rest of it. Keypoints that move slowly may show a turn, which is
    in the mean of the gyroscope, or a translation.

    Args:
        imu: For gravity, scale and misalignment.
        times_ns: Times (S,) of samples at rest.
        accel_gyro: The samples (S, 6).
        accel_bias_sigma: Standard deviation of a component of the accelerometer's bias [m/s^2].
        rate_radps: Angular velocity with which keypoints move.
    """
    mean = np.mean(accel_gyro, axis=0)
    force, gyro_bias = mean[:3], mean[3:]
    T_a = np.eye(3)
    if imu.intrinsics is not None:
        T_a = imu.intrinsics.T_a @ imu.intrinsics.R_A_I
    gravity = imu.gravity_magnitude_mps2
    up_I = np.linalg.solve(T_a, force)
    up_I /= np.linalg.norm(up_I)
    along = T_a @ up_I
    # the component of the bias along what gravity alone would give
    accel_bias = along * ((force - gravity * along) @ along) / (along @ along)
    duration_s = float(times_ns[-1] - times_ns[0]) * 1e-9
    spread = float(np.max(np.std(accel_gyro[:, 3:], axis=0)))
    gyro_sigma = max(spread / np.sqrt(max(duration_s, 1e-3) * 10.0), _LEAST_GYRO_SIGMA_RADPS)
    sigma = np.repeat(
        [
            _POSITION_SIGMA_M,
            accel_bias_sigma / gravity,
            max(_VELOCITY_SIGMA_MPS, _DISTANCE_M * rate_radps),
            max(gyro_sigma, rate_radps),
            accel_bias_sigma,
        ],
        3,
    )
    T_M_I = se3.make(mission_frame(-up_I), np.zeros(3))
    return StartState(
        times_ns[-1:], T_M_I[None], np.zeros((1, 3)), gyro_bias[None], accel_bias[None], sigma
    )


def _spaced(frames: list[WindowFrame]) -> list[Keypoints]:
    """Return the keypoints of frames that are at least 0.1 s apart, the newest among them."""
    chosen = frames[-1:]
    for frame in reversed(frames[:-1]):
        if (chosen[-1].time_ns - frame.time_ns) * 1e-9 >= _COMPARED_S - 5e-3:
            chosen.append(frame)
    chosen.reverse()
    return [Keypoints.of_frame(frame) for frame in chosen]
