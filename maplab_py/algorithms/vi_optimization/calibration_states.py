"""Convert cameras, IMUs and extrinsics of a map to parameter blocks and back."""

import dataclasses

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.errors import MapError
from maplab_py.estimation.states import States
from maplab_py.estimation.terms import inertial_calibration, pose, wheel
from maplab_py.estimation.terms.cameras import EXTRINSICS, INTRINSICS, TIMING, Cameras
from maplab_py.geometry import se3
from maplab_py.sensors import Camera, CameraRig, Distortion, Imu, Projection, SensorSet
from maplab_py.sensors.camera import DISTORTION_SIZE, INTRINSICS_SIZE
from maplab_py.sensors.wheels import with_wheel_scale
from maplab_py.vimap import MissionSensor, VIMap, mission_sensor_id


@dataclasses.dataclass(frozen=True, eq=False)
class RigCameras:
    """Distinct cameras of missions; missions with the same IMU and rig share rows."""

    cameras: Cameras
    models: tuple[tuple[Projection, Distortion], ...]  # (C,)
    first_of_mission: I64  # (M,) row of each mission's first camera; -1 = not among the missions
    owner: tuple[tuple[str, str, int], ...]  # per row: IMU id, rig id, camera index
    timing_s: F64  # (C, 2) image delay, and time between two rows

    @property
    def is_moving(self) -> bool:
        """Whether pixels of some camera are of other times than their vertices."""
        return bool(self.timing_s.any())


def rig_cameras(vi_map: VIMap, missions: I64) -> RigCameras:
    """Return the cameras of missions (rows).

    Raises:
        MapError: A mission's rig or IMU is not in sensors.yaml.
    """
    first = np.full(len(vi_map.missions), -1, dtype=np.int64)
    start_of: dict[tuple[str, str], int] = {}
    owner: list[tuple[str, str, int]] = []
    poses: list[F64] = []
    used: list[Camera] = []
    for mission in missions.tolist():
        rig_id = mission_sensor_id(vi_map, mission, MissionSensor.NCAMERA)
        imu_id = mission_sensor_id(vi_map, mission, MissionSensor.IMU)
        if (imu_id, rig_id) not in start_of:
            start_of[imu_id, rig_id] = len(used)
            poses.append(vi_map.sensors.T_I_C(imu_id, rig_id))
            used += vi_map.sensors.camera_rig(rig_id).cameras
            owner += [(imu_id, rig_id, k) for k in range(len(poses[-1]))]
        first[mission] = start_of[imu_id, rig_id]
    T_I_C = np.concatenate(poses) if poses else np.zeros((0, 7))
    timing_s = [(camera.image_delay_s, 1e-9 * camera.line_delay_ns) for camera in used]
    models = tuple((camera.projection, camera.distortion) for camera in used)
    timing = np.array(timing_s).reshape(-1, 2)
    return RigCameras(Cameras.of(used, T_I_C), models, first, tuple(owner), timing)


def parameter_count(rig: RigCameras) -> I64:
    """Return the number of intrinsic and distortion parameters (C,) of each camera."""
    sizes = [INTRINSICS_SIZE[p] + DISTORTION_SIZE[d] for p, d in rig.models]
    return np.array(sizes, dtype=np.int64)


def with_cameras(sensors: SensorSet, rig: RigCameras, states: States) -> SensorSet:
    """Return the sensors with the cameras' calibration taken from the states.

    Raises:
        MapError: A rig is used with two IMUs, so that its extrinsics have two estimates.
    """
    counts = parameter_count(rig)
    rigs: dict[str, tuple[str, CameraRig]] = {}
    for row, (imu_id, rig_id, index) in enumerate(rig.owner):
        other_imu, old = rigs.get(rig_id, (imu_id, sensors.camera_rig(rig_id)))
        if other_imu != imu_id:
            raise MapError(
                f"sensors.yaml: rig {rig_id} is used with IMUs {other_imu} and {imu_id}; "
                "calibrate the missions of one IMU at a time (--map_mission_list)"
            )
        camera = old.cameras[index]
        image_delay_s, *line_delay_s = states.blocks[TIMING].values[row].tolist()
        numbers = states.blocks[INTRINSICS].values[row, : counts[row]]
        size = len(camera.intrinsics)
        new = dataclasses.replace(
            camera,
            intrinsics=numbers[:size].copy(),
            distortion_parameters=numbers[size:].copy(),
            image_delay_s=image_delay_s,
            line_delay_ns=round(1e9 * line_delay_s[0]) if line_delay_s else camera.line_delay_ns,
        )
        T_B_C = np.array(old.T_B_C)
        T_B_C[index] = se3.relative(
            sensors.T_I_S(imu_id, rig_id), states.blocks[EXTRINSICS].values[row]
        )
        cameras = (*old.cameras[:index], new, *old.cameras[index + 1 :])
        rigs[rig_id] = imu_id, dataclasses.replace(old, cameras=cameras, T_B_C=T_B_C)
    changed = {rig_id: rig for rig_id, (_, rig) in rigs.items()}
    return dataclasses.replace(sensors, sensors={**sensors.sensors, **changed})


def with_imus(sensors: SensorSet, imus: tuple[Imu, ...], states: States) -> SensorSet:
    """Return the sensors with scale, misalignment and R_A_I of IMUs taken from the states."""
    if inertial_calibration.GYRO not in states.blocks:
        return sensors
    changed = {
        imu.id: dataclasses.replace(imu, intrinsics=intrinsics)
        for imu, intrinsics in zip(
            imus, inertial_calibration.intrinsics_of(states.blocks), strict=True
        )
    }
    return dataclasses.replace(sensors, sensors={**sensors.sensors, **changed})


def with_wheels(sensors: SensorSet, wheels: tuple[str, ...], states: States) -> SensorSet:
    """Return the sensors with the scales of wheel sensors (ids) taken from the states."""
    for sensor_id, (scale,) in zip(
        wheels, states.blocks[wheel.WHEEL_SCALE].values if wheels else (), strict=True
    ):
        sensors = with_wheel_scale(sensors, sensor_id, scale)
    return sensors


@dataclasses.dataclass(frozen=True, eq=False)
class MountedSensors:
    """Sensors whose extrinsics are states: IMU and sensor of every row of the mounting block."""

    owner: tuple[tuple[str, str], ...] = ()

    def written(self, sensors: SensorSet, states: States) -> SensorSet:
        """Return the sensors with these extrinsics taken from the states."""
        if pose.MOUNTING not in states.blocks:
            return sensors
        extrinsics = dict(sensors.extrinsics)
        for (imu_id, sensor_id), T_I_S in zip(
            self.owner, states.blocks[pose.MOUNTING].values, strict=True
        ):
            old = extrinsics.get(sensor_id)
            if old is None:
                raise MapError(
                    f"sensors.yaml: sensor {sensor_id} has no extrinsics to put the result into"
                )
            T_I_B = se3.compose(sensors.T_I_S(imu_id, sensor_id), se3.inverse(old.T_B_S))
            T_B_S = se3.relative(T_I_B, T_I_S)
            extrinsics[sensor_id] = dataclasses.replace(old, T_B_S=T_B_S)
        return dataclasses.replace(sensors, extrinsics=extrinsics)
