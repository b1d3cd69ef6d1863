"""The device that recorded the missions of a map, and its calibration."""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.errors import UserError
from maplab_py.geometry import se3
from maplab_py.interop.calibration_import import CalibrationFile
from maplab_py.sensors import CameraRig, SensorSet
from maplab_py.sensors.calibration_transfer import Device, corresponding_device, with_calibration_of
from maplab_py.vimap import MissionSensor, VIMap, from_hex, mission_sensor_id

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


_NOISE = (
    "acc_noise_density",
    "acc_bias_random_walk_noise_density",
    "gyro_noise_density",
    "gyro_bias_random_walk_noise_density",
)


def with_calibration_file(
    vi_map: VIMap,
    calibration: CalibrationFile,
    *,
    missions: NDArray[np.integer] | None = None,
    imu_noise: bool = True,
) -> VIMap:
    """Return the map whose device has the calibration of a file; poses are unchanged.

    Stamps of a map contain the time offsets that its recording was read with, so another offset becomes
    an image delay; a file without line delay leaves that of the map. A file without IMU leaves the first
    camera where it is on the IMU.

    Args:
        calibration: File.
        missions: Mission rows of one device; None = all.
        imu_noise: Take over the IMU's noise densities.

    Raises:
        UserError: The missions have several devices, or the cameras differ in number, model or size.
    """
    device = device_of(vi_map, missions)
    sensors = vi_map.sensors
    if calibration.rig_id:
        complete, source = _complete(sensors, device, calibration)
        sensors = with_calibration_of(sensors, device, complete, source)
    if calibration.imu_id:
        sensors = _with_imu(sensors, device, calibration, imu_noise=imu_noise)
    return vi_map.replace(sensors=sensors)


def _complete(
    sensors: SensorSet, device: Device, calibration: CalibrationFile
) -> tuple[SensorSet, Device]:
    """Return the rig of a file with an IMU, with image delays instead of time offsets."""
    rig, map_rig = (
        calibration.sensors.camera_rig(calibration.rig_id),
        sensors.camera_rig(device.rig),
    )
    for row, (a, b) in enumerate(zip(map_rig.cameras, rig.cameras, strict=False)):
        if (a.width_px, a.height_px) != (b.width_px, b.height_px):
            raise UserError(
                f"{calibration.source}: camera {row} has images of {b.width_px} x {b.height_px} pixels, "
                f"in the map {a.width_px} x {a.height_px}: calibrate at the resolution of the map"
            )
    cameras = tuple(
        dataclasses.replace(
            b,
            image_delay_s=b.image_delay_s + 1e-9 * (b.time_offset_ns - a.time_offset_ns),
            line_delay_ns=b.line_delay_ns or a.line_delay_ns,
        )
        for a, b in zip(map_rig.cameras, rig.cameras, strict=False)
    )
    if len(map_rig.cameras) != len(rig.cameras):
        raise UserError(
            f"{calibration.source}: has {len(rig.cameras)} cameras, the rig of the map "
            f"{len(map_rig.cameras)}: leave those of the map in the file"
        )
    rig = dataclasses.replace(rig, cameras=cameras)
    if calibration.imu_id:
        all_of = dict(calibration.sensors.sensors) | {rig.id: rig}
        complete = dataclasses.replace(calibration.sensors, sensors=all_of)
        return complete, Device(calibration.imu_id, rig.id)
    return _on_imu_of(sensors, device, rig), Device(device.imu, rig.id)


def _on_imu_of(sensors: SensorSet, device: Device, rig: CameraRig) -> SensorSet:
    """Return the rig beside the map's IMU; its first camera is where that of the map is."""
    T_I_C0 = sensors.T_I_C(*device)[0]
    T_I_C = se3.compose(T_I_C0, se3.relative(rig.T_B_C[0], rig.T_B_C))
    rig = dataclasses.replace(rig, T_B_C=T_I_C)
    return SensorSet({device.imu: sensors.imu(device.imu), rig.id: rig})


def _with_imu(
    sensors: SensorSet, device: Device, calibration: CalibrationFile, *, imu_noise: bool
) -> SensorSet:
    """Take over the noise; the intrinsics of an IMU without cameras where the file has some."""
    imu, map_imu = calibration.sensors.imu(calibration.imu_id), sensors.imu(device.imu)
    if imu.intrinsics is not None:
        map_imu = dataclasses.replace(map_imu, intrinsics=imu.intrinsics)
    if imu_noise:
        map_imu = dataclasses.replace(map_imu, **{name: getattr(imu, name) for name in _NOISE})
    return dataclasses.replace(sensors, sensors={**sensors.sensors, device.imu: map_imu})
