"""The turn between two frames as the gyroscope measures it."""

from __future__ import annotations

import numpy as np

from maplab_py.array_types import F64
from maplab_py.frontend.imu_buffer import ImuInterval
from maplab_py.geometry import so3
from maplab_py.sensors import Imu


def turn(imu: Imu, interval: ImuInterval, gyro_bias: F64) -> F64:
    """Return R_I0_I1 (3, 3), the attitude at the end of an interval in the frame of its beginning.

    Between two samples the angular velocity counts as their mean.

    Args:
        imu: For scale and misalignment.
        interval: Samples.
        gyro_bias: (3,) [rad/s].
    """
    rate = interval.accel_gyro[:, 3:] - gyro_bias
    if imu.intrinsics is not None:
        rate = rate @ np.linalg.inv(imu.intrinsics.T_g).T
    step_s = np.diff(interval.times_ns) * 1e-9
    q = so3.exp(0.5 * (rate[1:] + rate[:-1]) * step_s[:, None])
    while len(q) > 1:  # neighbours are multiplied, all pairs at once
        left, right = q[: len(q) - len(q) % 2 : 2], q[1::2]
        q = np.concatenate([so3.multiply(left, right), q[len(q) - len(q) % 2 :]])
    return np.asarray(so3.to_matrix(q[0]))
