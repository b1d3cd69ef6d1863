"""Input and result of the smoother for a frame, and the initial state."""

import dataclasses
from enum import Enum, IntFlag

import numpy as np

from maplab_py.array_types import F64, I32, I64, Mask
from maplab_py.errors import UserError
from maplab_py.vimap.nav_state import NavState


class Motion(Enum):
    """Knowledge of the motion on the way to a frame."""

    MOVING = "moving"
    TURNING = "turning"  # explained by rotation only
    RESTING = "resting"


class ImuPart(IntFlag):
    """Sensors of an IMU."""

    GYROSCOPE = 1
    ACCELEROMETER = 2


NO_PART = ImuPart(0)


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
    delay_s: float = 0.0  # by which its time differs from that which lateness of images counts from
    failed: ImuPart = NO_PART  # parts of the IMU whose samples say next to nothing

    def __post_init__(self) -> None:
        counts = {len(x) for x in (self.camera, self.track_id, self.uv_px, self.sigma_px)}
        if len(counts) > 1 or len(self.imu_times_ns) != len(self.accel_gyro):
            raise UserError(f"the columns of the frame at {self.time_ns} ns differ in length")


@dataclasses.dataclass(eq=False)
class FrameRows:
    """Columns of the F frames in a window that are not estimated, ordered by time."""

    time_ns: I64 = dataclasses.field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    is_keyframe: Mask = dataclasses.field(default_factory=lambda: np.zeros(0, dtype=np.bool_))
    is_resting: Mask = dataclasses.field(default_factory=lambda: np.zeros(0, dtype=np.bool_))
    """Frames at rest, or that surely turn on the spot."""
    is_turning: Mask = dataclasses.field(default_factory=lambda: np.zeros(0, dtype=np.bool_))
    rate_I: F64 = dataclasses.field(default_factory=lambda: np.zeros((0, 3)))  # as measured
    delay_s: F64 = dataclasses.field(default_factory=lambda: np.zeros(0))

    def append(
        self, frame: WindowFrame, *, is_keyframe: bool, is_resting: bool, is_turning: bool
    ) -> None:
        """Add a later frame."""
        self.time_ns = np.append(self.time_ns, frame.time_ns)
        self.is_keyframe = np.append(self.is_keyframe, is_keyframe)
        self.is_resting = np.append(self.is_resting, is_resting)
        self.is_turning = np.append(self.is_turning, is_turning)
        rate_I = frame.accel_gyro[-1:, 3:] if len(frame.accel_gyro) else np.zeros((1, 3))
        self.rate_I = np.concatenate([self.rate_I, rate_I])
        self.delay_s = np.append(self.delay_s, frame.delay_s)

    def remove(self, frame: int) -> None:
        """Remove a frame."""
        for field in dataclasses.fields(self):
            setattr(self, field.name, np.delete(getattr(self, field.name), frame, axis=0))


class StartState(NavState):
    """State of the first frame (N = 1). M has gravity along -z."""

    sigma: F64  # (15,) standard deviations [p, theta, v, b_g, b_a]; infinite = unknown


@dataclasses.dataclass(frozen=True, eq=False)
class WindowUpdate:
    """Result of an update of the smoother."""

    state: NavState  # newest frame
    covariance: F64  # (15, 15) order [p, theta, v, b_g, b_a]; infinite where nothing is known
    is_keyframe: bool
    num_landmarks: int  # that were estimated
    median_error_px: float  # of all observations of landmarks; nan without any
    released: NavState  # final estimates of frames that have left the window, in the order of time
    stage_ms: dict[str, float]  # processor time of this thread
