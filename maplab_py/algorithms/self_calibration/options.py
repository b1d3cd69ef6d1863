"""Flags of the self-calibration commands."""

from __future__ import annotations

import dataclasses
from typing import ClassVar, Self

from maplab_py.errors import UserError
from maplab_py.options import option

STATES = (
    "intrinsics",
    "extrinsics_rotation",
    "extrinsics_translation",
    "imu",
    "time_offset",
    "line_delay",
)
"""Parameters that can be estimated."""

GROUPS = ("imu", "camera", "extrinsics")
"""Parameter groups, each with its own table of segments; time offset and line delay are extrinsic."""

_STATES_OF = {
    "imu": {"imu"},
    "camera": {"intrinsics"},
    "extrinsics": {"extrinsics_rotation", "extrinsics_translation", "time_offset", "line_delay"},
}

METRICS = ("a_optimality", "d_optimality", "e_optimality", "entropy")
SELECTIONS = ("informative", "least_informative", "random", "information_gain", "all")

_MINIMUM = {
    "segments_per_group": 1,
    "segment_keyframes": 3,
    "num_iterations": 1,
    "min_shared_landmarks": 0,
    "min_parallax_deg": 0.0,
}


@dataclasses.dataclass(frozen=True)
class SelfCalibrationOptions:
    """Estimated parameters, data and priors.

    The prior deviations say how far a device may be from its nominal calibration. A direction that
    the data do not determine better counts as unobservable, stays at its prior, and adds nothing to
    the information of a segment.
    """

    flag_prefix: ClassVar[str] = "sc_"

    states: str = option(
        "intrinsics,extrinsics_rotation,extrinsics_translation,imu",
        help="What to estimate, separated by commas: " + ", ".join(STATES) + ".",
    )
    groups: str = option(
        "imu,camera,extrinsics",
        help="Parameter groups that each keep their own segments, separated by commas; several "
        "joined by + are one group (imu+camera+extrinsics: a single one).",
    )
    metric: str = option(
        "a_optimality", help="How a group's covariance becomes one number.", choices=METRICS
    )
    selection: str = option("informative", help="Which segments to take.", choices=SELECTIONS)
    segments_per_group: int = option(8, help="How many segments each group keeps.")
    segment_keyframes: int = option(40, help="Keyframes of a segment.")
    seed: int = option(1, help="Seed of the random selection.")
    min_information_gain: float = option(
        0.2, help="Selection by information gain keeps a segment above this.", unit="nat"
    )
    min_shared_landmarks: int = option(
        15, help="Segments that share more landmarks than this form one partition."
    )
    min_parallax_deg: float = option(
        1.0,
        help="Landmarks seen under a smaller parallax are not used.",
        unit="deg",
    )
    num_iterations: int = option(40, help="Largest number of iterations.")
    function_tolerance: float = option(
        1e-6, help="Stop when an iteration lowers the cost by less than this share of it."
    )
    loss: str = option(
        "cauchy",
        help="Robust loss of reprojection errors until outliers are rejected.",
        choices=("none", "huber", "cauchy", "tukey", "geman_mcclure", "dcs"),
    )
    inconsistent_probability: float = option(
        0.01,
        help="Landmarks whose residuals are less probable than this are rejected; the others then "
        "have their full weight. 0 = keep the robust loss to the end.",
    )
    imu_curvature: bool = option(
        True,
        help="Correct inertial samples for the bias of linear interpolation between them.",
    )
    gate_reprojection_error_px: float = option(
        40.0, help="Observations with a larger initial reprojection error are not used.", unit="px"
    )
    keep_unobservable_at_prior: bool = option(
        False,
        help="Accept data that leave directions undetermined and keep those at their prior; "
        "otherwise such data are refused.",
    )
    prior_focal_relative: float = option(0.05, help="Prior deviation of focal lengths, relative.")
    prior_centre_px: float = option(15.0, help="Prior deviation of the centre.", unit="px")
    prior_distortion: float = option(0.05, help="Prior deviation of distortion parameters.")
    prior_rotation_deg: float = option(
        5.0, help="Prior deviation of the camera's orientation.", unit="deg"
    )
    prior_position_m: float = option(
        0.05, help="Prior deviation of the camera's position.", unit="m"
    )
    prior_imu_scale: float = option(0.05, help="Prior deviation of IMU scales.")
    prior_imu_misalignment: float = option(0.05, help="Prior deviation of IMU misalignments.")
    prior_imu_rotation_deg: float = option(
        5.0, help="Prior deviation of the accelerometer's orientation.", unit="deg"
    )
    prior_time_offset_s: float = option(
        0.03, help="Prior deviation of the delay of the images.", unit="s"
    )

    prior_line_delay_us: float = option(
        100.0, help="Prior deviation of the time between two rows.", unit="us"
    )

    prior_gyro_bias_radps: float = option(
        0.2,
        help="Prior deviation of the gyroscope's bias at the beginning of a run of segments.",
        unit="rad/s",
    )
    prior_accel_bias_mps2: float = option(
        2.0,
        help="Prior deviation of the accelerometer's bias at the beginning of a run of segments.",
        unit="m/s^2",
    )
    prior_velocity_mps: float = option(
        20.0,
        help="Prior deviation of the velocity at the beginning of a run of segments.",
        unit="m/s",
    )

    def checked(self) -> Self:
        """Return the options if they can be used.

        Raises:
            UserError: A number is out of its range, or a name is unknown; the message names the flag.
        """
        self.grouping()
        for name, least in _MINIMUM.items():
            value = getattr(self, name)
            if not value >= least:
                raise UserError(f"--{self.flag_prefix}{name}={value:g}: wants at least {least:g}")
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if field.name.startswith("prior_") and not value > 0.0:
                raise UserError(
                    f"--{self.flag_prefix}{field.name}={value:g}: wants a positive deviation; to "
                    "hold something, leave it out of --sc_states"
                )
        return self

    def estimated(self) -> frozenset[str]:
        """Return the states to estimate.

        Raises:
            UserError: A name is unknown, or there is none.
        """
        names = frozenset(filter(None, (part.strip() for part in self.states.split(","))))
        unknown = sorted(names - set(STATES))
        if unknown or not names:
            what = f"there is no state '{unknown[0]}'" if unknown else "nothing to estimate"
            raise UserError(f"--sc_states: {what}; there are: {', '.join(STATES)}")
        return names

    def grouping(self) -> dict[str, tuple[str, ...]]:
        """Return the basic groups of every table of the database, by the table's name.

        Groups of which nothing is estimated have no table: all segments would be equal there.

        Raises:
            UserError: A name is unknown, or there is none.
        """
        tables: dict[str, tuple[str, ...]] = {}
        for name in filter(None, (part.strip() for part in self.groups.split(","))):
            members = tuple(part.strip() for part in name.split("+"))
            if unknown := [member for member in members if member not in GROUPS]:
                raise UserError(
                    f"--sc_groups: there is no group '{unknown[0]}'; there are: {', '.join(GROUPS)}"
                )
            if any(self.estimated() & _STATES_OF[member] for member in members):
                tables[name] = members
        if not tables:
            raise UserError(
                f"--sc_groups: name at least one of {', '.join(GROUPS)}, of which something is "
                "estimated"
            )
        return tables
