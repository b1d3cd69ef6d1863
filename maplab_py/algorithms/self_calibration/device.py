"""The device that recorded the missions of a map, and its calibration."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maplab_py.errors import UserError
from maplab_py.sensors import SensorSet
from maplab_py.sensors.calibration_transfer import (
    Device,
    corresponding_device,
    with_calibration_of,
)
from maplab_py.vimap import MissionSensor, VIMap
from maplab_py.vimap.ids import from_hex
from maplab_py.vimap.queries import mission_sensor_id

_USUAL_IMU_RATE_HZ = 200.0


def device_of(vi_map: VIMap, missions: NDArray[np.integer] | None = None) -> Device:
    """Return the IMU and the camera rig that all missions (rows, None = all) share.

    Raises:
        UserError: Missions have different ones.
    """
    rows = range(len(vi_map.missions)) if missions is None else np.asarray(missions).tolist()
    devices = {
        Device(
            mission_sensor_id(vi_map, row, MissionSensor.IMU),
            mission_sensor_id(vi_map, row, MissionSensor.NCAMERA),
        )
        for row in rows
    }
    if len(devices) != 1:
        raise UserError(
            f"the missions were recorded with {len(devices)} devices or calibrations: "
            "choose those of one with --map_mission_list"
        )
    return devices.pop()


def transfer_calibration(
    vi_map: VIMap, calibrated: SensorSet, *, missions: NDArray[np.integer] | None = None
) -> VIMap:
    """Return the map whose device has the IMU and rig calibration of another set of sensors.

    Sensors are found by id; where the ids differ, a set with one IMU and one rig fits any device.

    Raises:
        UserError: It is not clear which sensors are meant, or the cameras differ.
    """
    device = device_of(vi_map, missions)
    source = corresponding_device(calibrated, device)
    return vi_map.replace(sensors=with_calibration_of(vi_map.sensors, device, calibrated, source))


def with_device_of(vi_map: VIMap, other: VIMap) -> VIMap:
    """Return a map whose missions use the IMU, the rig and the calibration of another map.

    Raises:
        UserError: The rigs differ in more than calibration.
    """
    device = device_of(other)
    cameras = [
        [(c.projection, c.distortion, c.width_px, c.height_px) for c in rig.cameras]
        for rig in (
            vi_map.sensors.camera_rig(device_of(vi_map).rig),
            other.sensors.camera_rig(device.rig),
        )
    ]
    if cameras[0] != cameras[1]:
        raise UserError(
            "the map was recorded with other cameras than the database: their number, models or "
            "resolutions differ; use another database file"
        )
    sensor_id = np.array(vi_map.missions.sensor_id)
    sensor_id[:, MissionSensor.IMU] = from_hex(device.imu)
    sensor_id[:, MissionSensor.NCAMERA] = from_hex(device.rig)
    return vi_map.replace(
        sensors=other.sensors, missions=vi_map.missions.replace(sensor_id=sensor_id)
    )


def imu_rate_hz(vi_map: VIMap) -> float:
    """Return the median rate of the inertial samples of a map; 200 Hz when there are none."""
    steps_ns = np.diff(vi_map.imu_samples.timestamp_ns)
    steps_ns = steps_ns[(steps_ns > 0) & (steps_ns < 1e9)]
    return round(1e9 / float(np.median(steps_ns)), 3) if len(steps_ns) else _USUAL_IMU_RATE_HZ
