"""Result of the odometry after each frame."""

import dataclasses

import numpy as np

from maplab_py.array_types import U8
from maplab_py.estimation.window.frame import Motion, WindowFrame, WindowUpdate
from maplab_py.frontend.backfill import Backfill
from maplab_py.frontend.imu_buffer import ImuInterval
from maplab_py.interop.recordings.protocol import TrackedFrameSet
from maplab_py.vimap.nav_state import NavState
from maplab_py.vision.tracking.tracks import TrackedImages


@dataclasses.dataclass(frozen=True, eq=False)
class OdometryUpdate:
    """The result of one frame set."""

    time_ns: int
    mission: int  # counts starts of the estimator from 0; -1 before the first
    tracked: TrackedImages
    motion: Motion
    interval: ImuInterval | None  # samples since the frame before; None after a start or an IMU gap
    stage_ms: dict[str, float]  # elapsed time of each stage
    state: NavState | None = None  # of this frame; None while the estimator initialises
    released: NavState | None = None  # final estimates of frames that have left the window
    window: WindowUpdate | None = None
    note: str = ""  # why the estimator waits, or why it was started again
    healthy_until_ns: int = 0  # states after this time are doubtful; 0 = none is
    has_diverged: bool = False  # the states before that time may be wrong, too
    since_last: ImuInterval | None = (
        None  # all samples since the frame before, whatever has happened
    )
    images: tuple[U8, ...] = ()  # grey, by camera; empty for tracks of a replay
    tracks: TrackedFrameSet | None = None  # of a replay
    stamp_ns: int = 0  # of the images, without a delay that was estimated
    backfill: Backfill | None = None  # states of frames that had none at their time

    def window_frame(self) -> WindowFrame:
        """Return the frame as the smoother takes it."""
        cameras = self.tracked.cameras
        none = ImuInterval(np.array([self.time_ns] * 2), np.zeros((2, 6)), 0)
        interval = self.interval or none
        return WindowFrame(
            time_ns=self.time_ns,
            imu_times_ns=interval.times_ns,
            accel_gyro=interval.accel_gyro,
            camera=np.repeat(np.arange(len(cameras), dtype=np.int32), [len(c) for c in cameras]),
            track_id=np.concatenate([c.track_id for c in cameras]),
            uv_px=np.concatenate([c.uv_px for c in cameras]),
            sigma_px=np.concatenate([c.sigma_px for c in cameras]),
            motion=self.motion,
        )
