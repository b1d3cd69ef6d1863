"""Input of the smoother for a frame, and the state it starts from."""

from __future__ import annotations

import dataclasses
from enum import Enum

from maplab_py.array_types import F64, I32, I64
from maplab_py.errors import UserError


class Motion(Enum):
    """Knowledge of the motion on the way to a frame."""

    MOVING = "moving"
    TURNING = "turning"  # explained by rotation only
    RESTING = "resting"


@dataclasses.dataclass(frozen=True, eq=False)
class WindowFrame:
    """Tracked keypoints of all cameras at one time, and the IMU samples since the frame before.

    Raises:
        UserError: Lengths do not agree.
    """

    time_ns: int
    imu_times_ns: I64  # (S,) from the previous frame's time to this frame's, both included
    accel_gyro: F64  # (S, 6) [ax ay az gx gy gz] as measured
    camera: I32  # (K,)
    track_id: I64  # (K,) unique in a recording; equal in all cameras that see the same point
    uv_px: F64  # (K, 2) of the distorted image
    sigma_px: F64  # (K,)
    motion: Motion = Motion.MOVING
    delay_s: float = 0.0  # by which its time differs from the stamps of its images

    def __post_init__(self) -> None:
        """Check the lengths."""
        counts = {len(x) for x in (self.camera, self.track_id, self.uv_px, self.sigma_px)}
        if len(counts) > 1 or len(self.imu_times_ns) != len(self.accel_gyro):
            raise UserError(f"the columns of the frame at {self.time_ns} ns differ in length")


@dataclasses.dataclass(frozen=True, eq=False)
class StartState:
    """State of the first frame. M has gravity along -z."""

    T_M_I: F64  # (7,)
    v_M: F64  # (3,) [m/s]
    gyro_bias: F64  # (3,) [rad/s]
    accel_bias: F64  # (3,) [m/s^2]
    sigma: F64  # (15,) standard deviations [p, theta, v, b_g, b_a]; infinite = unknown
