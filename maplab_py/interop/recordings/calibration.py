"""The sensors of a recording: from its own folder, from sensors.yaml, or from kalibr's files."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from maplab_py.array_types import F64
from maplab_py.errors import MapError, UserError
from maplab_py.geometry import se3
from maplab_py.interop.recordings.kalibr import is_camera_chain, read_kalibr
from maplab_py.interop.recordings.models import make_device, read_camera, read_entry, read_imu_noise
from maplab_py.interop.recordings.options import DeviceOptions
from maplab_py.interop.recordings.protocol import RecordedSensors
from maplab_py.sensors import Camera, CameraRig, Imu, SensorSet
from maplab_py.sensors.sensors_yaml import read_sensors

ANY_DEVICE = DeviceOptions()
HOW_TO_CALIBRATE = "give --sensor_calibration_file=FILE (sensors.yaml, or kalibr's camchain)"


def read_calibration(
    path: Path, imu_file: Path | None = None, chosen: DeviceOptions = ANY_DEVICE
) -> RecordedSensors:
    """Read a sensors.yaml, or kalibr's camera chain with its IMU file.

    Raises:
        MapError: A file cannot be read or is wrong.
        UserError: There is an IMU file for a sensors.yaml, sensors are chosen for a camera chain, or
            it remains open which rig or IMU is to be used.
    """
    if is_camera_chain(read_entry(path)):
        chosen.check_unused(f"{path} is a camera chain")
        return read_kalibr(path, imu_file)
    if imu_file is not None:
        raise UserError(
            f"--imu_calibration_file={imu_file} belongs to a camera chain of kalibr, and {path} is none"
        )
    return device_of(read_sensors(path), str(path), chosen)


def device_of(
    sensors: SensorSet, source: str, chosen: DeviceOptions = ANY_DEVICE
) -> RecordedSensors:
    """Return the chosen camera rig of a set of sensors, with the chosen IMU if there is any.

    Raises:
        UserError: There is no rig, a choice fits none or several, or is missing where there are
            several.
    """
    rigs = [key for key, sensor in sensors.sensors.items() if isinstance(sensor, CameraRig)]
    imus = [key for key, sensor in sensors.sensors.items() if isinstance(sensor, Imu)]
    if not rigs:
        raise UserError(f"{source} has no camera rig: give a calibration with cameras")
    rig = _selected(rigs, chosen.ncamera_sensor_id, f"{source}: camera rigs", "ncamera")
    has_imu = bool(imus or chosen.imu_sensor_id)
    imu = _selected(imus, chosen.imu_sensor_id, f"{source}: IMUs", "imu") if has_imu else ""
    return RecordedSensors(sensors, rig, imu)


def _selected(ids: list[str], prefix: str, what: str, kind: str) -> str:
    """Return the only id that begins with a prefix."""
    flag = f"--selected_{kind}_sensor_id"
    matches = [sensor_id for sensor_id in ids if sensor_id.startswith(prefix.lower())]
    if len(matches) == 1:
        return matches[0]
    known = ", ".join(ids) or "none"
    if not prefix:
        raise UserError(f"{what} are {known}: choose one by {flag}=ID")
    number = "none of them begins" if not matches else "several of them begin"
    raise UserError(f"{flag}={prefix}: {what} are {known}, and {number} so")


def read_folder_calibration(folder: Path) -> RecordedSensors:
    """Read the calibration that an EuRoC or TUM-VI folder (with cam0) brings along.

    That is `sensor.yaml` of each sensor, or, in TUM-VI's folders, dso/camchain.yaml and
    dso/imu_config.yaml beside mav0.

    Raises:
        MapError: There is none, or it is wrong.
    """
    if (folder / "cam0" / "sensor.yaml").exists():
        return _read_sensor_files(folder)
    camchain = folder.parent / "dso" / "camchain.yaml"
    if not camchain.exists():
        raise MapError(f"{folder}: there is no calibration (cam0/sensor.yaml): {HOW_TO_CALIBRATE}")
    imu_file = camchain.with_name("imu_config.yaml")
    return read_kalibr(camchain, imu_file if imu_file.exists() else None)


def _read_sensor_files(folder: Path) -> RecordedSensors:
    """Read cam0/sensor.yaml, cam1/sensor.yaml, ... and imu0/sensor.yaml; T_BS is a pose on B."""
    cameras: list[Camera] = []
    poses: list[F64] = []
    while (folder / f"cam{len(cameras)}").is_dir():
        path = folder / f"cam{len(cameras)}" / "sensor.yaml"
        entry = read_entry(path)
        camera = read_camera(entry, "distortion_coefficients")
        cameras.append(dataclasses.replace(camera, description=entry.text("comment")))
        poses.append(entry.pose("T_BS"))
    T_B_C = np.stack(poses)
    if not (folder / "imu0").is_dir():
        return make_device(cameras, T_B_C, None)
    if not (folder / "imu0" / "sensor.yaml").exists():
        raise MapError(
            f"{folder}: there is no calibration of the IMU (imu0/sensor.yaml): {HOW_TO_CALIBRATE}"
        )
    entry = read_entry(folder / "imu0" / "sensor.yaml")
    imu = dataclasses.replace(read_imu_noise(entry), description=entry.text("comment"))
    return make_device(cameras, se3.relative(entry.pose("T_BS"), T_B_C), imu)
