"""Options of the odometry."""

from __future__ import annotations

import dataclasses

from maplab_py.errors import FlagError
from maplab_py.estimation.window.options import CALIBRATED, WindowOptions
from maplab_py.frontend.initialization.options import InitializationOptions
from maplab_py.options import Options, option
from maplab_py.vision.tracking.options import TrackingOptions

_AUTO = "auto"
_IN_WORDS: dict[tuple[str, ...], tuple[str, ...]] = {("none",): (), (_AUTO,): ("time_offset",)}


class RestOptions(Options, prefix="vio_rest_"):
    """Conditions of standstill: all must hold."""

    max_disparity_px: float = option(0.5, ge=0)
    """Standing still: largest median disparity in 0.1 s, turn removed; half of it over half a second, noise
    of the tracks removed"""
    max_acceleration_deviation: float = option(0.25, ge=0, unit="m/s^2")
    """Standing still: largest deviation of the accelerometer from its mean over 0.5 s"""
    max_turn_rate: float = option(0.01, ge=0, unit="rad/s")
    """Standing still: largest mean angular velocity between two images"""
    max_speed: float = option(0.1, ge=0, unit="m/s")
    """Standing still: largest estimated speed"""
    imu_time_s: float = option(0.5, gt=0)
    """Standing still: time over which the accelerometer is compared"""


class HealthOptions(Options, prefix="vio_health_"):
    """Criteria of divergence, after which the estimator starts again."""

    min_tracks: int = option(8, ge=0)
    """Diverged: fewer keypoints than this are tracked, for longer than
    --vio_health_max_time_without_tracks_s"""
    max_time_without_tracks_s: float = option(2.0, ge=0)
    """Diverged: longest time with too few tracked keypoints"""
    max_speed: float = option(25.0, ge=0, unit="m/s")
    """Diverged: largest estimated speed"""
    max_velocity_sigma: float = option(1.0, ge=0, unit="m/s")
    """Diverged: largest standard deviation of the velocity"""
    max_tilt_sigma_deg: float = option(10.0, ge=0)
    """Diverged: largest standard deviation of the direction of gravity"""
    max_accel_bias: float = option(3.0, ge=0, unit="m/s^2")
    """Diverged: largest bias of the accelerometer"""
    max_gyro_bias: float = option(0.6, ge=0, unit="rad/s")
    """Diverged: largest bias of the gyroscope"""


class OdometryOptions(Options, prefix="vio_"):
    """Options of all stages of the odometry."""

    tracking: TrackingOptions = TrackingOptions()
    initialization: InitializationOptions = InitializationOptions()
    window: WindowOptions = WindowOptions()
    rest: RestOptions = RestOptions()
    health: HealthOptions = HealthOptions()
    max_imu_gap_s: float = option(0.2, gt=0, lt=1e9)
    """Start again after an interval between IMU samples that is longer than this"""

    estimate: str = "auto"
    """Calibration that is estimated beside the motion, separated by commas: extrinsics, time_offset (of the
    images on the clock of the IMU), intrinsics, line_delay; or none; auto = time_offset, and all of them
    where check_recording has found the calibration wrong"""
    apply_calibration: bool = True
    """Give the map the calibration that was estimated, where it differs significantly; read a recording in
    the units, axes and calibration that check_recording finds, where its own do not fit; and optimise the map
    with the calibration of the cameras free, where its residuals contradict it"""
    imu_noise: str = option("auto", choices=("auto", "file"))
    """Noise of the IMU: file = as the calibration says, auto = the same unless the samples show that it
    cannot be"""
    backfill: bool = True
    """Read the frames before the start backwards from it, so that the map begins with the first image"""

    @property
    def estimates_time_offset(self) -> bool:
        """Whether the times of images are corrected."""
        return "time_offset" in self.estimated

    @property
    def estimated(self) -> tuple[str, ...]:
        """Kinds of calibration that are estimated."""
        names = tuple(name.strip() for name in self.estimate.split(","))
        return _IN_WORDS.get(names, names)

    def for_doubted(self) -> OdometryOptions:
        """Return the options for a recording whose calibration has been found wrong."""
        is_auto = self.estimate.strip() == _AUTO
        return dataclasses.replace(self, estimate=",".join(CALIBRATED)) if is_auto else self

    @property
    def window_states(self) -> tuple[str, ...]:
        """Kinds of calibration that are states of the window.

        A delay alone is measured beside it, which costs less.
        """
        return () if self.estimated == ("time_offset",) else self.estimated

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in self.estimated:
            if name not in CALIBRATED:
                raise FlagError(
                    f"--{self.flag_prefix}estimate: there is no {name}: give some of "
                    f"{', '.join(CALIBRATED)}, separated by commas, or none, or auto"
                )
        window = self.window
        if window.num_keyframes < 2 and window.num_keyframes != 0:
            raise FlagError(
                f"--{window.flag_prefix}num_keyframes={window.num_keyframes}: wants 2 or more, or 0"
            )
