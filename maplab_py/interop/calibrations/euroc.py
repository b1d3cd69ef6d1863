"""EuRoC's sensor.yaml and its relatives: folders of EuRoC and TUM-VI, Kimera's parameters.

`T_BS` is the pose of a sensor on the body B of all sensors of a folder.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from maplab_py.errors import MapError
from maplab_py.interop.calibrations.kalibr import read_camera_chain, read_kalibr_imu
from maplab_py.interop.calibrations.models import (
    note_line_delays,
    read_camera,
    read_imu_noise,
    read_time_shift_ns,
)
from maplab_py.interop.calibrations.parts import Parts, note_unknown_keys, read_entry
from maplab_py.sensors.yaml_entry import Entry

HOW_TO_CALIBRATE = "give --sensor_calibration_file=FILE (docs/recordings.md lists the formats)"
_NOT_OF_THE_CALIBRATION = ("sensor_type", "rate_hz", "camera_id", "type", "comment")
_KIMERA_CAMERAS = ("LeftCameraParams.yaml", "RightCameraParams.yaml")
_KIMERA_IMU = "ImuParams.yaml"


def is_kimera_folder(path: Path) -> bool:
    """Return whether a folder has Kimera's parameters of a camera."""
    return (path / _KIMERA_CAMERAS[0]).is_file()


def read_camera_file(entry: Entry) -> Parts:
    """Return the camera of a sensor.yaml, or of Kimera's parameters of a camera.

    Raises:
        MapError: A key is missing or wrong, or a model is not supported.
    """
    key = "distortion_coefficients"
    if key not in entry and "distortion_coeffs" in entry:
        key = "distortion_coeffs"
    camera = read_camera(entry, key, description=entry.text("comment"))
    T_B_C = entry.pose("T_BS")[None]
    form = "Kimera" if "camera_id" in entry else "EuRoC"
    notes = note_line_delays(entry, [camera])
    notes += note_unknown_keys(entry, _NOT_OF_THE_CALIBRATION, settings=form == "Kimera")
    return Parts(form, [camera], T_B_C, notes=notes)


def read_imu_file(entry: Entry) -> Parts:
    """Return the IMU of a sensor.yaml, or of Kimera's parameters of the IMU.

    Raises:
        MapError: A key is missing or wrong.
    """
    imu = read_imu_noise(entry, description=entry.text("comment"), topic=entry.text("rostopic"))
    T_B_I = entry.pose("T_BS")
    is_kimera = "imu_preintegration_type" in entry or "n_gravity" in entry
    if "n_gravity" in entry:
        gravity = float(np.linalg.norm(entry.vector("n_gravity", 3)))
        imu = dataclasses.replace(imu, gravity_magnitude_mps2=gravity or imu.gravity_magnitude_mps2)
    notes = note_unknown_keys(entry, _NOT_OF_THE_CALIBRATION, settings=is_kimera)
    return Parts("Kimera" if is_kimera else "EuRoC", imu=imu, T_B_I=T_B_I, notes=notes)


def read_kimera_folder(folder: Path) -> Parts:
    """Return the cameras and the IMU of Kimera's parameters; t_imu = t_camera + imu_time_shift.

    Raises:
        MapError: A file cannot be read, a key is missing or wrong, or a model is not supported.
    """
    files = [folder / name for name in _KIMERA_CAMERAS if (folder / name).is_file()]
    parts = [read_camera_file(read_entry(path)) for path in files]
    imu = None
    if (folder / _KIMERA_IMU).is_file():
        entry = read_entry(folder / _KIMERA_IMU)
        shift_ns = read_time_shift_ns(entry, "imu_time_shift")
        imu = read_imu_file(entry)
        parts = [_shifted(part, shift_ns) for part in parts]
    return dataclasses.replace(_joined(parts, imu), format="Kimera")


def _shifted(part: Parts, shift_ns: int) -> Parts:
    cameras = [
        dataclasses.replace(camera, time_offset_ns=camera.time_offset_ns + shift_ns)
        for camera in part.cameras
    ]
    return dataclasses.replace(part, cameras=cameras)


def _joined(cameras: list[Parts], imu: Parts | None) -> Parts:
    every = [camera for part in cameras for camera in part.cameras]
    T_B_C = np.concatenate([part.T_B_C for part in cameras])
    notes = [note for part in [*cameras, *([imu] if imu else [])] for note in part.notes]
    joined = Parts("EuRoC", every, T_B_C, notes=notes)
    return joined if imu is None else dataclasses.replace(joined, imu=imu.imu, T_B_I=imu.T_B_I)


def read_folder(folder: Path) -> Parts:
    """Read the calibration that an EuRoC or TUM-VI folder (with cam0) brings along.

    That is `sensor.yaml` of each sensor, or, in TUM-VI's folders, dso/camchain.yaml and
    dso/imu_config.yaml beside mav0.

    Raises:
        MapError: There is none, or it is wrong.
    """
    if (folder / "cam0" / "sensor.yaml").exists():
        return _read_sensor_files(folder)
    chain = folder.parent / "dso" / "camchain.yaml"
    if not chain.exists():
        raise MapError(f"{folder}: there is no calibration (cam0/sensor.yaml): {HOW_TO_CALIBRATE}")
    cameras = read_camera_chain(read_entry(chain))
    imu_file = chain.with_name("imu_config.yaml")
    if not imu_file.exists():
        return cameras
    if cameras.why_not_on_imu:
        raise MapError(cameras.why_not_on_imu)
    imu = read_kalibr_imu(read_entry(imu_file))
    notes = [*cameras.notes, *imu.notes]
    return dataclasses.replace(cameras, imu=imu.imu, T_B_I=imu.T_B_I, notes=notes)


def _read_sensor_files(folder: Path) -> Parts:
    """Read cam0/sensor.yaml, cam1/sensor.yaml, ... and imu0/sensor.yaml."""
    cameras: list[Parts] = []
    while (folder / f"cam{len(cameras)}").is_dir():
        path = folder / f"cam{len(cameras)}" / "sensor.yaml"
        cameras.append(read_camera_file(read_entry(path)))
    if not (folder / "imu0").is_dir():
        return _joined(cameras, None)
    if not (folder / "imu0" / "sensor.yaml").exists():
        raise MapError(
            f"{folder}: there is no calibration of the IMU (imu0/sensor.yaml): {HOW_TO_CALIBRATE}"
        )
    return _joined(cameras, read_imu_file(read_entry(folder / "imu0" / "sensor.yaml")))
