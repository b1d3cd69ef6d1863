"""Transfer of a calibration from one set of sensors to another."""

import dataclasses
from typing import NamedTuple

from maplab_py.errors import UserError
from maplab_py.geometry import se3
from maplab_py.sensors.camera import Camera, CameraRig, Distortion, Projection
from maplab_py.sensors.imu import Imu
from maplab_py.sensors.sensor_set import Sensor, SensorSet


class Device(NamedTuple):
    """Sensor ids of an IMU and a camera rig that are calibrated together."""

    imu: str
    rig: str


def only_device(sensors: SensorSet) -> Device:
    """Return the device of a set with one IMU and one camera rig.

    Raises:
        UserError: There are none or several.
    """
    imus = [key for key, sensor in sensors.sensors.items() if isinstance(sensor, Imu)]
    rigs = [key for key, sensor in sensors.sensors.items() if isinstance(sensor, CameraRig)]
    if len(imus) != 1 or len(rigs) != 1:
        raise UserError(
            f"the calibration has {len(imus)} IMUs and {len(rigs)} camera rigs, none of them the "
            "map's: give one with one of each"
        )
    return Device(imus[0], rigs[0])


def corresponding_device(sensors: SensorSet, device: Device) -> Device:
    """Return the device with the same sensor ids in a set, or else the only device of the set.

    Raises:
        UserError: The set has neither.
    """
    has_both = all(sensor_id in sensors.sensors for sensor_id in device)
    return device if has_both else only_device(sensors)


def camera_models(rig: CameraRig) -> list[tuple[Projection, Distortion]]:
    """Return the models of the cameras of a rig, in order."""
    return [(camera.projection, camera.distortion) for camera in rig.cameras]


def with_sensors_of(sensors: SensorSet, calibrated: SensorSet) -> SensorSet:
    """Return sensors, those that a calibrated set has under the same id replaced as a whole."""
    mounts = {k: v for k, v in calibrated.extrinsics.items() if k in calibrated.sensors}
    return dataclasses.replace(
        sensors,
        sensors={**sensors.sensors, **calibrated.sensors},
        extrinsics={**sensors.extrinsics, **mounts},
    )


def with_calibration_of(
    sensors: SensorSet, device: Device, calibrated: SensorSet, source: Device
) -> SensorSet:
    """Return sensors in which a device has the calibration of a device of another set.

    Noise densities, topics and descriptions stay. The rig's mount becomes that on the IMU.

    Raises:
        UserError: The rigs have different cameras.
    """
    imu, rig = sensors.imu(device.imu), sensors.camera_rig(device.rig)
    new_imu, new_rig = calibrated.imu(source.imu), calibrated.camera_rig(source.rig)
    if camera_models(rig) != camera_models(new_rig):
        raise UserError("the calibration is of other cameras: their number or models differ")
    cameras = tuple(map(_calibrated_camera, rig.cameras, new_rig.cameras))
    T_B_C = se3.compose(se3.inverse(sensors.T_I_S(*device)), calibrated.T_I_C(*source))
    changed: dict[str, Sensor] = {
        device.imu: dataclasses.replace(imu, intrinsics=new_imu.intrinsics),
        device.rig: dataclasses.replace(rig, cameras=cameras, T_B_C=T_B_C),
    }
    return dataclasses.replace(sensors, sensors={**sensors.sensors, **changed})


def _calibrated_camera(camera: Camera, calibrated: Camera) -> Camera:
    return dataclasses.replace(
        camera,
        intrinsics=calibrated.intrinsics,
        distortion_parameters=calibrated.distortion_parameters,
        image_delay_s=calibrated.image_delay_s,
        line_delay_ns=calibrated.line_delay_ns,
    )
