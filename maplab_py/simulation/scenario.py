"""Scenarios: everything that describes a simulated data set, as it stands in a YAML file."""

from __future__ import annotations

import dataclasses

MOTION_KINDS = ("room_scan", "figure_8", "loop")


@dataclasses.dataclass(frozen=True)
class Seeds:
    """Independent seeds: changing one leaves what the others produce as it was."""

    world: int = 1
    motion: int = 1
    measurement: int = 1
    appearance: int = 1


@dataclasses.dataclass(frozen=True)
class WorldOptions:
    """Rooms in a row, joined by open doorways, with landmarks on their surfaces and furniture."""

    rooms: int = 1
    room_size_m: tuple[float, float, float] = (10.0, 8.0, 3.5)
    landmarks_per_room: int = 2500
    furniture_per_room: int = 4
    patchiness: float = 0.6  # 0 = even density, 1 = all landmarks in clusters


@dataclasses.dataclass(frozen=True)
class ImuOptions:
    """The thesis' IMU model."""

    rate_hz: float = 200.0
    gyro_noise_density: float = 1.7e-4  # [rad/s/sqrt(Hz)]
    accel_noise_density: float = 2.0e-3  # [m/s^2/sqrt(Hz)]
    gyro_bias_walk: float = 2.0e-5  # [rad/s^2/sqrt(Hz)]
    accel_bias_walk: float = 1.0e-3  # [m/s^3/sqrt(Hz)]
    gyro_bias_sigma: float = 0.01  # initial [rad/s]
    accel_bias_sigma: float = 0.1  # initial [m/s^2]
    gravity_mps2: float = 9.81
    gyro_scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    accel_scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    gyro_misalignment: tuple[float, float, float] = (0.0, 0.0, 0.0)  # T_g [01, 02, 12]
    accel_misalignment: tuple[float, float, float] = (0.0, 0.0, 0.0)  # T_a [01, 02, 12]
    accel_rotation_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)  # log R_A_I


@dataclasses.dataclass(frozen=True)
class CameraOptions:
    """One camera of the rig, looking along the body's x axis before it is turned."""

    projection: str = "pinhole"  # or unified-projection
    distortion: str = "radial-tangential"  # none, equidistant, fisheye (= FOV)
    intrinsics: tuple[float, ...] = (380.0, 380.0, 376.0, 240.0)
    distortion_parameters: tuple[float, ...] = (-0.28, 0.07, 2e-4, 2e-5)
    width_px: int = 752
    height_px: int = 480
    position_m: tuple[float, float, float] = (0.05, 0.02, 0.01)  # of C in I
    turn_rad: tuple[float, float, float] = (0.01, -0.02, 0.015)  # rotation vector, in I


@dataclasses.dataclass(frozen=True)
class MeasurementOptions:
    """What the cameras see and what a tracker makes of it."""

    frame_rate_hz: float = 10.0
    keypoint_sigma_px: float = 0.8
    max_keypoints: int = 500  # with landmark, per frame
    min_distance_m: float = 0.4
    max_distance_m: float = 12.0
    max_view_angle_deg: float = 65.0
    detection_probability: float = 0.9
    track_break_probability: float = 0.02  # per frame
    identity_swap_share: float = 0.03  # of tracks
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
    """How a visual-inertial odometry leaves its states."""

    position_walk: float = 0.01  # [m/sqrt(s)]
    yaw_walk_deg: float = 0.25  # [deg/sqrt(s)]
    tilt_sigma_deg: float = 0.2
    scale_sigma: float = 0.01
    velocity_sigma: float = 0.03  # [m/s]
    gyro_bias_sigma: float = 5e-4  # [rad/s]
    accel_bias_sigma: float = 0.01  # [m/s^2]
    baseframe_offset_m: float = 5.0  # the stored T_G_M means nothing yet


@dataclasses.dataclass(frozen=True)
class MotionOptions:
    """The motion of one session."""

    kind: str = "room_scan"  # figure_8, loop
    duration_s: float = 30.0
    turns: float = 1.2
    start_turn: float = 0.0
    reverse: bool = False
    height_m: float = 1.5
    height_swing_m: float = 0.2
    wall_distance_m: float = 2.2
    look_around_rad: float = 0.3
    shake_m: float = 0.03
    shake_rad: float = 0.06


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
    sessions: tuple[MotionOptions, ...] = (MotionOptions(),)

    def with_seed(self, seed: int) -> Scenario:
        """Return the scenario with all four seeds exchanged."""
        return dataclasses.replace(self, seeds=Seeds(seed, seed, seed, seed))

    def without_noise(self) -> Scenario:
        """Return the scenario with perfect sensors, a perfect tracker and no drift."""
        zero = 0.0
        return dataclasses.replace(
            self,
            imu=dataclasses.replace(
                self.imu,
                gyro_noise_density=zero,
                accel_noise_density=zero,
                gyro_bias_walk=zero,
                accel_bias_walk=zero,
            ),
            measurement=dataclasses.replace(
                self.measurement,
                keypoint_sigma_px=zero,
                identity_swap_share=zero,
                clutter_share=zero,
            ),
            drift=dataclasses.replace(
                self.drift,
                position_walk=zero,
                yaw_walk_deg=zero,
                tilt_sigma_deg=zero,
                scale_sigma=zero,
                velocity_sigma=zero,
                gyro_bias_sigma=zero,
                accel_bias_sigma=zero,
            ),
        )
