"""The turn between two frames as the gyroscope measures it."""

import math

import numpy as np

from maplab_py.array_types import F64
from maplab_py.compilation import compiled
from maplab_py.estimation.kernels import so3
from maplab_py.frontend.imu_buffer import ImuInterval
from maplab_py.sensors import Imu


def turn(imu: Imu, interval: ImuInterval, gyro_bias: F64) -> F64:
    """Return R_I0_I1 (3, 3), the attitude at the end of an interval in the frame of its beginning.

    Between two samples the angular velocity counts as their mean.

    Args:
        imu: For scale and misalignment.
        interval: Samples.
        gyro_bias: (3,) [rad/s].
    """
    correction = np.eye(3) if imu.intrinsics is None else np.linalg.inv(imu.intrinsics.T_g)
    R_I0_I1 = np.empty((3, 3))
    _integrate(interval.times_ns, interval.accel_gyro, gyro_bias, correction, R_I0_I1)
    return R_I0_I1


def turn_angle_rad(R_A_B: F64) -> float:
    """Return the angle of a rotation (3, 3)."""
    (_, r01, r02), (r10, _, r12), (r20, r21, _) = R_A_B.tolist()
    return math.atan2(math.hypot(r21 - r12, r02 - r20, r10 - r01), float(np.trace(R_A_B)) - 1.0)


@compiled()
def _integrate(times_ns, accel_gyro, bias, correction, R):  # type: ignore[no-untyped-def]
    """Fill in the rotation R from the beginning to the end of samples (S, 6)."""
    q, phi = (0.0, 0.0, 0.0, 1.0), np.empty(3)
    for row in range(len(times_ns) - 1):
        step_s = (times_ns[row + 1] - times_ns[row]) * 1e-9
        for i in range(3):
            phi[i] = 0.0
            for j in range(3):
                mean = 0.5 * (accel_gyro[row, 3 + j] + accel_gyro[row + 1, 3 + j])
                phi[i] += step_s * correction[i, j] * (mean - bias[j])
        angle = np.sqrt(phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2])
        half = np.sin(0.5 * angle) / angle if angle > 1e-9 else 0.5
        step = (half * phi[0], half * phi[1], half * phi[2], np.cos(0.5 * angle))
        q = so3.multiply(q, step)
    so3.to_matrix(q, R)


def compile_kernels() -> None:
    """Compile the integration on two samples."""
    interval = ImuInterval(np.arange(2, dtype=np.int64), np.zeros((2, 6)), 1)
    turn(Imu("0" * 32), interval, np.zeros(3))
