"""IMU measurement model with scale, misalignment and biases, and its inverse.

Schneider 2019, eq. (7.7)-(7.10): w_measured = T_g w_I + b_g, a_measured = T_a R_A_I f_I + b_a, where
f_I = R_I_G (a_G - g_G) is the specific force in the IMU frame.
"""

import numpy as np
from numpy.typing import ArrayLike

from maplab_py.array_types import F64
from maplab_py.sensors.imu import ImuIntrinsics


def distort_imu(
    intrinsics: ImuIntrinsics | None, accel_gyro: ArrayLike, b_a: ArrayLike, b_g: ArrayLike
) -> F64:
    """Return the measurements of an IMU for true values.

    Args:
        intrinsics: Scale and misalignment; None = identity.
        accel_gyro: Specific force [m/s^2] and angular velocity [rad/s] in I, rows (..., 6).
        b_a: Accelerometer bias (..., 3) [m/s^2].
        b_g: Gyroscope bias (..., 3) [rad/s].
    """
    values = np.asarray(accel_gyro, dtype=np.float64)
    accel, gyro = values[..., :3], values[..., 3:]
    if intrinsics is not None:
        accel = accel @ (intrinsics.T_a @ intrinsics.R_A_I).T
        gyro = gyro @ intrinsics.T_g.T
    return np.concatenate([accel + np.asarray(b_a), gyro + np.asarray(b_g)], axis=-1)


def correct_imu(
    intrinsics: ImuIntrinsics | None, accel_gyro: ArrayLike, b_a: ArrayLike, b_g: ArrayLike
) -> F64:
    """Return the true values of measurements: the inverse of `distort_imu`, same arguments."""
    values = np.asarray(accel_gyro, dtype=np.float64)
    accel, gyro = values[..., :3] - np.asarray(b_a), values[..., 3:] - np.asarray(b_g)
    if intrinsics is not None:
        accel = accel @ np.linalg.inv(intrinsics.T_a @ intrinsics.R_A_I).T
        gyro = gyro @ np.linalg.inv(intrinsics.T_g).T
    return np.concatenate([accel, gyro], axis=-1)
