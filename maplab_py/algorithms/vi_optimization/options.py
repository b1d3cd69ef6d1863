"""Flags of optvi and optv, with maplab's names."""

from maplab_py.errors import FlagError
from maplab_py.options import Options, option
from maplab_py.vimap.descriptors import type_of_name


class DataOptions(Options):
    """Measurements used by the optimisation."""

    include_visual: bool = True
    """Use the reprojection errors of landmarks."""
    include_inertial: bool = True
    """Use the IMU edges and the walk of their biases."""
    include_6dof_odometry: bool = False
    """Use the odometry edges."""
    include_wheel_odometry: bool = False
    """Use the wheel odometry edges."""
    include_loop_closure_edges: bool = False
    """Use the loop closure edges, robustly."""
    loop_closure_robustness: str = option("dcs", choices=("dcs", "switchable", "none"))
    """Robustness against wrong loop closure edges: dynamic covariance scaling, a switch variable per edge, or
    none"""
    include_absolute_pose_constraints: bool = False
    """Use the absolute pose measurements; they then fix position and heading."""
    residuals: str = ""
    """Residuals of plugins to use as well, separated by commas."""
    feature_type: str = ""
    """Use landmarks of this feature type only: Binary, SuperPoint, R2D2, SIFT, LIDARSuperPoint or a number;
    empty = all types."""
    min_landmarks_per_frame: int = 0
    """Leave out the observations of images that see fewer landmarks."""
    use_only_good_landmarks: bool = False
    """Leave out landmarks of bad quality; otherwise only their gross outliers are left out."""
    max_observations_per_landmark: int = option(0, ge=0)
    """Largest number of observations of a landmark: those with the most information about it and about
    vertices with few observations are used; 0 = all."""
    max_covisible_frames: int = option(0, ge=0)
    """Largest number of vertices that a vertex shares landmarks with: observations that join it with others
    are left out; every mission and loop keeps its best pairs; 0 = all."""
    gravity_magnitude_mps2: float = 0.0
    """Gravity; 0 = that of the map's IMU calibration."""
    latitude: float = option(float("nan"), unit="deg")
    """Compute gravity for this latitude instead; nan = no."""
    altitude_meters: float = 0.0
    """Altitude that goes with --ba_latitude."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.feature_type:
            type_of_name(self.feature_type, "ba_feature_type")
        if self.max_observations_per_landmark == 1:
            raise FlagError(
                "--ba_max_observations_per_landmark must be at least 2: one observation does not "
                "determine a landmark; 0 = all"
            )


class FixedStates(Options):
    """Fixed states."""

    calibration: str = option("fixed", choices=("fixed", "auto"))
    """Calibration of the cameras while all of it is fixed: fixed = it stays; auto = once the cost has
    converged, what the residuals contradict is freed, and the optimisation goes on"""
    fix_vertices: bool = False
    """Hold all poses fixed."""
    fix_velocity: bool = False
    """Hold all velocities fixed."""
    fix_gyro_bias: bool = False
    """Hold all gyroscope biases fixed."""
    fix_accel_bias: bool = False
    """Hold all accelerometer biases fixed."""
    fix_landmark_positions: bool = False
    """Fix the positions of all landmarks in G"""
    fix_ncamera_intrinsics: bool = True
    """Hold focal lengths, principal points and distortion fixed."""
    fix_ncamera_extrinsics_rotation: bool = True
    """Hold the orientation of the cameras relative to the IMU fixed."""
    fix_ncamera_extrinsics_translation: bool = True
    """Hold the position of the cameras relative to the IMU fixed."""
    fix_ncamera_time_offset: bool = True
    """Hold the delay of images relative to their vertices' times fixed."""
    fix_ncamera_line_delay: bool = True
    """Hold the time between two rows of rolling-shutter images fixed."""
    fix_imu_intrinsics: bool = True
    """Hold scale and misalignment of gyroscope and accelerometer, and R_A_I, fixed."""
    fix_6dof_odometry_extrinsics: bool = True
    """Hold the odometry sensor's mounting fixed."""
    fix_wheel_odometry_extrinsics: bool = True
    """Hold the wheel sensor's mounting fixed."""
    fix_wheel_scale: bool = True
    """Hold the scale of the wheel sensor, reported / driven distance, fixed."""
    fix_absolute_pose_sensor_extrinsics: bool = True
    """Hold the mounting of the absolute pose sensor fixed."""
    absolute_pose_sensor_fix_mission_baseframes: bool = True
    """Hold the missions' base frames fixed; otherwise each follows the movement of its mission's first
    vertex."""


class PriorOptions(Options):
    """Priors of states at their current values; 0 disables a prior."""

    position_prior_sigma_m: float = 0.0
    """Tie vertices to their positions with this standard deviation; 0 = no prior."""
    orientation_prior_sigma_rad: float = 0.0
    """Tie vertices to their orientations likewise; 0 = no prior."""
    gyro_bias_prior_sigma_radps: float = 0.0
    """Tie gyroscope biases to their values likewise; 0 = no prior."""
    accel_bias_prior_sigma_mps2: float = 0.0
    """Tie accelerometer biases to their values likewise; 0 = no prior."""
    landmark_prior_sigma_m: float = 0.0
    """Tie landmarks to their positions likewise; 0 = no prior."""


class RobustnessOptions(Options):
    """Robust loss and outlier rejection."""

    loss: str = option(
        "cauchy", choices=("none", "huber", "cauchy", "tukey", "geman_mcclure", "dcs")
    )
    """Robust loss of reprojection errors."""
    loss_scale: float = 2.0
    """Scale of the loss, in standard deviations, within a mission."""
    loss_scale_other_mission: float = 4.0
    """Scale of the loss for landmarks stored in another mission, in deviations."""
    use_visual_outlier_rejection_solver: bool = True
    """Reject observations behind the camera or far off while solving."""
    outlier_rejection_reject_every_n_iters: int = 3
    """Number of iterations between tests for outliers"""
    outlier_rejection_max_reprojection_error_px: float = 5.0
    """While solving, observations with a larger reprojection error that also exceeds three times the median
    are outliers; they are used again when their error falls below"""
    retriangulate_doubtful: bool = True
    """Triangulate landmarks with initial outliers again before rejecting observations"""
    gate_reprojection_error_px: float = 20.0
    """Before solving, observations with a larger reprojection error that also exceeds three times the median
    are rejected"""
    absolute_pose_gate_sigma: float = 5.0
    """Before solving, absolute poses whose position differs by more standard deviations from what their
    neighbours say are left out; 0 = none"""
    absolute_pose_loss_scale: float = 4.0
    """Scale of Huber's loss of the absolute poses, in standard deviations; 0 = squared errors"""


class SolverFlags(Options):
    """Linear solver, trust region and convergence criteria."""

    num_iterations: int = 100
    """Largest number of iterations; it stops earlier once it has converged."""
    max_time_seconds: float = 1e6
    """Stop after this time."""
    linear_solver_type: str = option("auto", choices=("auto", "multifrontal", "pcg"))
    """Block Cholesky (multifrontal), conjugate gradients (pcg), or whichever of them is predicted to be
    faster and fits"""
    max_memory_gb: float = 0.0
    """Memory that the direct solver may take; where it needs more, auto takes conjugate gradients; 0 = half
    of what is free."""
    pcg_forcing: float = option(0.01, gt=0, lt=1)
    """Share of the residual that a step by conjugate gradients may leave; 0.0001 follows the direct solver
    more closely and takes about twice as many iterations; between 0 and 1."""
    ordering: str = option("auto", choices=("auto", "minimum_degree", "nested_dissection"))
    """Elimination order of the linear solver: minimum degree, nested dissection (for trajectories that
    overlap), or whichever of them takes less work"""
    use_nonmonotonic_steps: bool = False
    """Accept steps that increase the cost temporarily"""
    max_consecutive_nonmonotonic_steps: int = 5
    """Largest number of consecutive steps that may increase the cost"""
    initial_trust_region_radius: float = 1e8
    """Initial radius of the trust region"""
    max_trust_region_radius: float = 1e20
    """Largest radius of the trust region."""
    min_trust_region_radius: float = 1e-32
    """Smallest radius of the trust region; the solver fails below it"""
    function_tolerance: float = 1e-6
    """Stop when the relative decrease of the cost is smaller"""
    gradient_tolerance: float = 1e-10
    """Stop when the largest entry of the gradient is smaller"""
    parameter_tolerance: float = 1e-8
    """Stop when the relative size of a step is smaller"""


class DisplayOptions(Options):
    """Output while solving."""

    visualize_every_n_iterations: int = 3
    """Show the map in an open viewer every this many iterations; 0 = only at the end."""
    hide_iterations_console_output: bool = False
    """Print no line per iteration."""


class VIOptimizationOptions(
    DisplayOptions,
    SolverFlags,
    RobustnessOptions,
    PriorOptions,
    FixedStates,
    DataOptions,
    prefix="ba_",
):
    """All flags of an optimisation; functions take only the group that they need."""
