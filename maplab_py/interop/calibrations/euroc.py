"""EuRoC's sensor.yaml and its relatives: folders of EuRoC and TUM-VI, Kimera's parameters.

`T_BS` is the pose of a sensor on the body B of all sensors of a folder.
"""

import dataclasses
from pathlib import Path

import numpy as np

from maplab_py.errors import MapError
from maplab_py.interop.calibrations import kalibr, models
from maplab_py.interop.calibrations.parts import Parts, note_unknown_keys, read_entry, with_imu
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
    camera = models.read_camera(entry, key, description=entry.text("comment"))
    T_B_C = entry.pose("T_BS")[None]
    form = "Kimera" if "camera_id" in entry else "EuRoC"
    notes = models.note_line_delays(entry, [camera])
    notes += note_unknown_keys(entry, _NOT_OF_THE_CALIBRATION, settings=form == "Kimera")
    return Parts(form, [camera], T_B_C, is_on_body=True, notes=notes)


def read_imu_file(entry: Entry) -> Parts:
    """Return the IMU of a sensor.yaml, or of Kimera's parameters of the IMU.

    Raises:
        MapError: A key is missing or wrong.
    """
    imu = models.read_imu(
        entry, models.KALIBR_NOISE, description=entry.text("comment"), topic=entry.text("rostopic")
    )
    T_B_I = entry.pose("T_BS")
    is_kimera = "imu_preintegration_type" in entry or "n_gravity" in entry
    if "n_gravity" in entry:
        gravity = float(np.linalg.norm(entry.vector("n_gravity", 3)))
        imu = dataclasses.replace(imu, gravity_magnitude_mps2=gravity or imu.gravity_magnitude_mps2)
    shift_ns = models.read_time_shift_ns(entry, "imu_time_shift")
    notes = note_unknown_keys(entry, _NOT_OF_THE_CALIBRATION, settings=is_kimera)
    form = "Kimera" if is_kimera else "EuRoC"
    return Parts(form, imu=imu, T_B_I=T_B_I, is_on_body=True, time_shift_ns=shift_ns, notes=notes)


def read_kimera_folder(folder: Path) -> Parts:
    """Return the cameras and the IMU of Kimera's parameters; t_imu = t_camera + imu_time_shift.

    Raises:
        MapError: A file cannot be read, a key is missing or wrong, or a model is not supported.
    """
    files = [folder / name for name in _KIMERA_CAMERAS if (folder / name).is_file()]
    cameras = _joined([read_camera_file(read_entry(path)) for path in files])
    path = folder / _KIMERA_IMU
    joined = with_imu(cameras, read_imu_file(read_entry(path))) if path.is_file() else cameras
    return dataclasses.replace(joined, format="Kimera")


def _joined(cameras: list[Parts]) -> Parts:
    every = [camera for part in cameras for camera in part.cameras]
    notes = [note for part in cameras for note in part.notes]
    T_B_C = np.concatenate([part.T_B_C for part in cameras])
    return Parts("EuRoC", every, T_B_C, is_on_body=True, notes=notes)


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
        raise MapError(
            f"{folder}: there is no calibration (cam0/sensor.yaml): {HOW_TO_CALIBRATE}{_beside(folder)}"
        )
    cameras = kalibr.read_camera_chain(read_entry(chain))
    imu_file = chain.with_name("imu_config.yaml")
    if not imu_file.exists():
        return cameras
    if cameras.why_not_on_imu:
        raise MapError(cameras.why_not_on_imu)
    return with_imu(cameras, kalibr.read_kalibr_imu(read_entry(imu_file)))


def _beside(folder: Path) -> str:
    """Name the YAML files in a recording's folder and beside it, one of which may be the calibration."""
    files = [path for place in (folder, folder.parent) for path in sorted(place.glob("*.y*ml"))]
    return f"; perhaps one of {', '.join(map(str, files[:4]))}" if files else ""


def _read_sensor_files(folder: Path) -> Parts:
    """Read cam0/sensor.yaml, cam1/sensor.yaml, ... and imu0/sensor.yaml."""
    cameras: list[Parts] = []
    while (folder / f"cam{len(cameras)}").is_dir():
        path = folder / f"cam{len(cameras)}" / "sensor.yaml"
        cameras.append(read_camera_file(read_entry(path)))
    if not (folder / "imu0").is_dir():
        return _joined(cameras)
    if not (folder / "imu0" / "sensor.yaml").exists():
        raise MapError(
            f"{folder}: there is no calibration of the IMU (imu0/sensor.yaml): {HOW_TO_CALIBRATE}"
        )
    return with_imu(_joined(cameras), read_imu_file(read_entry(folder / "imu0" / "sensor.yaml")))
