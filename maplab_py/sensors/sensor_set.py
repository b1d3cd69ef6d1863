"""All sensors of a map and how they are mounted: the content of sensors.yaml."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maplab_py.errors import MapError
from maplab_py.geometry import se3
from maplab_py.sensors.imu import Imu
from maplab_py.sensors.rig import CameraRig


@dataclasses.dataclass(frozen=True, eq=False)
class OtherSensor:
    """A sensor that is kept as it was found: odometry, wheels, absolute poses, lidar, GPS."""

    id: str
    sensor_type: str  # as in sensors.yaml, e.g. ODOMETRY_6DOF
    keys: dict[str, Any] = dataclasses.field(default_factory=dict)  # the whole yaml entry


@dataclasses.dataclass(frozen=True, eq=False)
class Extrinsics:
    """How a sensor is mounted on its base sensor."""

    base_sensor_id: str
    T_B_S: NDArray[np.float64]  # (7,)


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
