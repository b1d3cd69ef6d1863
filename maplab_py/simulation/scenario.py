"""Scenarios: the description of a simulated data set, as in a YAML file."""

from __future__ import annotations

import dataclasses

from maplab_py.options import option
from maplab_py.sensors import Distortion, Projection

PATH_KINDS = ("room_scan", "figure_8", "loop", "corridor", "vehicle", "streets")
"""Motions along a path of the world; other motions start at the current pose."""
MOTION_KINDS = (*PATH_KINDS, "straight", "rotation", "stationary", "hover", "shake")
LAYOUTS = ("rooms", "corridor", "city")


@dataclasses.dataclass(frozen=True)
class Seeds:
    """Independent seeds: a change of one does not affect the results of the others."""

    world: int = option(1, ge=0)
    motion: int = option(1, ge=0)
    measurement: int = option(1, ge=0)
    appearance: int = option(1, ge=0)


@dataclasses.dataclass(frozen=True)
class WorldOptions:
    """Surfaces with landmarks on them.

    `rooms`: rooms in a row along x, joined by open doorways. `corridor`: a ring of corridors around
    a solid block, `floors` above each other, joined by stairs in the two short sides. `city`: a grid
    of streets between blocks of houses.
    """

    layout: str = option("rooms", choices=LAYOUTS)
    rooms: int = option(1, gt=0)
    corridor_rooms: tuple[int, ...] = ()  # are corridors with an appearance of their own
    floors: int = option(1, gt=0)  # of a corridor
    blocks: tuple[int, int] = (3, 2)  # columns and rows of a city
    room_size_m: tuple[float, float, float] = (10.0, 8.0, 3.5)  # corridor: of a floor; city: block
    corridor_width_m: float = option(2.5, gt=0)  # city: of the streets
    landmarks_per_room: int = option(2500, gt=0)  # corridor: per floor; city: per block
    furniture_per_room: int = option(4, ge=0)
    patchiness: float = option(0.6, ge=0, le=1)  # 0 = even density, 1 = all landmarks in clusters
    bare_share: float = option(0.0, ge=0, le=1)  # of the surfaces: carry a tenth of the landmarks
    identical_rooms: bool = False  # all rooms but corridor_rooms have the same appearance
    identical_floors: bool = False  # all floors of a corridor have the same appearance
    distinct_share: float = option(0.03, ge=0, le=1)  # of landmarks: distinguish a room from others
    moving_objects: int = option(0, ge=0)
    landmarks_per_object: int = option(60, gt=0)
    object_speed_mps: float = option(0.5, gt=0)


@dataclasses.dataclass(frozen=True)
class ImuOptions:
    """IMU model of Schneider 2019, section 7."""

    rate_hz: float = option(200.0, gt=0)
    gyro_noise_density: float = option(1.7e-4, ge=0)  # [rad/s/sqrt(Hz)]
    accel_noise_density: float = option(2.0e-3, ge=0)  # [m/s^2/sqrt(Hz)]
    gyro_bias_walk: float = option(2.0e-5, ge=0)  # [rad/s^2/sqrt(Hz)]
    accel_bias_walk: float = option(1.0e-3, ge=0)  # [m/s^3/sqrt(Hz)]
    gyro_bias_sigma: float = option(0.01, ge=0)  # initial [rad/s]
    accel_bias_sigma: float = option(0.1, ge=0)  # initial [m/s^2]
    gravity_mps2: float = option(9.81, gt=0)
    saturation_accel_mps2: float = option(150.0, gt=0)
    saturation_gyro_radps: float = option(7.5, gt=0)
    dropped_share: float = option(0.0, ge=0, le=1)  # of the samples
    time_jitter_s: float = option(0.0, ge=0)  # standard deviation of the time stamps
    gyro_scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    accel_scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    gyro_misalignment: tuple[float, float, float] = (0.0, 0.0, 0.0)  # T_g [01, 02, 12]
    accel_misalignment: tuple[float, float, float] = (0.0, 0.0, 0.0)  # T_a [01, 02, 12]
    accel_rotation_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)  # log R_A_I
    # effects that the IMU model of the map does not include
    g_sensitivity: float = 0.0  # of the gyroscope, along each axis [rad/s per m/s^2]
    lever_arm_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of the accelerometer, in I
    warming_scale: float = 0.0  # by which both scales grow while the device warms up
    warming_time_s: float = option(120.0, gt=0)
    time_offset_s: float = option(0.0, ge=-0.05, le=0.05)  # by which IMU stamps are late


@dataclasses.dataclass(frozen=True)
class CameraOptions:
    """One camera of the rig, looking along the body's x axis before it is turned."""

    projection: str = option("pinhole", choices=[kind.value for kind in Projection])
    distortion: str = option("radial-tangential", choices=[kind.value for kind in Distortion])
    intrinsics: tuple[float, ...] = (380.0, 380.0, 376.0, 240.0)
    distortion_parameters: tuple[float, ...] = (-0.28, 0.07, 2e-4, 2e-5)
    width_px: int = option(752, ge=16)
    height_px: int = option(480, ge=16)
    position_m: tuple[float, float, float] = (0.05, 0.02, 0.01)  # of C in I
    turn_rad: tuple[float, float, float] = (0.01, -0.02, 0.015)  # rotation vector, in I
    line_delay_s: float = 0.0  # between two rows of a rolling shutter; 0 = global shutter


@dataclasses.dataclass(frozen=True)
class MeasurementOptions:
    """Visibility, detection and tracking of landmarks."""

    frame_rate_hz: float = option(10.0, gt=0)
    keypoint_sigma_px: float = option(0.8, ge=0)  # in the lowest octave
    octaves: int = option(1, gt=0)  # of the image pyramid; sigma grows by 1.4 with each
    max_keypoints: int = option(500, gt=0)  # with landmark, per frame
    min_distance_m: float = option(0.4, ge=0)
    max_distance_m: float = option(12.0, gt=0)
    max_view_angle_deg: float = option(65.0, gt=0, le=90)
    detection_probability: float = option(0.9, ge=0, le=1)
    track_break_probability: float = option(0.02, ge=0, le=1)  # per frame
    identity_swap_share: float = option(0.03, ge=0, le=1)  # of tracks
    track_drift_share: float = option(0.0, ge=0, le=1)  # of tracks: slide off their point
    track_drift_px: float = option(0.5, ge=0)  # per frame, a random walk
    clutter_share: float = option(0.2, ge=0, le=0.9)  # of keypoints, without landmark
    min_track_length: int = option(3, ge=2)


@dataclasses.dataclass(frozen=True)
class AppearanceOptions:
    """Binary descriptors: signs of correlated activations that move with the viewpoint."""

    descriptor_bytes: int = option(48, gt=0)
    latent_dimensions: int = option(24, gt=0)
    bit_bias: float = option(0.45, ge=0)  # how unequal the bits' thresholds are
    bit_noise: float = option(0.3, ge=0)  # of an activation, per observation; the median
    bit_noise_spread: float = option(0.9, ge=0)  # of its logarithm over observations
    viewpoint_change: float = option(0.45, ge=0)  # per unit of view direction
    scale_change: float = option(0.25, ge=0)  # per doubling of the distance
    session_change: float = option(0.25, ge=0)  # persistent, per session
    vanish_share: float = option(0.3, ge=0, le=1)  # landmarks that are not there in a session


@dataclasses.dataclass(frozen=True)
class ChangeOptions:
    """Changes between sessions of a world of furnished rooms; none by default."""

    days_between_sessions: float = option(0.0, ge=0)  # 0 = an hour
    moved_share: float = option(0.0, ge=0, le=1)  # of the furniture, before each session
    replaced_posters: int = option(0, ge=0)  # round patches of walls per room and session
    refurbished_session: int = option(0, ge=0)  # before which much changes; 0 = none
    refurbished_share: float = option(0.5, ge=0, le=1)  # of the furniture: replaced by other pieces
    refurbished_posters: int = option(6, ge=0)  # per room
    single_light_share: float = option(0.0, ge=0, le=1)  # of landmarks: seen in one of two lights
    light_change: float = option(0.0, ge=0)  # of activations, between the lights

    @property
    def are_any(self) -> bool:
        """Return whether the world differs between sessions."""
        return max(self.moved_share, self.single_light_share) > 0.0 or (
            max(self.replaced_posters, self.refurbished_session) > 0
        )


@dataclasses.dataclass(frozen=True)
class DriftOptions:
    """Drift of the visual-inertial odometry."""

    position_walk: float = option(0.01, ge=0)  # [m/sqrt(s)]
    yaw_walk_deg: float = option(0.25, ge=0)  # [deg/sqrt(s)]
    tilt_sigma_deg: float = option(0.2, ge=0)
    scale_sigma: float = option(0.01, ge=0)
    velocity_sigma: float = option(0.03, ge=0)  # [m/s]
    gyro_bias_sigma: float = option(5e-4, ge=0)  # [rad/s]
    accel_bias_sigma: float = option(0.01, ge=0)  # [m/s^2]
    baseframe_offset_m: float = option(5.0, ge=0)  # the stored T_G_M is arbitrary


@dataclasses.dataclass(frozen=True)
class CalibrationOptions:
    """Deviation of a device from the calibration of its maps; only the truth file contains it.

    `imu` and `cameras` of the scenario are the calibration in the maps. Deviations are drawn per device.
    """

    focal_sigma_px: float = option(0.0, ge=0)
    centre_sigma_px: float = option(0.0, ge=0)
    distortion_sigma: float = option(0.0, ge=0)  # of every distortion parameter
    camera_rotation_sigma_deg: float = option(0.0, ge=0)
    camera_position_sigma_m: float = option(0.0, ge=0)
    gyro_scale_sigma: float = option(0.0, ge=0)
    accel_scale_sigma: float = option(0.0, ge=0)
    gyro_misalignment_sigma: float = option(0.0, ge=0)
    accel_misalignment_sigma: float = option(0.0, ge=0)
    accel_rotation_sigma_deg: float = option(0.0, ge=0)
    session_share: float = option(0.0, ge=0)  # of all these: drawn for every session
    imu_noise_factor: float = option(1.0, gt=0)  # noise densities in the map / true ones
    keypoint_noise_factor: float = option(1.0, gt=0)  # keypoint sigma in the map / true one


@dataclasses.dataclass(frozen=True)
class OtherSensorOptions:
    """Other sensors than cameras and IMU; errors are white with the stated covariances."""

    absolute_pose_every_s: float = option(0.0, ge=0)  # 0 = none; of S in the frame of the world
    absolute_pose_sigma_m: float = option(0.05, gt=0)
    absolute_pose_sigma_deg: float = option(0.5, gt=0)
    odometry: bool = False  # an edge of S between neighbouring vertices
    wheel_odometry: bool = False  # likewise of the wheels; raw data have their velocities
    odometry_sigma_m: float = option(0.005, gt=0)  # per edge, both kinds
    odometry_sigma_deg: float = option(0.05, gt=0)
    wheel_scale: float = option(1.0, gt=0)  # of the reported distance; not in the map
    wheel_position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of the wheel sensor in I
    wheel_turn_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)  # rotation vector, in I
    sensor_position_m: tuple[float, float, float] = (0.1, 0.0, 0.2)  # of S in I
    sensor_turn_rad: tuple[float, float, float] = (0.0, 0.0, 0.3)  # rotation vector, in I
    loop_edges: int = option(0, ge=0)  # per session
    loop_edge_false_share: float = option(0.0, ge=0, le=1)
    loop_edge_sigma_m: float = option(0.03, gt=0)
    loop_edge_sigma_deg: float = option(0.5, gt=0)
    loop_edge_min_gap_s: float = option(15.0, ge=0)
    loop_edge_max_distance_m: float = option(2.0, gt=0)  # of false ones: twice this or more


@dataclasses.dataclass(frozen=True)
class LidarOptions:
    """A spinning lidar. Its clouds are of one moment each: motion during a turn is compensated."""

    rate_hz: float = option(0.0, ge=0)  # clouds per second; 0 = no lidar
    rings: int = option(16, ge=2)
    columns: int = option(900, ge=16)  # per turn
    lowest_deg: float = option(-22.5, ge=-80)  # elevation of the lowest ring
    highest_deg: float = option(22.5, le=80)
    range_sigma_m: float = option(0.01, ge=0)
    min_range_m: float = option(0.3, ge=0)
    max_range_m: float = 30.0
    position_m: tuple[float, float, float] = (0.0, 0.0, 0.15)  # of the lidar in I
    turn_rad: tuple[float, float, float] = (0.0, 0.0, 0.3)  # rotation vector, in I


@dataclasses.dataclass(frozen=True)
class ImageOptions:
    """Rendered images; they show the world's surfaces through the true cameras."""

    render: bool = False
    depth: bool = True  # beside the truth
    texel_m: float = option(0.005, gt=0)  # of the finest texture
    bare_share: float = option(0.0, ge=0, le=1)  # of the surfaces: a hundredth of the shapes
    exposure_s: float = option(0.004, ge=0)
    blur_samples: int = option(3, gt=0)  # moments within the exposure; 1 = no motion blur
    gain_swing: float = option(0.15, ge=0, le=1)  # by which brightness comes and goes
    vignette: float = option(0.3, ge=0, le=1)  # that the corners are darker
    noise_sigma: float = option(2.0, ge=0)  # grey values of 255


@dataclasses.dataclass(frozen=True)
class MotionOptions:
    """A piece of motion.

    Along a path: `room_scan` looks at the walls of a room, `figure_8` crosses it, `loop` goes round
    all rooms through their doorways, `vehicle` does so on wheels, `corridor` walks the corridors and
    stairs, `streets` goes round a rectangle of blocks of a city. From where the body is: `straight`
    (constant velocity), `rotation` (position kept), `stationary`, `hover`, `shake`.
    """

    kind: str = option("room_scan", choices=MOTION_KINDS)
    duration_s: float = 30.0
    turns: float = 1.2
    start_turn: float = 0.0  # counted from where the last piece of the same kind ended
    reverse: bool = False
    room: int = 0  # of room_scan and figure_8
    first_block: tuple[int, int] = (0, 0)  # of streets: column and row at its low corner
    last_block: tuple[int, int] = (0, 0)  # and at its high corner
    height_m: float = 1.5
    height_swing_m: float = 0.2
    wall_distance_m: float = 2.2
    look_around_rad: float = 0.3
    shake_m: float = 0.03
    shake_rad: float = 0.06
    shake_hz: float = option(1.0, gt=0)
    speed_mps: float = 0.4  # of straight


@dataclasses.dataclass(frozen=True)
class SessionImages:
    """Properties of a session's rendered images."""

    light: float = option(1.0, gt=0)  # by which grey values are multiplied
    gain_jump: float = option(0.0, ge=0, lt=1)  # cameras jump to gains within 1 -+ gain_jump
    gain_jump_every_s: float = option(0.0, ge=0)  # mean time between the jumps; 0 = none
    repainted_share: float = option(0.0, ge=0, le=1)  # of the surfaces' area looks different
    walkers: int = option(0, ge=0, le=100)  # people who cross the view, a tenth of the image each
    walkers_from_s: float = option(0.0, ge=0)
    walkers_until_s: float = option(0.0, ge=0, le=1e5)  # 0 = to the end


@dataclasses.dataclass(frozen=True)
class SessionOptions(MotionOptions):
    """One recording: a single piece of motion, several of them one after the other, or a file."""

    phases: tuple[MotionOptions, ...] = ()  # where there are any, they are the motion
    trajectory: str = ""  # EuRoC or TUM file; where there is one, it is the motion
    trajectory_start_s: float = option(0.0, ge=0)  # of the part used, from the start of the file
    keep_frame: bool = False  # trajectories that do are placed together, not each by itself
    recorded_imu: str = ""  # EuRoC file with the IMU samples of the trajectory; empty = simulated
    device: int = option(0, ge=0)  # devices of other numbers have other deviations and ids
    light: int = option(0, ge=0, le=1)  # of two conditions; see `changes`
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
    changes: ChangeOptions = ChangeOptions()
    sessions: tuple[SessionOptions, ...] = (SessionOptions(),)

    def with_seed(self, seed: int) -> Scenario:
        """Return the scenario with all four seeds exchanged."""
        return dataclasses.replace(self, seeds=Seeds(seed, seed, seed, seed))
