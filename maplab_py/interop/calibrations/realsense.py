"""RealSense's calibrations as JSON: the dump of a T265, the IMU of a D435i, intrinsics of librealsense.

`extrinsics` take points of a sensor to the body. What an IMU measures is multiplied by `scale_and_alignment`;
biases are subtracted afterwards.
"""

import numpy as np

from maplab_py.array_types import F64
from maplab_py.errors import MapError
from maplab_py.geometry import se3, so3
from maplab_py.interop.calibrations.kalibr import with_measurement_matrices
from maplab_py.interop.calibrations.models import make_camera
from maplab_py.interop.calibrations.parts import Parts, note_unknown_keys
from maplab_py.sensors import Camera, Imu
from maplab_py.sensors.yaml_entry import Entry

_STREAM = ("fx", "fy", "ppx", "ppy")
_DISTORTIONS = {
    "none": "none",
    "undistorted": "none",
    "brown_conrady": "radtan",
    "modified_brown_conrady": "inverse",
    "inverse_brown_conrady": "inverse",
    "kannala_brandt4": "equidistant",
    "kannalabrandt4": "equidistant",
    "kannala_brandt": "equidistant",
    "fov": "fov",
    "f_theta": "fov",
    "ftheta": "fov",
}
_NOT_OF_THE_CALIBRATION = (
    *("calibration_version", "device_id", "device_type", "depths", "name", "id", "velocimeters"),
    *("T_variance", "W_variance", "bias", "bias_variance", "decimate_by"),
)


def is_realsense(entry: Entry) -> bool:
    """Tell whether a file is a calibration of RealSense."""
    return "imus" in entry or _is_dumped(entry) or bool(_streams(entry))


def _is_dumped(entry: Entry) -> bool:
    cameras = entry.raw("cameras") if "cameras" in entry else None
    first = cameras[0] if isinstance(cameras, list) and cameras else None
    return isinstance(first, dict) and "focal_length_px" in first


def read_realsense(entry: Entry) -> Parts:
    """Return cameras and IMU.

    Raises:
        MapError: A key is missing or wrong, or a model is not supported.
    """
    if "imus" in entry or _is_dumped(entry):
        return _read_dump(entry)
    streams = _streams(entry)
    if len(streams) > 1:
        raise MapError(
            f"{entry.where}: has the streams {', '.join(streams)} without poses: keep the one of the images"
        )
    ((name, stream),) = streams.items()
    values = [stream.number(key) for key in _STREAM]
    size = (stream.integer("width"), stream.integer("height"))
    camera = _camera(stream, stream.text("model", default="none"), values, "coeffs", size)
    why = f"{entry.where}: intrinsics of {name or 'a stream'} have no pose on the IMU: calibrate with kalibr"
    return Parts("RealSense", [camera], np.eye(1, 7, 3), why_not_on_imu=why)


def _streams(entry: Entry) -> dict[str, Entry]:
    """Return the intrinsics of streams, of the file itself or of the entries at its top."""
    if all(key in entry for key in _STREAM):
        return {"": entry}
    streams = {}
    for key in entry:
        value = entry.raw(key) if key in entry else None
        if isinstance(value, dict):
            value = value.get("intrinsics", value)
        if isinstance(value, dict) and all(name in value for name in _STREAM):
            streams[str(key)] = Entry(value, f"{entry.where}: {key}")
    return streams


def _read_dump(entry: Entry) -> Parts:
    cameras, poses = [], []
    for part in entry.entries("cameras") if "cameras" in entry else []:
        lens = part.child("distortion")
        values = np.concatenate([part.vector("focal_length_px", 2), part.vector("center_px", 2)])
        key = "w" if "w" in lens and "k" not in lens else "k"
        size = part.vector("size_px", 2)
        cameras.append(_camera(lens, lens.text("type"), values, key, size))
        poses.append(_pose(part))
    imu, T_B_I = None, se3.identity()
    notes: list[str] = []
    if "imus" in entry:
        parts = entry.entries("imus")
        if len(parts) != 1:
            raise MapError(f"{entry.where}: key 'imus': one IMU is supported, not {len(parts)}")
        T_B_i = _pose(parts[0])
        imu, T_I_i = _imu(parts[0], notes)
        T_B_I = se3.compose(T_B_i, se3.inverse(T_I_i))
    notes += note_unknown_keys(entry, _NOT_OF_THE_CALIBRATION)
    T_B_C = np.stack(poses) if poses else np.zeros((0, 7))
    return Parts("RealSense", cameras, T_B_C, imu, T_B_I, notes=notes)


def _camera(
    entry: Entry, model: str, values: list[float] | F64, key: str, size: tuple[float, float] | F64
) -> Camera:
    name = model.lower().removeprefix("distortion.").replace(" ", "_").replace("-", "_")
    distortion = _DISTORTIONS.get(name, name)
    terms = entry.numbers(key) if key in entry else np.zeros(0)
    if not np.any(terms):
        distortion, terms = "none", np.zeros(0)
    if distortion == "inverse":
        raise MapError(
            f"{entry.where}: '{model}' of RealSense undistorts by its polynomial, and no camera model here "
            "does: calibrate with kalibr or OpenCV"
        )
    if distortion in ("equidistant", "fov"):
        wanted = 4 if distortion == "equidistant" else 1
        terms = terms if np.any(terms[wanted:]) else terms[:wanted]
    return make_camera(entry, ("model", "pinhole"), ("model", distortion), values, terms, size)


def _pose(entry: Entry) -> F64:
    """Return T_B_S (7,) of a sensor: translation T, rotation vector W."""
    if "extrinsics" not in entry:
        return se3.identity()
    part = entry.child("extrinsics")
    return se3.make(so3.exp(part.vector("W", 3)), part.vector("T", 3))


def _imu(entry: Entry, notes: list[str]) -> tuple[Imu, F64]:
    """Return the IMU and T_I_i (7,)."""
    matrices: list[F64] = []
    deviations: list[float] = []
    default = Imu(id="")
    for name, density in (
        ("gyroscope", default.gyro_noise_density),
        ("accelerometer", default.acc_noise_density),
    ):
        part = entry.child(name)
        correction = part.matrix("scale_and_alignment", 3, 3)
        if not np.linalg.det(correction) > 0.0:
            raise MapError(f"{part.where}: key 'scale_and_alignment' is no proper matrix")
        matrices.append(np.asarray(np.linalg.inv(correction), dtype=np.float64))
        deviations.append(
            np.sqrt(part.number("noise_variance", density * density, positive=True)).item()
        )
    notes.append(
        f"{entry.where}: random walks of the biases are not in the file, maplab's defaults stand; roots of "
        "'noise_variance', of samples, are taken as densities"
    )
    imu = Imu(id="", gyro_noise_density=deviations[0], acc_noise_density=deviations[1])
    return with_measurement_matrices(imu, *matrices)
