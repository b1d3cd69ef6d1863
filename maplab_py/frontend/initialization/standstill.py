"""Start at rest: gravity from the accelerometer, the gyroscope's bias from its mean."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.estimation.window.frame import StartState, WindowFrame
from maplab_py.frontend.initialization.options import InitializationOptions
from maplab_py.frontend.initialization.refinement import mission_frame
from maplab_py.geometry import se3
from maplab_py.sensors import Imu

_COMPARED_S = 0.1
_MIN_TRACKS = 15
_VELOCITY_SIGMA_MPS = 0.02
_POSITION_SIGMA_M = 1e-4
_LEAST_GYRO_SIGMA_RADPS = 2e-4


@dataclasses.dataclass(frozen=True)
class Motionlessness:
    """What speaks for rest over some time; NaN where nothing can be said."""

    disparity_px: float  # largest median in 0.1 s
    accel_deviation_mps2: float
    gyro_deviation_radps: float

    def is_rest(self, options: InitializationOptions) -> bool:
        """Tell whether the device rests."""
        return (
            self.disparity_px < options.rest_disparity_px
            and self.accel_deviation_mps2 < options.rest_accel_deviation_mps2
            and self.gyro_deviation_radps < options.rest_gyro_deviation_radps
        )


def motionlessness(frames: list[WindowFrame], accel_gyro: F64) -> Motionlessness:
    """Compare frames about 0.1 s apart, and IMU samples (S, 6) with their mean."""
    deviation = np.sqrt(np.sum(np.var(accel_gyro, axis=0).reshape(2, 3), axis=1))
    disparity = [_disparity_px(a, b) for a, b in _pairs(frames)]
    largest = float(np.max(disparity)) if disparity else float("nan")
    return Motionlessness(largest, float(deviation[0]), float(deviation[1]))


def start_at_rest(imu: Imu, times_ns: I64, accel_gyro: F64, accel_bias_sigma: float) -> StartState:
    """Return the state of a device that rests.

    What the accelerometer measures is gravity and bias; of the bias only the part along gravity can be told,
    so that the tilt is as uncertain as the rest of it.

    Args:
        imu: For gravity, scale and misalignment.
        times_ns: Times (S,) of samples at rest.
        accel_gyro: The samples (S, 6).
        accel_bias_sigma: Standard deviation of a component of the accelerometer's bias [m/s^2].
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
            _VELOCITY_SIGMA_MPS,
            gyro_sigma,
            accel_bias_sigma,
        ],
        3,
    )
    T_M_I = se3.make(mission_frame(-up_I), np.zeros(3))
    return StartState(T_M_I, np.zeros(3), gyro_bias, accel_bias, sigma)


def _pairs(frames: list[WindowFrame]) -> list[tuple[WindowFrame, WindowFrame]]:
    """Return frames that are at least 0.1 s apart, each with the next of them."""
    chosen = frames[-1:]
    for frame in reversed(frames[:-1]):
        if (chosen[-1].time_ns - frame.time_ns) * 1e-9 >= _COMPARED_S - 5e-3:
            chosen.append(frame)
    chosen.reverse()
    return list(itertools.pairwise(chosen))


def _disparity_px(first: WindowFrame, second: WindowFrame) -> float:
    """Return the median motion of common keypoints in 0.1 s; infinite when there are too few."""
    keys = [frame.track_id * 256 + frame.camera for frame in (first, second)]
    _, i, j = np.intersect1d(keys[0], keys[1], return_indices=True)
    if len(i) < _MIN_TRACKS:
        return float("inf")
    moved = np.linalg.norm(second.uv_px[j] - first.uv_px[i], axis=1)
    return float(np.median(moved)) * _COMPARED_S / ((second.time_ns - first.time_ns) * 1e-9)
