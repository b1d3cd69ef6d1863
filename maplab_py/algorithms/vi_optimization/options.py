"""Flags of optvi and optv, with maplab's names."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

from maplab_py.errors import FlagError
from maplab_py.options import option
from maplab_py.vimap.descriptors import type_of_name


@dataclasses.dataclass(frozen=True)
class DataOptions:
    """Measurements used by the optimisation."""

    include_visual: bool = option(True, help="Use the reprojection errors of landmarks.")
    include_inertial: bool = option(True, help="Use the IMU edges and the walk of their biases.")
    include_6dof_odometry: bool = option(False, help="Use the odometry edges.")
    include_wheel_odometry: bool = option(False, help="Use the wheel odometry edges.")
    include_loop_closure_edges: bool = option(False, help="Use the loop closure edges, robustly.")
    loop_closure_robustness: str = option(
        "dcs",
        help="Robustness against wrong loop closure edges: dynamic covariance scaling, a switch "
        "variable per edge, or none",
        choices=("dcs", "switchable", "none"),
    )
    include_absolute_pose_constraints: bool = option(
        False, help="Use the absolute pose measurements; they then fix position and heading."
    )
    residuals: str = option("", help="Residuals of plugins to use as well, separated by commas.")
    feature_type: str = option(
        "",
        help="Use landmarks of this feature type only: Binary, SuperPoint, R2D2, SIFT, LIDARSuperPoint or a "
        "number; empty = all types.",
    )
    min_landmarks_per_frame: int = option(
        0, help="Leave out the observations of images that see fewer landmarks."
    )
    use_only_good_landmarks: bool = option(
        False,
        help="Leave out landmarks of bad quality; otherwise only their gross outliers are left out.",
    )
    max_observations_per_landmark: int = option(
        0,
        help="Largest number of observations of a landmark: those with the most information about it and "
        "about vertices with few observations are used; 0 = all.",
    )
    max_covisible_frames: int = option(
        0,
        help="Largest number of vertices that a vertex shares landmarks with: observations that join it "
        "with others are left out; every mission and loop keeps its best pairs; 0 = all.",
    )
    gravity_magnitude_mps2: float = option(
        0.0, help="Gravity; 0 = that of the map's IMU calibration.", unit="m/s^2"
    )
    latitude: float = option(
        float("nan"),
        help="Compute gravity for this latitude instead; nan = no.",
        unit="deg",
    )
    altitude_meters: float = option(0.0, help="Altitude that goes with --ba_latitude.", unit="m")

    def __post_init__(self) -> None:
        """Check the limits of thinning and the feature type."""
        if self.feature_type:
            try:
                type_of_name(self.feature_type)
            except FlagError as error:
                raise FlagError(f"--ba_feature_type: {error}") from None
        for name in ("max_observations_per_landmark", "max_covisible_frames"):
            if getattr(self, name) < 0:
                raise FlagError(f"--ba_{name} must not be negative; 0 = all")
        if self.max_observations_per_landmark == 1:
            raise FlagError(
                "--ba_max_observations_per_landmark must be at least 2: one observation does not "
                "determine a landmark; 0 = all"
            )


@dataclasses.dataclass(frozen=True)
class FixedStates:
    """Fixed states."""

    calibration: str = option(
        "fixed",
        help="Calibration of the cameras while all of it is fixed: fixed = it stays; auto = once the cost "
        "has converged, what the residuals contradict is freed, and the optimisation goes on",
        choices=("fixed", "auto"),
    )
    fix_vertices: bool = option(False, help="Hold all poses fixed.")
    fix_velocity: bool = option(False, help="Hold all velocities fixed.")
    fix_gyro_bias: bool = option(False, help="Hold all gyroscope biases fixed.")
    fix_accel_bias: bool = option(False, help="Hold all accelerometer biases fixed.")
    fix_landmark_positions: bool = option(False, help="Fix the positions of all landmarks in G")
    fix_ncamera_intrinsics: bool = option(
        True, help="Hold focal lengths, principal points and distortion fixed."
    )
    fix_ncamera_extrinsics_rotation: bool = option(
        True, help="Hold the orientation of the cameras relative to the IMU fixed."
    )
    fix_ncamera_extrinsics_translation: bool = option(
        True, help="Hold the position of the cameras relative to the IMU fixed."
    )
    fix_ncamera_time_offset: bool = option(
        True, help="Hold the delay of images relative to their vertices' times fixed."
    )
    fix_ncamera_line_delay: bool = option(
        True, help="Hold the time between two rows of rolling-shutter images fixed."
    )
    fix_imu_intrinsics: bool = option(
        True, help="Hold scale and misalignment of gyroscope and accelerometer, and R_A_I, fixed."
    )
    fix_6dof_odometry_extrinsics: bool = option(
        True, help="Hold the odometry sensor's mounting fixed."
    )
    fix_wheel_odometry_extrinsics: bool = option(
        True, help="Hold the wheel sensor's mounting fixed."
    )
    fix_wheel_scale: bool = option(
        True, help="Hold the scale of the wheel sensor, reported / driven distance, fixed."
    )
    fix_absolute_pose_sensor_extrinsics: bool = option(
        True, help="Hold the mounting of the absolute pose sensor fixed."
    )
    absolute_pose_sensor_fix_mission_baseframes: bool = option(
        True,
        help="Hold the missions' base frames fixed; otherwise each follows the movement of its "
        "mission's first vertex.",
    )


@dataclasses.dataclass(frozen=True)
class PriorOptions:
    """Priors of states at their current values; 0 disables a prior."""

    position_prior_sigma_m: float = option(
        0.0,
        help="Tie vertices to their positions with this standard deviation; 0 = no prior.",
        unit="m",
    )
    orientation_prior_sigma_rad: float = option(
        0.0, help="Tie vertices to their orientations likewise; 0 = no prior.", unit="rad"
    )
    gyro_bias_prior_sigma_radps: float = option(
        0.0, help="Tie gyroscope biases to their values likewise; 0 = no prior.", unit="rad/s"
    )
    accel_bias_prior_sigma_mps2: float = option(
        0.0, help="Tie accelerometer biases to their values likewise; 0 = no prior.", unit="m/s^2"
    )
    landmark_prior_sigma_m: float = option(
        0.0, help="Tie landmarks to their positions likewise; 0 = no prior.", unit="m"
    )


@dataclasses.dataclass(frozen=True)
class RobustnessOptions:
    """Robust loss and outlier rejection."""

    loss: str = option(
        "cauchy",
        help="Robust loss of reprojection errors.",
        choices=("none", "huber", "cauchy", "tukey", "geman_mcclure", "dcs"),
    )
    loss_scale: float = option(
        2.0, help="Scale of the loss, in standard deviations, within a mission."
    )
    loss_scale_other_mission: float = option(
        4.0, help="Scale of the loss for landmarks stored in another mission, in deviations."
    )
    use_visual_outlier_rejection_solver: bool = option(
        True, help="Reject observations behind the camera or far off while solving."
    )
    outlier_rejection_reject_every_n_iters: int = option(
        3, help="Number of iterations between tests for outliers"
    )
    outlier_rejection_max_reprojection_error_px: float = option(
        5.0,
        help="While solving, observations with a larger reprojection error that also exceeds three times "
        "the median are outliers; they are used again when their error falls below",
        unit="px",
    )
    retriangulate_doubtful: bool = option(
        True, help="Triangulate landmarks with initial outliers again before rejecting observations"
    )
    gate_reprojection_error_px: float = option(
        20.0,
        help="Before solving, observations with a larger reprojection error that also exceeds three times "
        "the median are rejected",
        unit="px",
    )
    absolute_pose_gate_sigma: float = option(
        5.0,
        help="Before solving, absolute poses whose position differs by more standard deviations from what "
        "their neighbours say are left out; 0 = none",
    )
    absolute_pose_loss_scale: float = option(
        4.0,
        help="Scale of Huber's loss of the absolute poses, in standard deviations; 0 = squared errors",
    )


@dataclasses.dataclass(frozen=True)
class SolverFlags:
    """Linear solver, trust region and convergence criteria."""

    num_iterations: int = option(
        100, help="Largest number of iterations; it stops earlier once it has converged."
    )
    max_time_seconds: float = option(1e6, help="Stop after this time.", unit="s")
    linear_solver_type: str = option(
        "auto",
        help="Block Cholesky (multifrontal), conjugate gradients (pcg), or whichever of them is predicted "
        "to be faster and fits; superlu is slower than multifrontal and gives the same answer",
        choices=("auto", "multifrontal", "pcg", "superlu"),
    )
    max_memory_gb: float = option(
        0.0,
        help="Memory that the direct solver may take; where it needs more, auto takes conjugate gradients; "
        "0 = half of what is free.",
        unit="GB",
    )
    pcg_forcing: float = option(
        0.01,
        help="Share of the residual that a step by conjugate gradients may leave; 0.0001 follows the direct "
        "solver more closely and takes about twice as many iterations; between 0 and 1.",
    )
    ordering: str = option(
        "auto",
        help="Elimination order of the linear solver: minimum degree, nested dissection (for trajectories "
        "that overlap), or whichever of them takes less work",
        choices=("auto", "minimum_degree", "nested_dissection"),
    )
    submaps: int = option(
        0,
        help="Number of submaps into which the problem is cut where few states connect them; keep the "
        "equations of one submap at a time in memory, the others in the temporary folder (TMPDIR); the steps "
        "are those of the direct solver; 0 = all in memory.",
    )
    submap_rounds: int = option(
        0,
        help="Largest number of rounds over all submaps with --ba_submaps, each of which is an iteration of "
        "the joint problem; 0 = --ba_num_iterations.",
    )
    trust_region_schedule: str = option(
        "step_quality",
        help="Update of the trust region radius: as in Ceres, or the same with a larger increase after "
        "steps of high quality",
        choices=("step_quality", "ceres"),
    )
    use_nonmonotonic_steps: bool = option(
        False, help="Accept steps that increase the cost temporarily"
    )
    max_consecutive_nonmonotonic_steps: int = option(
        5, help="Largest number of consecutive steps that may increase the cost"
    )
    initial_trust_region_radius: float = option(1e5, help="Initial radius of the trust region")
    max_trust_region_radius: float = option(1e20, help="Largest radius of the trust region.")
    min_trust_region_radius: float = option(
        1e-32, help="Smallest radius of the trust region; the solver fails below it"
    )
    function_tolerance: float = option(
        1e-6, help="Stop when the relative decrease of the cost is smaller"
    )
    gradient_tolerance: float = option(
        1e-10, help="Stop when the largest entry of the gradient is smaller"
    )
    parameter_tolerance: float = option(
        1e-8, help="Stop when the relative size of a step is smaller"
    )


@dataclasses.dataclass(frozen=True)
class DisplayOptions:
    """Output while solving."""

    visualize_every_n_iterations: int = option(
        3, help="Show the map in an open viewer every this many iterations; 0 = only at the end."
    )
    hide_iterations_console_output: bool = option(False, help="Print no line per iteration.")


@dataclasses.dataclass(frozen=True)
class VIOptimizationOptions(
    DisplayOptions, SolverFlags, RobustnessOptions, PriorOptions, FixedStates, DataOptions
):
    """All flags of an optimisation; functions take only the group that they need."""

    flag_prefix: ClassVar[str] = "ba_"
