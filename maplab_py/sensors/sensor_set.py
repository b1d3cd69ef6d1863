"""All sensors of a map and their extrinsics: the content of sensors.yaml."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maplab_py.errors import MapError
from maplab_py.geometry import se3
from maplab_py.sensors.camera import CameraRig
from maplab_py.sensors.imu import Imu


@dataclasses.dataclass(frozen=True, eq=False)
class OtherSensor:
    """A sensor without a model, whose entry is kept unchanged: odometry, wheels, lidar, GPS."""

    id: str
    sensor_type: str  # as in sensors.yaml, e.g. ODOMETRY_6DOF
    keys: dict[str, Any] = dataclasses.field(default_factory=dict)  # the whole yaml entry


@dataclasses.dataclass(frozen=True, eq=False)
class Extrinsics:
    """Extrinsics of a sensor relative to its base sensor."""

    base_sensor_id: str
    T_B_S: NDArray[np.float64]  # (7,)
    extra: dict[str, Any] = dataclasses.field(default_factory=dict)  # other keys, matrix as read


Sensor = CameraRig | Imu | OtherSensor


@dataclasses.dataclass(frozen=True, eq=False)
class SensorSet:
    """Sensors by id (32 hexadecimal digits) with extrinsics. A value: edits make a new one."""

    sensors: Mapping[str, Sensor] = dataclasses.field(default_factory=dict)
    extrinsics: Mapping[str, Extrinsics] = dataclasses.field(default_factory=dict)
    extra: dict[str, Any] = dataclasses.field(default_factory=dict)  # other top-level keys

    def imu(self, sensor_id: str) -> Imu:
        """Return the IMU with this id.

        Raises:
            MapError: There is no such IMU.
        """
        sensor = self.sensors.get(sensor_id)
        if not isinstance(sensor, Imu):
            raise MapError(f"sensors.yaml has no IMU with id {sensor_id}")
        return sensor

    def camera_rig(self, sensor_id: str) -> CameraRig:
        """Return the camera rig with this id.

        Raises:
            MapError: There is no such rig.
        """
        sensor = self.sensors.get(sensor_id)
        if not isinstance(sensor, CameraRig):
            raise MapError(f"sensors.yaml has no NCAMERA with id {sensor_id}")
        return sensor

    def T_B_S(self, sensor_id: str) -> NDArray[np.float64]:
        """Return the pose (7,) of a sensor on its base; identity when it has no entry."""
        entry = self.extrinsics.get(sensor_id)
        return se3.identity() if entry is None else entry.T_B_S

    def T_I_C(self, imu_id: str, ncamera_id: str) -> NDArray[np.float64]:
        """Return the poses (n, 7) of a rig's cameras on the IMU; see `T_I_S`.

        Raises:
            MapError: A sensor is missing, or no chain of base sensors joins the two.
        """
        rig = self.camera_rig(ncamera_id)
        return se3.compose(self.T_I_S(imu_id, rig.id), rig.T_B_C)

    def T_I_S(self, imu_id: str, sensor_id: str) -> NDArray[np.float64]:
        """Return the pose (7,) of a sensor, or of one camera of a rig, on the IMU.

        Args:
            imu_id: Id of the IMU; empty or all zero = the mission has none, and its body frame is that
                of the last base sensor.
            sensor_id: Id of the sensor or camera.

        Raises:
            MapError: A sensor is missing, or no chain of base sensors joins the two.
        """
        imu = self.imu(imu_id) if imu_id.strip("0") else None
        for rig in self.sensors.values():
            for row, camera in enumerate(rig.cameras if isinstance(rig, CameraRig) else ()):
                if camera.id == sensor_id:
                    return np.asarray(self.T_I_C(imu_id, rig.id)[row])
        if sensor_id not in self.sensors:
            raise MapError(f"sensors.yaml has no sensor with id {sensor_id}")
        sensor_root, T_R_S = self._mounted(sensor_id)
        if imu is None:
            return T_R_S
        imu_root, T_R_I = self._mounted(imu.id)
        if imu_root != sensor_root and self._has_mount(imu.id) and self._has_mount(sensor_id):
            raise MapError(
                f"sensors.yaml: sensor {sensor_id} and IMU {imu.id} have no base sensor in common"
            )
        return se3.relative(T_R_I, T_R_S)

    def T_R_S(self, sensor_id: str) -> NDArray[np.float64]:
        """Return the pose (7,) of a sensor on the last of its base sensors, R.

        R is the body of missions without an IMU.

        Raises:
            MapError: The base sensors form a cycle.
        """
        return self._mounted(sensor_id)[1]

    def without_extrinsics(self) -> tuple[str, ...]:
        """Return the ids of sensors without extrinsics, which default to the pose of their base."""
        return tuple(sensor_id for sensor_id in self.sensors if sensor_id not in self.extrinsics)

    def _has_mount(self, sensor_id: str) -> bool:
        return sensor_id in self.extrinsics

    def _mounted(self, sensor_id: str) -> tuple[str, NDArray[np.float64]]:
        """Follow the base sensors to the last one; return it and the sensor's pose (7,) on it."""
        root, pose, seen = sensor_id, se3.identity(), {sensor_id}
        while root in self.extrinsics and self.extrinsics[root].base_sensor_id != root:
            pose = se3.compose(self.extrinsics[root].T_B_S, pose)
            root = self.extrinsics[root].base_sensor_id
            if root in seen:
                raise MapError(f"sensors.yaml: the base sensors of {sensor_id} form a cycle")
            seen.add(root)
        return root, pose
