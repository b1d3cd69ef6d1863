"""Scenarios: the description of a simulated data set, as in a YAML file."""

from __future__ import annotations

import dataclasses

PATH_KINDS = ("room_scan", "figure_8", "loop", "corridor", "vehicle", "streets")
"""Motions along a path of the world; other motions start at the current pose."""
MOTION_KINDS = (*PATH_KINDS, "straight", "rotation", "stationary", "hover", "shake")
LAYOUTS = ("rooms", "corridor", "city")


@dataclasses.dataclass(frozen=True)
class Seeds:
    """Independent seeds: a change of one does not affect the results of the others."""

    world: int = 1
    motion: int = 1
    measurement: int = 1
    appearance: int = 1


@dataclasses.dataclass(frozen=True)
class WorldOptions:
    """Surfaces with landmarks on them.

    `rooms`: rooms in a row along x, joined by open doorways. `corridor`: a ring of corridors around
    a solid block, `floors` above each other, joined by stairs in the two short sides. `city`: a grid
    of streets between blocks of houses.
    """

    layout: str = "rooms"  # or corridor, city
    rooms: int = 1
    corridor_rooms: tuple[int, ...] = ()  # are corridors with an appearance of their own
    floors: int = 1  # of a corridor
    blocks: tuple[int, int] = (3, 2)  # columns and rows of a city
    room_size_m: tuple[float, float, float] = (10.0, 8.0, 3.5)  # corridor: of a floor; city: block
    corridor_width_m: float = 2.5  # city: of the streets
    landmarks_per_room: int = 2500  # corridor: per floor; city: per block
    furniture_per_room: int = 4
    patchiness: float = 0.6  # 0 = even density, 1 = all landmarks in clusters
    bare_share: float = 0.0  # of the surfaces: carry a tenth of the landmarks that others do
    identical_rooms: bool = False  # all rooms but corridor_rooms have the same appearance
    identical_floors: bool = False  # all floors of a corridor have the same appearance
    distinct_share: float = 0.03  # share of landmarks that distinguish a room from the others
    moving_objects: int = 0
    landmarks_per_object: int = 60
    object_speed_mps: float = 0.5


@dataclasses.dataclass(frozen=True)
class ImuOptions:
    """IMU model of Schneider 2019, section 7."""

    rate_hz: float = 200.0
    gyro_noise_density: float = 1.7e-4  # [rad/s/sqrt(Hz)]
    accel_noise_density: float = 2.0e-3  # [m/s^2/sqrt(Hz)]
    gyro_bias_walk: float = 2.0e-5  # [rad/s^2/sqrt(Hz)]
    accel_bias_walk: float = 1.0e-3  # [m/s^3/sqrt(Hz)]
    gyro_bias_sigma: float = 0.01  # initial [rad/s]
    accel_bias_sigma: float = 0.1  # initial [m/s^2]
    gravity_mps2: float = 9.81
    saturation_accel_mps2: float = 150.0
    saturation_gyro_radps: float = 7.5
    dropped_share: float = 0.0  # of the samples
    time_jitter_s: float = 0.0  # standard deviation of the time stamps
    gyro_scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    accel_scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    gyro_misalignment: tuple[float, float, float] = (0.0, 0.0, 0.0)  # T_g [01, 02, 12]
    accel_misalignment: tuple[float, float, float] = (0.0, 0.0, 0.0)  # T_a [01, 02, 12]
    accel_rotation_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)  # log R_A_I
    # effects that the IMU model of the map does not include
    g_sensitivity: float = 0.0  # of the gyroscope, along each axis [rad/s per m/s^2]
    lever_arm_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of the accelerometer, in I
    warming_scale: float = 0.0  # by which both scales grow while the device warms up
    warming_time_s: float = 120.0
    time_offset_s: float = 0.0  # IMU time stamps are late by this against the cameras'


@dataclasses.dataclass(frozen=True)
class CameraOptions:
    """One camera of the rig, looking along the body's x axis before it is turned."""

    projection: str = "pinhole"  # unified-projection, double-sphere, extended-unified
    # none, radial-tangential-5, rational-polynomial, equidistant, fisheye (= FOV)
    distortion: str = "radial-tangential"
    intrinsics: tuple[float, ...] = (380.0, 380.0, 376.0, 240.0)
    distortion_parameters: tuple[float, ...] = (-0.28, 0.07, 2e-4, 2e-5)
    width_px: int = 752
    height_px: int = 480
    position_m: tuple[float, float, float] = (0.05, 0.02, 0.01)  # of C in I
    turn_rad: tuple[float, float, float] = (0.01, -0.02, 0.015)  # rotation vector, in I
    line_delay_s: float = 0.0  # between two rows of a rolling shutter; 0 = global shutter


@dataclasses.dataclass(frozen=True)
class MeasurementOptions:
    """Visibility, detection and tracking of landmarks."""

    frame_rate_hz: float = 10.0
    keypoint_sigma_px: float = 0.8  # in the lowest octave
    octaves: int = 1  # of the image pyramid; sigma grows by 1.4 with each
    max_keypoints: int = 500  # with landmark, per frame
    min_distance_m: float = 0.4
    max_distance_m: float = 12.0
    max_view_angle_deg: float = 65.0
    detection_probability: float = 0.9
    track_break_probability: float = 0.02  # per frame
    identity_swap_share: float = 0.03  # of tracks
    track_drift_share: float = 0.0  # of tracks: slide off their point
    track_drift_px: float = 0.5  # per frame, a random walk
    clutter_share: float = 0.2  # of keypoints, without landmark
    min_track_length: int = 3


@dataclasses.dataclass(frozen=True)
class AppearanceOptions:
    """Binary descriptors: signs of correlated activations that move with the viewpoint."""

    descriptor_bytes: int = 48
    latent_dimensions: int = 24
    bit_bias: float = 0.45  # how unequal the bits' thresholds are
    bit_noise: float = 0.3  # of an activation, per observation; the median
    bit_noise_spread: float = 0.9  # of its logarithm over observations
    viewpoint_change: float = 0.45  # per unit of view direction
    scale_change: float = 0.25  # per doubling of the distance
    session_change: float = 0.25  # persistent, per session
    vanish_share: float = 0.3  # landmarks that are not there in a session


@dataclasses.dataclass(frozen=True)
class DriftOptions:
    """Drift of the visual-inertial odometry."""

    position_walk: float = 0.01  # [m/sqrt(s)]
    yaw_walk_deg: float = 0.25  # [deg/sqrt(s)]
    tilt_sigma_deg: float = 0.2
    scale_sigma: float = 0.01
    velocity_sigma: float = 0.03  # [m/s]
    gyro_bias_sigma: float = 5e-4  # [rad/s]
    accel_bias_sigma: float = 0.01  # [m/s^2]
    baseframe_offset_m: float = 5.0  # the stored T_G_M is arbitrary


@dataclasses.dataclass(frozen=True)
class CalibrationOptions:
    """Deviation of a device from the calibration of its maps; only the truth file contains it.

    `imu` and `cameras` of the scenario are the calibration in the maps. Deviations are drawn per device.
    """

    focal_sigma_px: float = 0.0
    centre_sigma_px: float = 0.0
    distortion_sigma: float = 0.0  # of every distortion parameter
    camera_rotation_sigma_deg: float = 0.0
    camera_position_sigma_m: float = 0.0
    gyro_scale_sigma: float = 0.0
    accel_scale_sigma: float = 0.0
    gyro_misalignment_sigma: float = 0.0
    accel_misalignment_sigma: float = 0.0
    accel_rotation_sigma_deg: float = 0.0
    session_share: float = 0.0  # share of all of these that is drawn for every session
    imu_noise_factor: float = 1.0  # noise densities in the map / true ones
    keypoint_noise_factor: float = 1.0  # keypoint sigma in the map / true one


@dataclasses.dataclass(frozen=True)
class OtherSensorOptions:
    """Other sensors than cameras and IMU; errors are white with the stated covariances."""

    absolute_pose_every_s: float = 0.0  # 0 = none; of S in the frame of the world
    absolute_pose_sigma_m: float = 0.05
    absolute_pose_sigma_deg: float = 0.5
    odometry: bool = False  # an edge of S between neighbouring vertices
    wheel_odometry: bool = False  # likewise of the wheels; raw data have their velocities
    odometry_sigma_m: float = 0.005  # per edge, both kinds
    odometry_sigma_deg: float = 0.05
    wheel_scale: float = 1.0  # of the distance that the wheels report; not stated in the map
    wheel_position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of the wheel sensor in I
    wheel_turn_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)  # rotation vector, in I
    sensor_position_m: tuple[float, float, float] = (0.1, 0.0, 0.2)  # of S in I
    sensor_turn_rad: tuple[float, float, float] = (0.0, 0.0, 0.3)  # rotation vector, in I
    loop_edges: int = 0  # per session
    loop_edge_false_share: float = 0.0
    loop_edge_sigma_m: float = 0.03
    loop_edge_sigma_deg: float = 0.5
    loop_edge_min_gap_s: float = 15.0
    loop_edge_max_distance_m: float = 2.0  # false edges join places twice as far apart or more


@dataclasses.dataclass(frozen=True)
class LidarOptions:
    """A spinning lidar. Its clouds are of one moment each: motion during a turn is compensated."""

    rate_hz: float = 0.0  # clouds per second; 0 = no lidar
    rings: int = 16
    columns: int = 900  # per turn
    lowest_deg: float = -22.5  # elevation of the lowest ring
    highest_deg: float = 22.5
    range_sigma_m: float = 0.01
    min_range_m: float = 0.3
    max_range_m: float = 30.0
    position_m: tuple[float, float, float] = (0.0, 0.0, 0.15)  # of the lidar in I
    turn_rad: tuple[float, float, float] = (0.0, 0.0, 0.3)  # rotation vector, in I


@dataclasses.dataclass(frozen=True)
class ImageOptions:
    """Rendered images; they show the world's surfaces through the true cameras."""

    render: bool = False
    depth: bool = True  # beside the truth
    texel_m: float = 0.005  # of the finest texture
    bare_share: float = 0.0  # of the surfaces: a hundredth of the shapes that others have
    exposure_s: float = 0.004
    blur_samples: int = 3  # moments within the exposure; 1 = no motion blur
    gain_swing: float = 0.15  # by which brightness comes and goes
    vignette: float = 0.3  # that the corners are darker
    noise_sigma: float = 2.0  # grey values of 255


@dataclasses.dataclass(frozen=True)
class MotionOptions:
    """A piece of motion.

    Along a path: `room_scan` looks at the walls of a room, `figure_8` crosses it, `loop` goes round
    all rooms through their doorways, `vehicle` does so on wheels, `corridor` walks the corridors and
    stairs, `streets` goes round a rectangle of blocks of a city. From where the body is: `straight`
    (constant velocity), `rotation` (position kept), `stationary`, `hover`, `shake`.
    """

    kind: str = "room_scan"
    duration_s: float = 30.0
    turns: float = 1.2
    start_turn: float = 0.0  # counted from where the last piece of the same kind ended
    reverse: bool = False
    room: int = 0  # of room_scan and figure_8
    first_block: tuple[int, int] = (
        0,
        0,
    )  # of streets: column and row at the rectangle's low corner
    last_block: tuple[int, int] = (0, 0)  # and at its high corner
    height_m: float = 1.5
    height_swing_m: float = 0.2
    wall_distance_m: float = 2.2
    look_around_rad: float = 0.3
    shake_m: float = 0.03
    shake_rad: float = 0.06
    shake_hz: float = 1.0
    speed_mps: float = 0.4  # of straight


@dataclasses.dataclass(frozen=True)
class SessionImages:
    """Properties of a session's rendered images."""

    light: float = 1.0  # by which grey values are multiplied
    gain_jump: float = 0.0  # the gain of the cameras jumps to values within 1 -+ gain_jump
    gain_jump_every_s: float = 0.0  # mean time between the jumps; 0 = none
    repainted_share: float = 0.0  # of the surfaces' area looks different


@dataclasses.dataclass(frozen=True)
class SessionOptions(MotionOptions):
    """One recording: a single piece of motion, several of them one after the other, or a file."""

    phases: tuple[MotionOptions, ...] = ()  # where there are any, they are the motion
    trajectory: str = ""  # EuRoC or TUM file; where there is one, it is the motion
    trajectory_start_s: float = 0.0  # of the part that is used, counted from the begin of the file
    keep_frame: bool = False  # trajectories that do are placed together, not each by itself
    recorded_imu: str = ""  # EuRoC file with the IMU samples of the trajectory; empty = simulated
    device: int = 0  # devices of other numbers have other deviations and ids
    images: SessionImages = SessionImages()

    @property
    def total_s(self) -> float:
        """Length [s]; of a trajectory file the most that is used of it."""
        if self.phases and not self.trajectory:
            return sum(phase.duration_s for phase in self.phases)
        return self.duration_s


@dataclasses.dataclass(frozen=True)
class Scenario:
    """A world and the sessions that are recorded in it."""

    name: str = "unnamed"
    description: str = ""
    seeds: Seeds = Seeds()
    world: WorldOptions = WorldOptions()
    imu: ImuOptions = ImuOptions()
    cameras: tuple[CameraOptions, ...] = (CameraOptions(),)
    measurement: MeasurementOptions = MeasurementOptions()
    appearance: AppearanceOptions = AppearanceOptions()
    drift: DriftOptions = DriftOptions()
    calibration: CalibrationOptions = CalibrationOptions()
    other_sensors: OtherSensorOptions = OtherSensorOptions()
    lidar: LidarOptions = LidarOptions()
    images: ImageOptions = ImageOptions()
    sessions: tuple[SessionOptions, ...] = (SessionOptions(),)

    def with_seed(self, seed: int) -> Scenario:
        """Return the scenario with all four seeds exchanged."""
        return dataclasses.replace(self, seeds=Seeds(seed, seed, seed, seed))
