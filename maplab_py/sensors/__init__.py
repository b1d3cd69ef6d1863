"""Sensor models: cameras, rigs, IMU, and the set of sensors of a map."""

from maplab_py.sensors.camera import Camera, CameraRig, Distortion, Projection
from maplab_py.sensors.imu import Imu, ImuIntrinsics
from maplab_py.sensors.sensor_set import Extrinsics, OtherSensor, SensorSet

__all__ = [
    "Camera",
    "CameraRig",
    "Distortion",
    "Extrinsics",
    "Imu",
    "ImuIntrinsics",
    "OtherSensor",
    "Projection",
    "SensorSet",
]
