"""Devices: the sensor set that the maps carry, and the true calibration, which differs."""

import dataclasses

import numpy as np

from maplab_py.array_types import F64
from maplab_py.geometry import se3, so3, yaw
from maplab_py.sensors import (
    Camera,
    CameraRig,
    Distortion,
    Imu,
    ImuIntrinsics,
    Projection,
    SensorSet,
)
from maplab_py.sensors.sensor_set import Extrinsics
from maplab_py.simulation.imu import intrinsics_of
from maplab_py.simulation.scenario import CameraOptions, DriftOptions, Scenario
from maplab_py.simulation.spline import MotionState
from maplab_py.vimap.ids import random_ids, to_hex

# C looks along x of I: x_C = -y_I, y_C = -z_I, z_C = x_I
_R_I_C_LEVEL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
_ID_STREAM, _DEVIATION_STREAM = 11, 13
_SMALL_DENSITY = 1e-6
"""Noise densities of perfect sensors in the map, which an estimator needs as weights."""


@dataclasses.dataclass(frozen=True, eq=False)
class Device:
    """Nominal calibration of a device and its true calibration in a session."""

    sensor_set: SensorSet  # as the map stores it
    imu_id: str
    rig: CameraRig  # as the map stores it
    true_rig: CameraRig
    true_imu: ImuIntrinsics


def make_device(scenario: Scenario, number: int, session: int) -> Device:
    """Build IMU and camera rig of a device as they are in a session.

    Args:
        scenario: Scenario, whose `imu` and `cameras` are the calibration in the maps.
        number: Which device: ids and deviations depend on it.
        session: Deviations depend on it by the calibration's session_share.
    """
    seed = [scenario.seeds.world, _ID_STREAM, *([number] if number else [])]
    rng = np.random.default_rng(seed)
    imu_id, rig_id, *camera_ids = (
        to_hex(words) for words in random_ids(2 + len(scenario.cameras), rng)
    )
    cameras = tuple(
        _camera(camera_id, row, camera)
        for row, (camera_id, camera) in enumerate(zip(camera_ids, scenario.cameras, strict=True))
    )
    T_I_C = np.stack([_mounting(camera) for camera in scenario.cameras])
    rig = CameraRig(rig_id, cameras, T_I_C, description="simulated camera rig")
    imu = _stored_imu(scenario, imu_id)
    mounts = {
        imu_id: Extrinsics(imu_id, se3.identity()),
        rig_id: Extrinsics(imu_id, se3.identity()),
    }
    deviation = _Deviation(scenario, number, session)
    return Device(
        SensorSet({imu_id: imu, rig_id: rig}, mounts),
        imu_id,
        rig,
        deviation.of_rig(rig),
        deviation.of_imu(imu.intrinsics or ImuIntrinsics()),
    )


class _Deviation:
    """Draws the deviations of the true values in a fixed order."""

    def __init__(self, scenario: Scenario, device: int, session: int) -> None:
        self._options = scenario.calibration
        base = [scenario.seeds.world, _DEVIATION_STREAM, device]
        self._of_device = np.random.default_rng(base)
        self._of_session = np.random.default_rng([*base, session + 1])

    def _draw(self, size: int) -> F64:
        lasting, passing = (
            rng.standard_normal(size) for rng in (self._of_device, self._of_session)
        )
        return np.asarray(lasting + self._options.session_share * passing)

    def of_rig(self, rig: CameraRig) -> CameraRig:
        """Return the true cameras and where they truly sit."""
        options = self._options
        cameras, poses = [], []
        for camera, T_I_C in zip(rig.cameras, rig.T_B_C, strict=True):
            intrinsics = np.array(camera.intrinsics)
            intrinsics[-4:-2] += options.focal_sigma_px * self._draw(2)
            intrinsics[-2:] += options.centre_sigma_px * self._draw(2)
            shape = len(camera.distortion_parameters)
            distortion = camera.distortion_parameters + options.distortion_sigma * self._draw(shape)
            cameras.append(
                dataclasses.replace(camera, intrinsics=intrinsics, distortion_parameters=distortion)
            )
            turn = np.deg2rad(options.camera_rotation_sigma_deg) * self._draw(3)
            move = options.camera_position_sigma_m * self._draw(3)
            poses.append(se3.retract(T_I_C, np.concatenate([move, turn])))
        return dataclasses.replace(rig, cameras=tuple(cameras), T_B_C=np.stack(poses))

    def of_imu(self, stored: ImuIntrinsics) -> ImuIntrinsics:
        """Return true scale, misalignment and rotation of the accelerometer."""
        options = self._options
        T_g = stored.T_g + self._triangle(options.gyro_scale_sigma, options.gyro_misalignment_sigma)
        T_a = stored.T_a + self._triangle(
            options.accel_scale_sigma, options.accel_misalignment_sigma
        )
        turn = np.deg2rad(options.accel_rotation_sigma_deg) * self._draw(3)
        return ImuIntrinsics(T_g, T_a, stored.R_A_I @ so3.to_matrix(so3.exp(turn)))

    def _triangle(self, scale_sigma: float, misalignment_sigma: float) -> F64:
        matrix = np.diag(scale_sigma * self._draw(3))
        matrix[[0, 0, 1], [1, 2, 2]] = misalignment_sigma * self._draw(3)
        return matrix


def _stored_imu(scenario: Scenario, imu_id: str) -> Imu:
    options = scenario.imu
    factor = scenario.calibration.imu_noise_factor
    return Imu(
        imu_id,
        acc_noise_density=factor * options.accel_noise_density or _SMALL_DENSITY,
        acc_bias_random_walk_noise_density=factor * options.accel_bias_walk or _SMALL_DENSITY,
        gyro_noise_density=factor * options.gyro_noise_density or _SMALL_DENSITY,
        gyro_bias_random_walk_noise_density=factor * options.gyro_bias_walk or _SMALL_DENSITY,
        gravity_magnitude_mps2=options.gravity_mps2,
        intrinsics=intrinsics_of(options),
        description="simulated IMU",
    )


def _camera(camera_id: str, row: int, options: CameraOptions) -> Camera:
    return Camera(
        camera_id,
        Projection(options.projection),
        Distortion(options.distortion),
        np.asarray(options.intrinsics, dtype=np.float64),
        np.asarray(options.distortion_parameters, dtype=np.float64),
        options.width_px,
        options.height_px,
        topic=f"cam{row}",
        description="simulated camera",
        # vertices are in the middle of the readout
        image_delay_s=-0.5 * options.line_delay_s * options.height_px,
        line_delay_ns=round(1e9 * options.line_delay_s),
    )


def _mounting(options: CameraOptions) -> F64:
    q = so3.multiply(so3.exp(options.turn_rad), so3.from_matrix(_R_I_C_LEVEL))
    return se3.make(q, np.asarray(options.position_m, dtype=np.float64))


_TILT_TIME_S = 10.0
"""Correlation time of roll and pitch errors, which gravity bounds."""


@dataclasses.dataclass(frozen=True, eq=False)
class DriftedStates:
    """Odometry estimates at the vertices in the mission frame M."""

    T_M_I: F64  # (V, 7)
    v_M: F64  # (V, 3)


def mission_frame(T_G_I_first: F64) -> F64:
    """Return the true T_G_M (7,): M lies at the first body position, with its yaw."""
    element = yaw.from_pose(T_G_I_first)
    return yaw.to_pose(element)


def drift(
    options: DriftOptions, motion: MotionState, time_s: F64, rng: np.random.Generator
) -> DriftedStates:
    """Return drifting states of a motion that is known at vertex times (V,) [s]."""
    count = len(time_s)
    T_M_I = se3.compose(se3.inverse(mission_frame(motion.T_G_I[0])), motion.T_G_I)
    q_M_G = so3.inverse(mission_frame(motion.T_G_I[0])[:4])
    v_M = so3.rotate(q_M_G, motion.v_G)
    root = np.sqrt(np.diff(time_s))
    yaw_steps = np.deg2rad(options.yaw_walk_deg) * root * rng.standard_normal(count - 1)
    yaw_error = np.concatenate([[0.0], np.cumsum(yaw_steps)])
    scale = 1.0 + options.scale_sigma * rng.standard_normal()
    steps = scale * yaw.rotate(yaw_error[:-1], np.diff(T_M_I[:, 4:], axis=0))
    steps += options.position_walk * root[:, None] * rng.standard_normal((count - 1, 3))
    p = T_M_I[0, 4:] + np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    tilt = _tilt(options, time_s, rng)
    q = so3.multiply(yaw.quaternion(yaw_error), so3.multiply(tilt, T_M_I[:, :4]))
    v = scale * yaw.rotate(yaw_error, v_M)
    v += options.velocity_sigma * rng.standard_normal((count, 3))
    return DriftedStates(se3.make(so3.normalize(q), p), v)


def _tilt(options: DriftOptions, time_s: F64, rng: np.random.Generator) -> F64:
    """Return roll and pitch errors as rotations (V, 4): a stationary first-order process.

    x_k = r x_{k-1} + sqrt(1 - r^2) n_k with r = exp(-dt / tau), dt the mean time step.
    """
    from scipy.signal import lfilter

    noise = rng.standard_normal((len(time_s), 2))
    decay = np.exp(-np.mean(np.diff(time_s)) / _TILT_TIME_S)
    noise[1:] *= np.sqrt(1.0 - decay**2)
    error = np.asarray(lfilter([1.0], [1.0, -decay], noise, axis=0))
    vector = np.concatenate([error, np.zeros((len(time_s), 1))], axis=1)
    return so3.exp(np.deg2rad(options.tilt_sigma_deg) * vector)


def baseframe(options: DriftOptions, rng: np.random.Generator) -> F64:
    """Return the initial T_G_M (7,) of the map, with random yaw and position."""
    offset = rng.uniform(-options.baseframe_offset_m, options.baseframe_offset_m, 3)
    return yaw.to_pose(np.append(offset, rng.uniform(-np.pi, np.pi)))
