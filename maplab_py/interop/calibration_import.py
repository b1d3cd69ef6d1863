"""Calibrations of other programs: kalibr, EuRoC, OpenVINS, Basalt, COLMAP. The inverse of the export.

The format follows from the content, not from the name. A time shift of kalibr or Basalt becomes the camera's
time offset, t_imu = t_camera + offset.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from maplab_py.errors import MapError, UserError
from maplab_py.geometry import se3
from maplab_py.interop.basalt import read_basalt
from maplab_py.interop.colmap.calibration import is_colmap, read_calibration
from maplab_py.interop.recordings.calibration import (
    ANY_DEVICE,
    device_of,
    read_folder_calibration,
)
from maplab_py.interop.recordings.kalibr import is_camera_chain, read_kalibr, read_kalibr_imu
from maplab_py.interop.recordings.models import make_device, read_camera, read_entry, read_imu_noise
from maplab_py.interop.recordings.options import DeviceOptions
from maplab_py.interop.recordings.protocol import RecordedSensors
from maplab_py.sensors import Extrinsics, Imu, SensorSet
from maplab_py.sensors.sensors_yaml import read_sensors
from maplab_py.sensors.yaml_entry import Entry

_MAX_TIME_OFFSET_NS = 10_000_000_000
_OPENVINS = "estimator_config.yaml"
_SAME_POSE = 1e-9


@dataclasses.dataclass(frozen=True, eq=False)
class CalibrationFile:
    """What a calibration file has: a camera rig, an IMU, or both."""

    source: Path
    format: str  # for people: "kalibr", "EuRoC", "OpenVINS", "Basalt", "COLMAP", "maplab"
    sensors: SensorSet
    rig_id: str = ""  # empty = none
    imu_id: str = ""


def import_calibration(
    path: Path, imu_file: Path | None = None, chosen: DeviceOptions = ANY_DEVICE
) -> CalibrationFile:
    """Read the calibration of another program.

    Args:
        path: kalibr's or OpenVINS' camera chain or IMU file, OpenVINS' estimator_config.yaml or the
            folder with it, a sensor.yaml of EuRoC or its folder, Basalt's json, the folder of a COLMAP
            model or its cameras.txt or cameras.bin, or sensors.yaml.
        imu_file: IMU file that belongs to a camera chain, or imu0/sensor.yaml to that of a camera.
        chosen: Sensors of a sensors.yaml that has several of a kind.

    Raises:
        MapError: A file cannot be read, a key is missing or wrong, or a model is not supported.
        UserError: The format is not known, or an IMU file is given where none belongs.
    """
    if path.is_dir() and (path / _OPENVINS).exists():
        path = path / _OPENVINS
    result = _import_any(path, imu_file, chosen)
    if result.format != "maplab":
        chosen.check_unused(f"{path} is none")
    for camera in result.sensors.camera_rig(result.rig_id).cameras if result.rig_id else ():
        if abs(camera.time_offset_ns) > _MAX_TIME_OFFSET_NS:
            raise MapError(
                f"{path}: the time shift between camera and IMU is {camera.time_offset_ns * 1e-9:g} s: "
                "it must be below 10 s (kalibr writes seconds, Basalt nanoseconds)"
            )
    return result


def _import_any(path: Path, imu_file: Path | None, chosen: DeviceOptions) -> CalibrationFile:
    if is_colmap(path):
        _refuse_imu_file(path, imu_file)
        return _file(path, "COLMAP", read_calibration(path))
    if path.is_dir():
        _refuse_imu_file(path, imu_file)
        folder = path / "mav0" if (path / "mav0").is_dir() else path
        return _file(path, "EuRoC", read_folder_calibration(folder))
    if path.suffix.lower() == ".json":
        _refuse_imu_file(path, imu_file)
        return _file(path, "Basalt", read_basalt(path))
    entry = read_entry(path)
    if "relative_config_imucam" in entry:
        _refuse_imu_file(path, imu_file)
        chain, imu = (
            path.parent / entry.text(key)
            for key in ("relative_config_imucam", "relative_config_imu")
        )
        return _file(path, "OpenVINS", read_kalibr(chain, imu))
    if is_camera_chain(entry):
        return _file(path, "kalibr", read_kalibr(path, imu_file))
    if (
        "imu0" in entry
        or "accelerometer_noise_density" in entry
        or "gyroscope_noise_density" in entry
    ):
        _refuse_imu_file(path, imu_file)
        is_euroc = "T_BS" in entry
        sensor = read_imu_noise(entry) if is_euroc else _kalibr_imu_alone(path)
        return _imu_alone(path, "EuRoC" if is_euroc else "kalibr", sensor)
    if "T_BS" in entry:
        return _file(path, "EuRoC", _euroc_camera(entry, imu_file))
    if "sensors" in entry:
        _refuse_imu_file(path, imu_file)
        return _file(path, "maplab", device_of(read_sensors(path), str(path), chosen))
    raise UserError(
        f"{path}: the format is not known: give a camera chain or IMU file of kalibr, a sensor.yaml of "
        "EuRoC, OpenVINS' estimator_config.yaml, Basalt's calibration.json, a COLMAP model or its "
        "cameras.txt, or sensors.yaml"
    )


def _refuse_imu_file(path: Path, imu_file: Path | None) -> None:
    if imu_file is not None:
        raise UserError(
            f"--imu_calibration_file={imu_file} belongs to a camera chain or to the sensor.yaml of a "
            f"camera, and {path} is none"
        )


def _file(path: Path, form: str, device: RecordedSensors) -> CalibrationFile:
    return CalibrationFile(path, form, device.sensors, device.rig_id, device.imu_id)


def _kalibr_imu_alone(path: Path) -> Imu:
    imu, T_I_i = read_kalibr_imu(path)
    if np.max(np.abs(T_I_i - se3.identity())) > _SAME_POSE:
        raise UserError(
            f"{path}: scale and misalignment turn the frame of the IMU, in which cameras are given: "
            "import the camera chain and name this file with --imu_calibration_file"
        )
    return imu


def _imu_alone(path: Path, form: str, imu: Imu) -> CalibrationFile:
    """Return an IMU without cameras; the id is that of the same IMU beside cameras."""
    named = make_device([], np.zeros((0, 7)), imu)
    imu_id = named.imu_id
    mounts = {imu_id: Extrinsics(imu_id, se3.identity())}
    sensors = SensorSet({imu_id: named.sensors.imu(imu_id)}, mounts)
    return CalibrationFile(path, form, sensors, imu_id=imu_id)


def _euroc_camera(entry: Entry, imu_file: Path | None) -> RecordedSensors:
    """Return one camera of an EuRoC folder, with the IMU of another file if there is one."""
    camera = read_camera(entry, "distortion_coefficients")
    T_B_C = entry.pose("T_BS")[None]
    if imu_file is None:
        return make_device([camera], T_B_C, None)
    imu = read_entry(imu_file)
    return make_device([camera], se3.relative(imu.pose("T_BS"), T_B_C), read_imu_noise(imu))
