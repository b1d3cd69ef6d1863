"""What the calibration files of EuRoC folders and of kalibr have in common."""

from __future__ import annotations

import dataclasses
import hashlib
import re
from pathlib import Path

import numpy as np

from maplab_py.array_types import F64
from maplab_py.errors import MapError
from maplab_py.geometry import se3
from maplab_py.input_files import read_text
from maplab_py.interop.recordings.protocol import RecordedSensors
from maplab_py.sensors import Camera, CameraRig, Distortion, Extrinsics, Imu, Projection, SensorSet
from maplab_py.sensors.camera import DISTORTION_SIZE, INTRINSICS_SIZE
from maplab_py.sensors.yaml_entry import Entry
from maplab_py.sensors.yaml_text import parse_yaml

_MAX_BYTES = 16_000_000
_PROJECTIONS = {"pinhole": Projection.PINHOLE, "omni": Projection.UNIFIED}
_DISTORTIONS = {
    "none": Distortion.NONE,
    "radtan": Distortion.RADTAN,
    "radial-tangential": Distortion.RADTAN,
    "plumb_bob": Distortion.RADTAN,
    "equidistant": Distortion.EQUIDISTANT,
    "equi": Distortion.EQUIDISTANT,
    "fov": Distortion.FOV,
}
_OPENCV_HEAD = re.compile(r"\A%YAML:1\.0.*")


def read_entry(path: Path) -> Entry:
    """Read a YAML file of key-value pairs; a first line `%YAML:1.0` (OpenCV) is accepted.

    Raises:
        MapError: It cannot be read or is no such file.
    """
    try:
        remedy = "it is no calibration"
        text = read_text(path, _MAX_BYTES, remedy=remedy, error=MapError, encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        raise MapError(f"cannot read {path}: {reason}") from error
    return Entry(parse_yaml(_OPENCV_HEAD.sub("", text), str(path)), str(path))


def read_camera(entry: Entry, distortion_key: str) -> Camera:
    """Return the camera of an entry; its id is empty.

    Raises:
        MapError: A key is missing or wrong, or a model is not supported.
    """
    projection_name = entry.text("camera_model", default="pinhole")
    projection = _PROJECTIONS.get(projection_name)
    if projection is None:
        known = ", ".join(_PROJECTIONS)
        raise MapError(
            f"{entry.where}: key 'camera_model': '{projection_name}' is not supported: calibrate "
            f"with one of {known}"
        )
    distortion_name = entry.text("distortion_model", default="none")
    distortion = _DISTORTIONS.get(distortion_name.lower())
    if distortion is None:
        known = ", ".join(_DISTORTIONS)
        raise MapError(
            f"{entry.where}: key 'distortion_model': '{distortion_name}' is not supported: "
            f"calibrate with one of {known}"
        )
    parameters = np.zeros(0)
    if DISTORTION_SIZE[distortion]:
        parameters = entry.vector(distortion_key, DISTORTION_SIZE[distortion])
    intrinsics = entry.vector("intrinsics", INTRINSICS_SIZE[projection])
    size = entry.vector("resolution", 2)
    if np.any(intrinsics[-4:-2] <= 0.0) or np.any(size < 1) or np.any(size != np.round(size)):
        raise MapError(
            f"{entry.where}: focal lengths and 'resolution' must be positive, the latter whole"
        )
    return Camera(
        id="",
        projection=projection,
        distortion=distortion,
        intrinsics=intrinsics,
        distortion_parameters=parameters,
        width_px=int(size[0]),
        height_px=int(size[1]),
    )


def read_imu_noise(entry: Entry) -> Imu:
    """Return the IMU of an entry with kalibr's names of noise densities; its id is empty.

    Raises:
        MapError: A key is missing or not positive.
    """
    return Imu(
        id="",
        acc_noise_density=entry.number("accelerometer_noise_density", positive=True),
        acc_bias_random_walk_noise_density=entry.number("accelerometer_random_walk", positive=True),
        gyro_noise_density=entry.number("gyroscope_noise_density", positive=True),
        gyro_bias_random_walk_noise_density=entry.number("gyroscope_random_walk", positive=True),
    )


def make_device(cameras: list[Camera], T_I_C: F64, imu: Imu | None) -> RecordedSensors:
    """Return sensors whose ids follow from their parameters.

    So sessions that were recorded with the same calibration are merged as those of one device.
    """
    named = [dataclasses.replace(camera, id=_camera_id(camera)) for camera in cameras]
    if len({camera.id for camera in named}) < len(named):  # equal parameters at other places
        named = [
            dataclasses.replace(camera, id=_digest(camera.id, str(row)))
            for row, camera in enumerate(named)
        ]
    content = [*(camera.id for camera in named), T_I_C.round(12).tobytes().hex()]
    rig = CameraRig(_digest("rig", *content), tuple(named), T_I_C)
    if imu is None:
        mounts = {rig.id: Extrinsics(rig.id, se3.identity())}
        return RecordedSensors(SensorSet({rig.id: rig}, mounts), rig.id)
    imu = dataclasses.replace(imu, id=_imu_id(imu))
    mounts = {sensor: Extrinsics(imu.id, se3.identity()) for sensor in (imu.id, rig.id)}
    return RecordedSensors(SensorSet({imu.id: imu, rig.id: rig}, mounts), rig.id, imu.id)


def with_cameras(device: RecordedSensors, rows: tuple[int, ...]) -> RecordedSensors:
    """Return the device with some cameras of its rig (rows); () = all.

    Raises:
        MapError: There is no such camera.
    """
    rig = device.rig
    if not rows or rows == tuple(range(len(rig.cameras))):
        return device
    if max(rows) >= len(rig.cameras):
        raise MapError(
            f"--rovio_active_camera_indices: there is no camera {max(rows)}: the calibration has "
            f"{len(rig.cameras)}, counted from 0"
        )
    extra = tuple(rig.camera_extra[row] for row in rows) if rig.camera_extra else ()
    part = dataclasses.replace(
        rig,
        id=_digest(rig.id, *map(str, rows)),
        cameras=tuple(rig.cameras[row] for row in rows),
        T_B_C=rig.T_B_C[list(rows)],
        camera_extra=extra,
    )
    sensors = {part.id if key == rig.id else key: s for key, s in device.sensors.sensors.items()}
    sensors[part.id] = part
    mounts = {}
    for key, mount in device.sensors.extrinsics.items():
        base = part.id if mount.base_sensor_id == rig.id else mount.base_sensor_id
        moved = dataclasses.replace(mount, base_sensor_id=base)
        mounts[part.id if key == rig.id else key] = moved
    return RecordedSensors(SensorSet(sensors, mounts, device.sensors.extra), part.id, device.imu_id)


def with_time_offset(device: RecordedSensors, offset_ns: int) -> RecordedSensors:
    """Return the device with another time offset of all cameras (t_imu = t_camera + offset)."""
    cameras = tuple(
        dataclasses.replace(camera, time_offset_ns=offset_ns) for camera in device.rig.cameras
    )
    rig = dataclasses.replace(device.rig, cameras=cameras)
    sensors = {**device.sensors.sensors, rig.id: rig}
    return dataclasses.replace(device, sensors=dataclasses.replace(device.sensors, sensors=sensors))


def _camera_id(camera: Camera) -> str:
    size = f"{camera.width_px} {camera.height_px} {camera.time_offset_ns} {camera.topic}"
    numbers = np.concatenate([camera.intrinsics, camera.distortion_parameters]).tobytes().hex()
    return _digest(camera.projection.value, camera.distortion.value, size, numbers)


def _imu_id(imu: Imu) -> str:
    numbers = [
        imu.acc_noise_density,
        imu.acc_bias_random_walk_noise_density,
        imu.gyro_noise_density,
        imu.gyro_bias_random_walk_noise_density,
    ]
    if imu.intrinsics is not None:
        for matrix in (imu.intrinsics.T_g, imu.intrinsics.T_a, imu.intrinsics.R_A_I):
            numbers += matrix.round(12).ravel().tolist()
    return _digest("imu", imu.topic, *map(repr, numbers))


def _digest(*parts: str) -> str:
    """Return 32 hexadecimal digits that follow from the parts."""
    return hashlib.blake2b("\n".join(parts).encode(), digest_size=16).hexdigest()
