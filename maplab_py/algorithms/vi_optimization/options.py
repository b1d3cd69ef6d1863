"""Flags of optvi and optv, with maplab's names."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

from maplab_py.options import option


@dataclasses.dataclass(frozen=True)
class VIOptimizationOptions:
    """What to optimise, how robustly, and for how long."""

    flag_prefix: ClassVar[str] = "ba_"

    num_iterations: int = option(30, help="Largest number of iterations.")
    max_time_seconds: float = option(1e6, help="Stop after this time.", unit="s")
    include_visual: bool = option(True, help="Use the reprojection errors of landmarks.")
    include_inertial: bool = option(True, help="Use the IMU edges and the walk of their biases.")
    include_6dof_odometry: bool = option(False, help="Use the odometry edges.")
    include_wheel_odometry: bool = option(False, help="Use the wheel odometry edges.")
    include_loop_closure_edges: bool = option(False, help="Use the loop closure edges, robustly.")
    loop_closure_robustness: str = option(
        "dcs",
        help="How wrong loop closure edges lose their say: dynamic covariance scaling, a switch "
        "variable each, or not at all.",
        choices=("dcs", "switchable", "none"),
    )
    include_absolute_pose_constraints: bool = option(
        False, help="Use the absolute pose measurements; they then fix position and heading."
    )
    position_prior_sigma_m: float = option(
        0.0, help="Tie vertices to their positions with this deviation; 0 = do not.", unit="m"
    )
    orientation_prior_sigma_rad: float = option(
        0.0, help="Tie vertices to their orientations likewise; 0 = do not.", unit="rad"
    )
    gyro_bias_prior_sigma_radps: float = option(
        0.0, help="Tie gyroscope biases to their values likewise; 0 = do not.", unit="rad/s"
    )
    accel_bias_prior_sigma_mps2: float = option(
        0.0, help="Tie accelerometer biases to their values likewise; 0 = do not.", unit="m/s^2"
    )
    landmark_prior_sigma_m: float = option(
        0.0, help="Tie landmarks to their positions likewise; 0 = do not.", unit="m"
    )
    residuals: str = option("", help="Residuals of plugins to use as well, separated by commas.")
    fix_vertices: bool = option(False, help="Keep all poses.")
    fix_velocity: bool = option(False, help="Keep all velocities.")
    fix_gyro_bias: bool = option(False, help="Keep all gyroscope biases.")
    fix_accel_bias: bool = option(False, help="Keep all accelerometer biases.")
    fix_landmark_positions: bool = option(False, help="Keep all landmarks where they are in G.")
    fix_ncamera_intrinsics: bool = option(True, help="Keep focal lengths, centres, distortion.")
    fix_ncamera_extrinsics_rotation: bool = option(
        True, help="Keep the orientation of the cameras on the IMU."
    )
    fix_ncamera_extrinsics_translation: bool = option(
        True, help="Keep the position of the cameras on the IMU."
    )
    fix_ncamera_time_offset: bool = option(
        True, help="Keep the delay of images against the times of their vertices."
    )
    fix_imu_intrinsics: bool = option(
        True, help="Keep scale and misalignment of gyroscope and accelerometer, and R_A_I."
    )
    fix_6dof_odometry_extrinsics: bool = option(True, help="Keep the odometry sensor's mounting.")
    fix_wheel_odometry_extrinsics: bool = option(True, help="Keep the wheel sensor's mounting.")
    fix_absolute_pose_sensor_extrinsics: bool = option(
        True, help="Keep the mounting of the sensor of absolute poses."
    )
    absolute_pose_sensor_fix_mission_baseframes: bool = option(
        True,
        help="Keep the missions' base frames; otherwise each takes up the movement of its "
        "mission's first vertex.",
    )
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
    min_landmarks_per_frame: int = option(
        0, help="Leave out the observations of images that see fewer landmarks."
    )
    use_only_good_landmarks: bool = option(
        False,
        help="Leave out landmarks of bad quality; otherwise only their gross outliers are left out.",
    )
    use_visual_outlier_rejection_solver: bool = option(
        True, help="Reject observations behind the camera or far off while solving."
    )
    outlier_rejection_reject_every_n_iters: int = option(
        3, help="Look for outliers every this many iterations."
    )
    outlier_rejection_max_reprojection_error_px: float = option(
        5.0,
        help="Observations off by more, and by more than three times the median, are outliers once "
        "solving has begun; they return when they no longer are.",
        unit="px",
    )
    retriangulate_doubtful: bool = option(
        True, help="Triangulate landmarks anew that the gate would take observations from."
    )
    gate_reprojection_error_px: float = option(
        20.0,
        help="Observations off by more at the beginning, and by more than three times the median, "
        "do not take part.",
        unit="px",
    )
    linear_solver_type: str = option(
        "multifrontal",
        help="Block Cholesky, or scipy's SuperLU, which is slower and gives the same answer.",
        choices=("multifrontal", "superlu"),
    )
    trust_region_schedule: str = option(
        "step_quality",
        help="How the trust region follows the quality of steps: as Ceres does, or the same but "
        "bolder after nearly perfect steps.",
        choices=("step_quality", "ceres"),
    )
    use_nonmonotonic_steps: bool = option(
        False, help="Let the cost rise for some steps on the way to a lower one."
    )
    max_consecutive_nonmonotonic_steps: int = option(
        5, help="How many steps in a row may raise the cost, if any may."
    )
    initial_trust_region_radius: float = option(1e5, help="Radius of the trust region at first.")
    max_trust_region_radius: float = option(1e20, help="Largest radius of the trust region.")
    min_trust_region_radius: float = option(1e-32, help="Give up below this radius.")
    function_tolerance: float = option(
        1e-6, help="Stop when an iteration lowers the cost by less than this part of it."
    )
    gradient_tolerance: float = option(1e-10, help="Stop when no gradient is larger.")
    parameter_tolerance: float = option(
        1e-8, help="Stop when a step is smaller than this part of the states."
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
    visualize_every_n_iterations: int = option(
        3, help="Show the map in an open viewer every this many iterations; 0 = only at the end."
    )
    hide_iterations_console_output: bool = option(False, help="Print no line per iteration.")
