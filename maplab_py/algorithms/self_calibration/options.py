"""Flags of the self-calibration commands."""

from maplab_py.errors import UserError
from maplab_py.options import Options, option

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


class SelfCalibrationOptions(Options, prefix="sc_"):
    """Estimated parameters, data and priors.

    The prior deviations say how far a device may be from its nominal calibration. A direction that
    the data do not determine better counts as unobservable, stays at its prior, and adds nothing to
    the information of a segment.
    """

    states: str = option(
        "intrinsics,extrinsics_rotation,extrinsics_translation,imu",
        help="What to estimate, separated by commas: " + ", ".join(STATES) + ".",
    )
    groups: str = "imu,camera,extrinsics"
    """Parameter groups that each keep their own segments, separated by commas; several joined by + are one
    group (imu+camera+extrinsics: a single one)."""
    metric: str = option("a_optimality", choices=METRICS)
    """Number that stands for a group's covariance."""
    selection: str = option("informative", choices=SELECTIONS)
    """Segments to take."""
    segments_per_group: int = option(8, ge=1)
    """Number of segments that each group keeps."""
    segment_keyframes: int = option(40, ge=3)
    """Keyframes of a segment."""
    seed: int = 1
    """Seed of the random selection."""
    min_information_gain: float = option(0.2, unit="nat")
    """Selection by information gain keeps a segment above this."""
    min_shared_landmarks: int = option(15, ge=0)
    """Segments that share more landmarks than this form one partition."""
    min_parallax_deg: float = option(1.0, ge=0)
    """Landmarks seen under a smaller parallax are not used."""
    num_iterations: int = option(40, ge=1)
    """Largest number of iterations."""
    function_tolerance: float = 1e-6
    """Stop when an iteration lowers the cost by less than this share of it."""
    loss: str = option(
        "cauchy", choices=("none", "huber", "cauchy", "tukey", "geman_mcclure", "dcs")
    )
    """Robust loss of reprojection errors until outliers are rejected."""
    inconsistent_probability: float = 0.01
    """Landmarks whose residuals are less probable than this are rejected; the others then have their full
    weight. 0 = keep the robust loss to the end."""
    imu_curvature: bool = True
    """Correct inertial samples for the bias of linear interpolation between them."""
    gate_reprojection_error_px: float = 40.0
    """Observations with a larger initial reprojection error are not used."""
    keep_unobservable_at_prior: bool = False
    """Accept data that leave directions undetermined and keep those at their prior; otherwise such data are
    refused."""
    prior_focal_relative: float = option(0.05, gt=0)
    """Prior deviation of focal lengths, relative."""
    prior_centre_px: float = option(15.0, gt=0)
    """Prior deviation of the centre."""
    prior_distortion: float = option(0.05, gt=0)
    """Prior deviation of distortion parameters."""
    prior_rotation_deg: float = option(5.0, gt=0)
    """Prior deviation of the camera's orientation."""
    prior_position_m: float = option(0.05, gt=0)
    """Prior deviation of the camera's position."""
    prior_imu_scale: float = option(0.05, gt=0)
    """Prior deviation of IMU scales."""
    prior_imu_misalignment: float = option(0.05, gt=0)
    """Prior deviation of IMU misalignments."""
    prior_imu_rotation_deg: float = option(5.0, gt=0)
    """Prior deviation of the accelerometer's orientation."""
    prior_time_offset_s: float = option(0.03, gt=0)
    """Prior deviation of the delay of the images."""

    prior_line_delay_us: float = option(100.0, gt=0)
    """Prior deviation of the time between two rows."""

    prior_gyro_bias_radps: float = option(0.2, gt=0)
    """Prior deviation of the gyroscope's bias at the beginning of a run of segments."""
    prior_accel_bias_mps2: float = option(2.0, gt=0)
    """Prior deviation of the accelerometer's bias at the beginning of a run of segments."""
    prior_velocity_mps: float = option(20.0, gt=0)
    """Prior deviation of the velocity at the beginning of a run of segments."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.grouping()

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
