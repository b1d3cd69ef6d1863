"""Options of the self-calibration beside the odometry."""

import dataclasses
from pathlib import Path

from maplab_py.algorithms.self_calibration.options import SelfCalibrationOptions
from maplab_py.errors import FlagError
from maplab_py.options import Options, option


class WantedSigmas(Options, prefix="sc_wanted_sigma_"):
    """Deviations that a calibration shall have: smaller errors count as no contradiction."""

    focal_relative: float = option(5e-4, gt=0)
    """Wanted deviation of focal lengths, relative"""
    centre_px: float = option(0.3, gt=0)
    """Wanted deviation of the centre"""
    distortion: float = option(2e-3, gt=0)
    """Wanted deviation of distortion parameters"""
    rotation_deg: float = option(0.03, gt=0)
    """Wanted deviation of the camera's orientation, and of the accelerometer's"""
    position_m: float = option(2e-3, gt=0)
    """Wanted deviation of the camera's position"""
    imu: float = option(1e-3, gt=0)
    """Wanted deviation of IMU scales and misalignments"""
    time_offset_s: float = option(5e-4, gt=0)
    """Wanted deviation of the delay of the images"""

    def as_priors(self, options: SelfCalibrationOptions) -> SelfCalibrationOptions:
        """Return options whose prior deviations are the wanted ones."""
        return dataclasses.replace(
            options,
            prior_focal_relative=self.focal_relative,
            prior_centre_px=self.centre_px,
            prior_distortion=self.distortion,
            prior_rotation_deg=self.rotation_deg,
            prior_imu_rotation_deg=self.rotation_deg,
            prior_position_m=self.position_m,
            prior_imu_scale=self.imu,
            prior_imu_misalignment=self.imu,
            prior_time_offset_s=self.time_offset_s,
        )


class OnlineCalibrationOptions(Options, prefix="sc_"):
    """Self-calibration while a recording is read."""

    is_on: bool = option(False, flag="self_calibrate")
    """Collect informative segments beside the odometry, and say when the calibration is contradicted and when
    a new one is due; needs --sc_database"""
    database: Path | None = None
    """Segment database of the device, made if missing; proposed calibrations are written beside it"""
    apply: str = option("propose", choices=("propose", "next_start", "now"))
    """Use of a new calibration: propose = write it beside the database, next_start = also begin the next run
    with it, now = also go on with it at a keyframe, as a new mission"""
    processor_share: float = option(0.25, gt=0, le=1)
    """Largest share of one processor core for the evaluation of segments while the odometry runs"""
    wanted: WantedSigmas = WantedSigmas()

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.is_on and self.database is None:
            raise FlagError("--self_calibrate needs the device's --sc_database=FILE")
        if not self.is_on and (self.database is not None or self.apply != "propose"):
            flag = "sc_apply" if self.database is None else "sc_database"
            raise FlagError(f"--{flag} needs --self_calibrate")

    @property
    def applies_later(self) -> bool:
        """Whether the next run begins with a proposal."""
        return self.apply != "propose"

    @property
    def proposal(self) -> Path:
        """File of the proposed calibration."""
        assert self.database is not None
        return self.database.with_name(self.database.name + ".proposal.yaml")
