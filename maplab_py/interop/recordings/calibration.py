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
from maplab_py.interop.recordings.protocol import RecordedSensors
from maplab_py.sensors import Camera, CameraRig, Imu, SensorSet
from maplab_py.sensors.sensors_yaml import read_sensors

HOW_TO_CALIBRATE = "give --sensor_calibration_file=FILE (sensors.yaml, or kalibr's camchain)"


def read_calibration(path: Path, imu_file: Path | None = None) -> RecordedSensors:
    """Read a sensors.yaml, or kalibr's camera chain with its IMU file.

    Raises:
        MapError: A file cannot be read or is wrong.
        UserError: There is an IMU file for a sensors.yaml, or not exactly one rig and one IMU.
    """
    if is_camera_chain(read_entry(path)):
        return read_kalibr(path, imu_file)
    if imu_file is not None:
        raise UserError(
            f"--imu_calibration_file={imu_file} belongs to a camera chain of kalibr, and {path} is none"
        )
    return device_of(read_sensors(path), str(path))


def device_of(sensors: SensorSet, source: str) -> RecordedSensors:
    """Return the only camera rig of a set of sensors, with the only IMU if there is one.

    Raises:
        UserError: There is another number of them.
    """
    rigs = [key for key, sensor in sensors.sensors.items() if isinstance(sensor, CameraRig)]
    imus = [key for key, sensor in sensors.sensors.items() if isinstance(sensor, Imu)]
    if len(rigs) != 1 or len(imus) > 1:
        raise UserError(
            f"{source} has {len(rigs)} camera rigs and {len(imus)} IMUs: leave one of each in it"
        )
    return RecordedSensors(sensors, rigs[0], imus[0] if imus else "")


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
    entry = read_entry(folder / "imu0" / "sensor.yaml")
    imu = dataclasses.replace(read_imu_noise(entry), description=entry.text("comment"))
    return make_device(cameras, se3.relative(entry.pose("T_BS"), T_B_C), imu)
