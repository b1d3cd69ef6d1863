"""The sensors of a scenario as the map's sensor set."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.errors import UserError
from maplab_py.geometry import se3, so3
from maplab_py.sensors import Camera, CameraRig, Distortion, Imu, Projection, SensorSet
from maplab_py.sensors.sensor_set import Extrinsics
from maplab_py.simulation.imu import intrinsics_of
from maplab_py.simulation.scenario import CameraOptions, Scenario
from maplab_py.vimap.ids import random_ids, to_hex

# C looks along x of I: x_C = -y_I, y_C = -z_I, z_C = x_I
_R_I_C_LEVEL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@dataclasses.dataclass(frozen=True, eq=False)
class SimulatedSensors:
    """The sensor set and the ids in it; every session carries the same device."""

    sensor_set: SensorSet
    imu_id: str
    rig: CameraRig


def make_sensors(scenario: Scenario) -> SimulatedSensors:
    """Build IMU and camera rig.

    Raises:
        UserError: A camera model is unknown or has the wrong number of parameters.
    """
    rng = np.random.default_rng([scenario.seeds.world, _ID_STREAM])
    imu_id, rig_id, *camera_ids = (
        to_hex(words) for words in random_ids(2 + len(scenario.cameras), rng)
    )
    options = scenario.imu
    imu = Imu(
        imu_id,
        acc_noise_density=options.accel_noise_density or _SMALL_DENSITY,
        acc_bias_random_walk_noise_density=options.accel_bias_walk or _SMALL_DENSITY,
        gyro_noise_density=options.gyro_noise_density or _SMALL_DENSITY,
        gyro_bias_random_walk_noise_density=options.gyro_bias_walk or _SMALL_DENSITY,
        gravity_magnitude_mps2=options.gravity_mps2,
        intrinsics=intrinsics_of(options),
        description="simulated IMU",
    )
    cameras = tuple(
        _camera(camera_id, row, camera)
        for row, (camera_id, camera) in enumerate(zip(camera_ids, scenario.cameras, strict=True))
    )
    T_I_C = np.stack([_mounting(camera) for camera in scenario.cameras])
    rig = CameraRig(rig_id, cameras, T_I_C, description="simulated camera rig")
    mounts = {
        imu_id: Extrinsics(imu_id, se3.identity()),
        rig_id: Extrinsics(imu_id, se3.identity()),
    }
    return SimulatedSensors(SensorSet({imu_id: imu, rig_id: rig}, mounts), imu_id, rig)


_ID_STREAM = 11
_SMALL_DENSITY = 1e-6
"""An estimator needs some noise to weigh by, even where there is none."""


def _camera(camera_id: str, row: int, options: CameraOptions) -> Camera:
    try:
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
        )
    except ValueError as error:
        raise UserError(f"scenario: cameras[{row}]: {error}") from None


def _mounting(options: CameraOptions) -> np.ndarray:
    q = so3.multiply(so3.exp(options.turn_rad), so3.from_matrix(_R_I_C_LEVEL))
    return se3.make(q, np.asarray(options.position_m, dtype=np.float64))
