"""Calibrations of all programs: one set of readers behind every flag and command that takes one.

The format follows from the content, not from the name. Time shifts become the cameras' time offset,
t_imu = t_camera + offset.
"""

import dataclasses
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from maplab_py.array_types import F64
from maplab_py.errors import MapError, UserError
from maplab_py.geometry import se3
from maplab_py.interop.calibrations import basalt, euroc, orb_slam, realsense, single_cameras, vins
from maplab_py.interop.calibrations.kalibr import (
    is_camera_chain,
    read_camera_chain,
    read_kalibr_imu,
)
from maplab_py.interop.calibrations.okvis import is_okvis, is_svo, read_okvis, read_svo
from maplab_py.interop.calibrations.parts import (
    Parts,
    is_json,
    read_calibration_text,
    read_entry,
    read_json_entry,
    with_imu,
)
from maplab_py.interop.colmap.reading import is_colmap, read_cameras
from maplab_py.interop.device import DeviceOptions, RecordedSensors, make_device
from maplab_py.sensors import Camera, CameraRig, Extrinsics, Imu, SensorSet, sensor_set
from maplab_py.sensors.sensors_yaml import note_unread_keys, sensors_of
from maplab_py.sensors.yaml_entry import Entry

ANY_DEVICE = DeviceOptions()
KNOWN_FORMATS = (
    "files of kalibr, EuRoC, OpenVINS, Basalt, COLMAP, maplab, VINS, ORB-SLAM, stella_vslam, Kimera, OKVIS, "
    "SVO, DM-VIO, ROS and RealSense are read (docs/other_programs.md)"
)
_OPENVINS = "estimator_config.yaml"
_SAME_POSE = 1e-9
_ODD_ASPECT, _ODD_DISTANCE_M, _LEAST_FOCAL, _ODD_SHIFT_NS = 1.2, 5.0, 0.05, 500_000_000
"""Ratio of focal lengths, distance of a camera, share of the width, and time shift that are noted."""
_LARGEST_NOISE = (("gyroscope", "rad/s/√Hz", 1.0), ("accelerometer", "m/s²/√Hz", 10.0))
_ODD_SCALE = 0.1
"""Scales of IMUs that are further from 1 than this are noted: those on the market are within 0.03."""


@dataclasses.dataclass(frozen=True, eq=False)
class CalibrationFile(RecordedSensors):
    """Content of a calibration file: a camera rig, an IMU, or both."""

    source: Path = Path()
    format: str = ""  # for people: "kalibr", "EuRoC", "OpenVINS", "Basalt", "COLMAP", "maplab", ...


def read_calibration(
    path: Path, imu_file: Path | None = None, chosen: DeviceOptions = ANY_DEVICE
) -> RecordedSensors:
    """Read a calibration with cameras; see `import_calibration`.

    Raises:
        UserError: It is of an IMU alone.
        MapError: A file cannot be read or is wrong.
    """
    result = import_calibration(path, imu_file, chosen)
    if not result.rig_id:
        raise UserError(
            f"{path}: has an IMU and no cameras: give it as --imu_calibration_file, and the file of the "
            "cameras as --sensor_calibration_file"
        )
    return result


def import_calibration(
    path: Path, imu_file: Path | None = None, chosen: DeviceOptions = ANY_DEVICE
) -> CalibrationFile:
    """Read the calibration of another program.

    Args:
        path: File or folder; `docs/other_programs.md` lists the formats.
        imu_file: File of the IMU, where `path` has the cameras alone.
        chosen: Sensors of a sensors.yaml that has several of a kind.

    Raises:
        MapError: A file cannot be read, a key is missing or wrong, or a model is not supported.
        UserError: The format is not known, or an IMU file is given where none belongs.
    """
    cameras = _read(path)
    if imu_file is None:
        if isinstance(cameras, SensorSet):
            return _of_maplab(path, cameras, chosen)
        chosen.check_unused(f"{path} is none")
        return _finished(path, cameras)
    if _takes_no_imu(cameras):
        raise UserError(
            f"--imu_calibration_file={imu_file} belongs to a camera chain of kalibr or to another file of "
            f"cameras without IMU, and {path} is none"
        )
    imu = _read(imu_file)
    if isinstance(cameras, SensorSet) and isinstance(imu, SensorSet):
        return _joined_of_maplab(path, cameras, imu_file, imu, chosen)
    chosen.check_unused(f"{path if isinstance(imu, SensorSet) else imu_file} is none")
    cameras, imu = (
        _parts_of(value, name) if isinstance(value, SensorSet) else value
        for name, value in ((path, cameras), (imu_file, imu))
    )
    return _finished(path, _joined(cameras, imu, imu_file), imu_file)


def _takes_no_imu(cameras: Parts | SensorSet) -> bool:
    """Return whether a file has no cameras, or an IMU of its own."""
    if isinstance(cameras, SensorSet):
        return bool(_ids(cameras, Imu)) or not _ids(cameras, CameraRig)
    return not cameras.cameras or cameras.imu is not None


def _finished(path: Path, parts: Parts, imu_file: Path | None = None) -> CalibrationFile:
    """Return the sensors of a file, or of two, with ids and the notes on them."""
    is_turned = np.max(np.abs(parts.T_B_I - se3.identity())) > _SAME_POSE
    if (
        not parts.cameras
        and is_turned
        and parts.imu is not None
        and parts.imu.intrinsics is not None
    ):
        raise UserError(
            f"{path}: scale and misalignment turn the frame of the IMU, in which cameras are given: "
            "import the camera chain and name this file with --imu_calibration_file"
        )
    T_B_C = parts.T_B_C.reshape(-1, 7)
    T_I_C = T_B_C if parts.imu is None else se3.compose(se3.inverse(parts.T_B_I), T_B_C)
    notes = [*parts.notes, *(_imu_notes(imu_file or path, parts.imu) if parts.imu else [])]
    notes += _camera_notes(path, parts.cameras, T_I_C)
    device = make_device(parts.cameras, T_I_C, parts.imu, notes)
    return _as_file(path, parts.format, device)


def _as_file(path: Path, form: str, device: RecordedSensors) -> CalibrationFile:
    return CalibrationFile(
        device.sensors, device.rig_id, device.imu_id, device.notes, source=path, format=form
    )


def _joined(cameras: Parts, imu: Parts, imu_file: Path) -> Parts:
    """Return the cameras of one file with the IMU of another."""
    if imu.imu is None:
        raise UserError(f"--imu_calibration_file={imu_file}: has no IMU ({imu.format})")
    if imu.cameras:
        raise UserError(
            f"--imu_calibration_file={imu_file}: has cameras, too: give it as the calibration of both"
        )
    if cameras.why_not_on_imu:
        raise MapError(cameras.why_not_on_imu)
    return with_imu(cameras, imu)


def _camera_notes(path: Path, cameras: Sequence[Camera], T_I_C: F64) -> list[str]:
    """Return notes on cameras that no device has."""
    notes = []
    for row, (camera, T) in enumerate(zip(cameras, T_I_C, strict=True)):
        fu, fv, cu, cv = camera.intrinsics[-4:]
        if not (0.0 < cu < camera.width_px and 0.0 < cv < camera.height_px):
            notes.append(
                f"{path}: camera {row}: the centre {cu:.6g}, {cv:.6g} is outside the image"
            )
        if fu < _LEAST_FOCAL * camera.width_px:
            notes.append(
                f"{path}: camera {row}: the focal length is {fu:.6g}: is it in pixels of {camera.width_px} x "
                f"{camera.height_px}?"
            )
        elif max(fu / fv, fv / fu) > _ODD_ASPECT:
            notes.append(
                f"{path}: camera {row}: focal lengths {fu:.6g} and {fv:.6g} differ: is the order fu fv cu cv?"
            )
        if abs(camera.time_offset_ns) > _ODD_SHIFT_NS:
            notes.append(
                f"{path}: camera {row}: the time shift is {camera.time_offset_ns * 1e-9:.4g} s: is it in "
                "seconds?"
            )
        distance_m = float(np.linalg.norm(np.clip(T[4:], -1e9, 1e9)))
        if distance_m > _ODD_DISTANCE_M:
            notes.append(
                f"{path}: camera {row} is {distance_m:.4g} m from the body: are the poses in metres?"
            )
    return notes


def _imu_notes(path: Path, imu: Imu) -> list[str]:
    """Return notes on noise and matrices of the IMU that no IMU has."""
    densities = imu.gyro_noise_density, imu.acc_noise_density
    notes = [
        f"{path}: noise of {density:g} {unit} is far above that of any {name}: is it in this unit?"
        for density, (name, unit, largest) in zip(densities, _LARGEST_NOISE, strict=True)
        if density > largest
    ]
    if imu.intrinsics is None:
        return notes
    for name, matrix in (("gyroscope", imu.intrinsics.T_g), ("accelerometer", imu.intrinsics.T_a)):
        scales = np.linalg.svd(matrix, compute_uv=False)
        worst = scales[np.argmax(np.abs(scales - 1.0))]
        if abs(worst - 1.0) > _ODD_SCALE:
            notes.append(
                f"{path}: the matrix of the {name} scales by {worst:.3g}, far from 1: is it of this IMU, "
                "and in the same unit?"
            )
    return notes


# -- maplab -------------------------------------------------------------------------------------


def _of_maplab(path: Path, sensors: SensorSet, chosen: DeviceOptions) -> CalibrationFile:
    notes = note_unread_keys(sensors, str(path))
    if not _ids(sensors, CameraRig) and _ids(sensors, Imu):
        imu_id = _of_kind(sensors, Imu, chosen.imu_sensor_id, f"{path}: IMUs", "imu")
        device = RecordedSensors(sensors, "", imu_id)
    else:
        device = device_of(sensors, str(path), chosen)
    if device.imu_id:
        notes += _imu_notes(path, sensors.imu(device.imu_id))
    if device.rig_id:
        notes += _camera_notes(path, device.cameras, device.T_I_C)
    return _as_file(path, "maplab", dataclasses.replace(device, notes=tuple(notes)))


def _joined_of_maplab(
    path: Path, rigs: SensorSet, imu_file: Path, imus: SensorSet, chosen: DeviceOptions
) -> CalibrationFile:
    """Return the rig of one file with the IMU of another; maplab 1.x has one file of each.

    The body of a rig without IMU is the frame of the IMU.
    """
    rig = rigs.camera_rig(
        _of_kind(rigs, CameraRig, chosen.ncamera_sensor_id, f"{path}: camera rigs", "ncamera")
    )
    imu = imus.imu(_of_kind(imus, Imu, chosen.imu_sensor_id, f"{imu_file}: IMUs", "imu"))
    if imu.id in rigs.sensors:
        raise MapError(f"{imu_file}: id {imu.id} is also that of the cameras in {path}")
    both: dict[str, sensor_set.Sensor] = {imu.id: imu, rig.id: rig}
    T_I_B = {imu.id: se3.identity(), rig.id: rigs.T_B_S(rig.id)}
    mounts = {sensor_id: Extrinsics(imu.id, pose) for sensor_id, pose in T_I_B.items()}
    sensors = SensorSet(both, mounts, {**imus.extra, **rigs.extra})
    notes = note_unread_keys(rigs, str(path)) + note_unread_keys(imus, str(imu_file))
    notes += _imu_notes(imu_file, imu)
    device = RecordedSensors(sensors, rig.id, imu.id, tuple(notes))
    return _as_file(path, "maplab", device)


def _parts_of(sensors: SensorSet, path: Path) -> Parts:
    """Return the cameras or the IMU of one of maplab's files, to be joined with another program's."""
    imus = _ids(sensors, Imu)
    if imus and not _ids(sensors, CameraRig):
        imu = sensors.imu(_of_kind(sensors, Imu, "", f"{path}: IMUs", "imu"))
        return Parts("maplab", imu=imu, notes=note_unread_keys(sensors, str(path)))
    device = device_of(sensors, str(path))
    return Parts(
        "maplab",
        device.cameras,
        device.T_I_C,
        device.imu,
        notes=note_unread_keys(sensors, str(path)),
    )


def device_of(
    sensors: SensorSet, source: str, chosen: DeviceOptions = ANY_DEVICE
) -> RecordedSensors:
    """Return the chosen camera rig of a set of sensors, with the chosen IMU if there is any.

    Raises:
        UserError: There is no rig, a choice fits none or several, or is missing where there are
            several.
    """
    if not _ids(sensors, CameraRig):
        raise UserError(f"{source} has no camera rig: give a calibration with cameras")
    rig = _of_kind(
        sensors, CameraRig, chosen.ncamera_sensor_id, f"{source}: camera rigs", "ncamera"
    )
    has_imu = bool(_ids(sensors, Imu) or chosen.imu_sensor_id)
    imu = _of_kind(sensors, Imu, chosen.imu_sensor_id, f"{source}: IMUs", "imu") if has_imu else ""
    return RecordedSensors(sensors, rig, imu)


def _ids(sensors: SensorSet, kind: type[CameraRig] | type[Imu]) -> list[str]:
    return [key for key, sensor in sensors.sensors.items() if isinstance(sensor, kind)]


def _of_kind(
    sensors: SensorSet, kind: type[CameraRig] | type[Imu], prefix: str, what: str, name: str
) -> str:
    """Return the only id of a kind of sensors that begins with a prefix."""
    ids = _ids(sensors, kind)
    flag = f"--selected_{name}_sensor_id"
    matches = [sensor_id for sensor_id in ids if sensor_id.startswith(prefix.lower())]
    if len(matches) == 1:
        return matches[0]
    known = ", ".join(ids) or "none"
    if not prefix:
        raise UserError(f"{what} are {known}: choose one by {flag}=ID")
    number = "none of them begins" if not matches else "several of them begin"
    raise UserError(f"{flag}={prefix}: {what} are {known}, and {number} so")


# -- formats ------------------------------------------------------------------------------------


def _read(path: Path) -> Parts | SensorSet:
    """Return the content of a file or folder; that of maplab's files as it is.

    Raises:
        UserError: The format is not known.
        MapError: The content is wrong.
    """
    if is_colmap(path):
        cameras, T_B_C = read_cameras(path)
        why = (
            f"{path}: COLMAP does not know where the IMU is: give a calibration of cameras and IMU"
        )
        return Parts("COLMAP", cameras, T_B_C, why_not_on_imu=why)
    if path.is_dir():
        return _read_folder(path)
    if single_cameras.is_dso_camera(path):
        return single_cameras.read_dso_camera(path)
    _refuse_other_texts(path)
    if is_json(path):
        return _read_json(path)
    entry = read_entry(path)
    for key, what in _REFUSED_YAML.items():
        if key in entry:
            raise UserError(f"{path}: {what}")
    if "relative_config_imucam" in entry:
        return _read_openvins(entry, path.parent)
    if is_camera_chain(entry) and "cam0" in entry and "intrinsics" not in entry.child("cam0"):
        return single_cameras.read_dm_vio(entry, path)
    if vins.is_vins(entry):
        return vins.read_vins(entry, path.parent)
    for is_format, read in _FORMATS:
        if is_format(entry):
            return read(entry)
    if "sensors" in entry or "cameras" in entry or "sigmas" in entry or "imu_sigmas" in entry:
        return sensors_of(entry.content, str(path))
    raise UserError(f"{path}: the format is not known: {KNOWN_FORMATS}")


def _refuse_other_texts(path: Path) -> None:
    """Check that a file is none of those that people take for calibrations.

    Raises:
        UserError: It is; names the program.
    """
    text = read_calibration_text(path)
    for pattern, what in _REFUSED_TEXTS:
        if pattern.search(text):
            raise UserError(f"{path}: {what}")


def _read_json(path: Path) -> Parts:
    entry = read_json_entry(path)
    if "value0" in entry or "T_imu_cam" in entry:
        return basalt.read_basalt(entry)
    if realsense.is_realsense(entry):
        return realsense.read_realsense(entry)
    for key, program in _REFUSED_JSON.items():
        if key in entry:
            raise UserError(f"{path}: calibrations of {program} are not read: {KNOWN_FORMATS}")
    raise UserError(f"{path}: the format is not known: {KNOWN_FORMATS}")


def _read_folder(path: Path) -> Parts:
    if (path / _OPENVINS).exists():
        return _read_openvins(read_entry(path / _OPENVINS), path)
    if euroc.is_kimera_folder(path):
        return euroc.read_kimera_folder(path)
    return euroc.read_folder(path / "mav0" if (path / "mav0").is_dir() else path)


def _read_openvins(entry: Entry, folder: Path) -> Parts:
    chain, imu = (
        folder / entry.text(key) for key in ("relative_config_imucam", "relative_config_imu")
    )
    cameras, inertial = read_camera_chain(read_entry(chain)), read_kalibr_imu(read_entry(imu))
    return dataclasses.replace(_joined(cameras, inertial, imu), format="OpenVINS")


def _has_imu_noise(entry: Entry) -> bool:
    return "accelerometer_noise_density" in entry or "gyroscope_noise_density" in entry


_REFUSED_TEXTS = (
    (
        re.compile(r"\A\s*(?:Calibration results|Camera-system parameters|Normalized Residuals)"),
        "is kalibr's report: give the camera chain (yaml) that kalibr writes beside it",
    ),
    (re.compile(r"\A\s*(?:<\?xml|<opencv_storage)"), "is XML of OpenCV: save it as yaml"),
    (re.compile(r"\A\s*(?:#.*\n\s*)*\[image\]"), "is an ini file of ROS: save it as yaml"),
    (
        re.compile(r"^\[(?:LEFT|RIGHT)_CAM_", re.MULTILINE),
        "calibrations of ZED cameras are not read: give kalibr's camera chain, or ROS' CameraInfo",
    ),
    (
        re.compile(r"^P[01]:\s", re.MULTILINE),
        "projections of KITTI are not read: write pinhole cameras as kalibr's camera chain",
    ),
    (
        re.compile(r"^(?:Camera0|Common)\s*\{?\s*$", re.MULTILINE),
        "settings of ROVIO are not read: give the yaml of the camera, or kalibr's camera chain",
    ),
    (
        re.compile(r"^\s*(?:Intrinsic of \"|Device info:)", re.MULTILINE),
        "is the text of rs-enumerate-devices: give the JSON of RealSense's calibration",
    ),
)
_REFUSED_YAML = {
    "target_type": "is a calibration target of kalibr, no calibration: give the camera chain",
    "M1": "has the intrinsics of OpenCV's stereo sample without poses: write kalibr's camera chain",
    "Gyr": "is a report of imu_utils: give its noise under the keys of kalibr's IMU file",
}
_REFUSED_JSON = {
    "CalibrationInformation": "Windows Mixed Reality",
    "CameraCalibrations": "Project Aria",
    "cameraData": "DepthAI (OAK)",
}
_FORMATS: tuple[tuple[Callable[[Entry], bool], Callable[[Entry], Parts]], ...] = (
    (is_camera_chain, read_camera_chain),
    (lambda entry: _has_imu_noise(entry) and "T_BS" in entry, euroc.read_imu_file),
    (lambda entry: _has_imu_noise(entry) or "imu0" in entry, read_kalibr_imu),
    (lambda entry: "T_BS" in entry, euroc.read_camera_file),
    (orb_slam.is_orb_slam, orb_slam.read_orb_slam),
    (is_okvis, read_okvis),
    (is_svo, read_svo),
    (single_cameras.is_camera_info, single_cameras.read_camera_info),
)
"""Signature of a kind of file, and its reader."""
