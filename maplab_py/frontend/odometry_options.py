"""Options of the odometry."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import numpy as np

from maplab_py.errors import FlagError
from maplab_py.estimation.window.options import CALIBRATED, WindowOptions
from maplab_py.frontend.initialization.options import InitializationOptions
from maplab_py.options import option
from maplab_py.vision.tracking.options import TrackingOptions


@dataclasses.dataclass(frozen=True)
class RestOptions:
    """Conditions of standstill: all must hold."""

    flag_prefix: ClassVar[str] = "vio_rest_"

    max_disparity_px: float = option(
        0.5,
        help="Standing still: largest median disparity in 0.1 s, turn removed; half of it over half a "
        "second, noise of the tracks removed",
        unit="px",
    )
    max_acceleration_deviation: float = option(
        0.25,
        help="Standing still: largest deviation of the accelerometer from its mean over 0.5 s",
        unit="m/s^2",
    )
    max_turn_rate: float = option(
        0.01,
        help="Standing still: largest mean angular velocity between two images",
        unit="rad/s",
    )
    max_speed: float = option(0.1, help="Standing still: largest estimated speed", unit="m/s")
    imu_time_s: float = option(
        0.5, help="Standing still: time over which the accelerometer is compared", unit="s"
    )

    def check(self) -> None:
        """Check the values.

        Raises:
            FlagError: A limit is negative or the time is not positive.
        """
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if not 0.0 <= value < np.inf or (field.name == "imu_time_s" and value == 0.0):
                raise FlagError(f"--{self.flag_prefix}{field.name}={value:g}: must be positive")


@dataclasses.dataclass(frozen=True)
class HealthOptions:
    """Criteria of divergence, after which the estimator starts again."""

    flag_prefix: ClassVar[str] = "vio_health_"

    min_tracks: int = option(
        8,
        help="Diverged: fewer keypoints than this are tracked, for longer than "
        "--vio_health_max_time_without_tracks_s",
    )
    max_time_without_tracks_s: float = option(
        2.0, help="Diverged: longest time with too few tracked keypoints", unit="s"
    )
    max_speed: float = option(25.0, help="Diverged: largest estimated speed", unit="m/s")
    max_velocity_sigma: float = option(
        1.0, help="Diverged: largest standard deviation of the velocity", unit="m/s"
    )
    max_tilt_sigma_deg: float = option(
        10.0, help="Diverged: largest standard deviation of the direction of gravity", unit="deg"
    )
    max_accel_bias: float = option(
        3.0, help="Diverged: largest bias of the accelerometer", unit="m/s^2"
    )
    max_gyro_bias: float = option(0.6, help="Diverged: largest bias of the gyroscope", unit="rad/s")

    def check(self) -> None:
        """Check the values.

        Raises:
            FlagError: A limit is negative.
        """
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if not 0.0 <= value < np.inf:
                raise FlagError(f"--{self.flag_prefix}{field.name}={value:g}: wants 0 or more")


@dataclasses.dataclass(frozen=True)
class OdometryOptions:
    """Options of all stages of the odometry."""

    flag_prefix: ClassVar[str] = "vio_"

    tracking: TrackingOptions = TrackingOptions()
    initialization: InitializationOptions = InitializationOptions()
    window: WindowOptions = WindowOptions()
    rest: RestOptions = RestOptions()
    health: HealthOptions = HealthOptions()
    max_imu_gap_s: float = option(
        0.2,
        help="Start again after an interval between IMU samples that is longer than this",
        unit="s",
    )

    estimate: str = option(
        "time_offset",
        help="Calibration that is estimated beside the motion, separated by commas: extrinsics, time_offset "
        "(of the images on the clock of the IMU), intrinsics, line_delay; or none",
    )
    apply_calibration: bool = option(
        True, help="Give the map the calibration that was estimated, where it differs significantly"
    )
    imu_noise: str = option(
        "auto",
        choices=("auto", "file"),
        help="Noise of the IMU: file = as the calibration says, auto = the same unless the samples show that "
        "it cannot be",
    )
    backfill: bool = option(
        True,
        help="Read the frames before the start backwards from it, so that the map begins with the first "
        "image",
    )

    @property
    def estimates_time_offset(self) -> bool:
        """Whether the times of images are corrected."""
        return "time_offset" in self.estimated

    @property
    def estimated(self) -> tuple[str, ...]:
        """Kinds of calibration that are estimated."""
        names = tuple(name.strip() for name in self.estimate.split(","))
        return () if names == ("none",) else names

    @property
    def window_states(self) -> tuple[str, ...]:
        """Kinds of calibration that are states of the window.

        A delay alone is measured beside it, which costs less.
        """
        return () if self.estimated == ("time_offset",) else self.estimated

    def check(self) -> None:
        """Check the values.

        Raises:
            FlagError: A value is out of its range.
        """
        self.tracking.check()
        for name in self.estimated:
            if name not in CALIBRATED:
                raise FlagError(
                    f"--{self.flag_prefix}estimate: there is no {name}: give some of "
                    f"{', '.join(CALIBRATED)}, separated by commas, or none"
                )
        self.initialization.check()
        self._check_window()
        self.rest.check()
        self.health.check()
        if not 0.0 < self.max_imu_gap_s < 1e9:
            raise FlagError(f"--vio_max_imu_gap_s={self.max_imu_gap_s:g}: must be positive")

    def _check_window(self) -> None:
        window = self.window
        if window.num_keyframes < 2 and window.num_keyframes != 0:
            raise FlagError(
                f"--{window.flag_prefix}num_keyframes={window.num_keyframes}: wants 2 or more, or 0"
            )
        for name, least in (
            ("num_recent_frames", 1),
            ("max_landmarks", 10),
            ("num_iterations", 1),
        ):
            value = getattr(window, name)
            if value < least:
                raise FlagError(f"--{window.flag_prefix}{name}={value}: wants {least} or more")
        for name in ("min_depth_m", "max_depth_m", "huber_sigmas", "gate_chi2"):
            value = getattr(window, name)
            if not value > 0.0:
                raise FlagError(f"--{window.flag_prefix}{name}={value:g}: must be positive")
