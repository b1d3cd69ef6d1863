"""sensors.yaml: reader (2.x, and the 1.x files ncamera.yaml and imu.yaml) and writer (2.x).

Keys that are not understood are kept at every level and written back. A mounting matrix is
written back exactly as it was read while the pose it stands for is unchanged.
"""

import dataclasses
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.array_types import F64
from maplab_py.errors import MapError
from maplab_py.geometry import se3
from maplab_py.input_files import DEFAULT_MAX_BYTES, read_text
from maplab_py.sensors import camera as camera_models
from maplab_py.sensors.imu import Imu, ImuIntrinsics
from maplab_py.sensors.sensor_set import Extrinsics, OtherSensor, Sensor, SensorSet
from maplab_py.sensors.yaml_entry import Entry, similar_key
from maplab_py.sensors.yaml_text import dump_yaml, parse_yaml

_NOISE_KEYS = (
    "acc_noise_density",
    "acc_bias_random_walk_noise_density",
    "gyro_noise_density",
    "gyro_bias_random_walk_noise_density",
)
_IMU_KEYS = ("saturation_accel_max_mps2", "saturation_gyro_max_radps", "gravity_magnitude_mps2")
_LIDAR_CAMERA = "camera-3d-lidar"
_LINE_DELAY = "line-delay-nanoseconds"
_MAX_READOUT_NS = 1_000_000_000
_SAME_POSE = 1e-9
_KEYS = (
    *_NOISE_KEYS,
    *_IMU_KEYS,
    *(
        "id",
        "sensor_type",
        "topic",
        "description",
        "sigmas",
        "imu_intrinsics",
        "T_g",
        "T_a",
        "R_AI",
    ),
    *("cameras", "camera", "T_B_C", "T_C_B", "time_offset_ns", "image_delay_s", _LINE_DELAY),
    *("image_height", "image_width", "type", "intrinsics", "distortion", "parameters"),
    *("sensor_id", "base_sensor_id", "T_B_S", "T_S_B", "sensors", "extrinsics"),
)
_KEPT_KEYS = (
    *("T_G_B_fixed_covariance", "T_B_C", "T_C_B", "T_B_S", "T_S_B", _LINE_DELAY, "compressed"),
    *("hardware_id", "label", "T_St_Stp1_fixed_covariance", "sensor_type", "id", "uuid"),
)
"""Keys of maplab that have no meaning here, and poses in the form in which they were read."""


def read_sensors(path: Path, max_bytes: int = DEFAULT_MAX_BYTES) -> SensorSet:
    """Read a sensors.yaml of a map, or a 1.x ncamera.yaml or imu.yaml.

    Raises:
        MapError: The file cannot be read or its content is wrong; names sensor and key.
    """
    try:
        text = read_text(path, max_bytes, error=MapError)
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        raise MapError(f"cannot read {path}: {reason}") from error
    return parse_sensors(text, str(path), max_bytes)


def parse_sensors(text: str, source: str, max_bytes: int = DEFAULT_MAX_BYTES) -> SensorSet:
    """Read the text of a sensors.yaml; `source` is its name in error messages.

    Raises:
        MapError: One line that names the source, the sensor and the key.
    """
    value = parse_yaml(text, source, max_bytes)
    return SensorSet() if value is None else sensors_of(value, source)


def sensors_of(content: Any, source: str) -> SensorSet:
    """Return the sensors of the parsed content of a sensors.yaml; see `parse_sensors`."""
    top = Entry(content, source)
    if "sensors" not in top and ("cameras" in top or "sigmas" in top or "imu_sigmas" in top):
        kind = "NCAMERA" if "cameras" in top else "IMU"
        sensor = _parse_sensor({"sensor_type": kind, **content}, source)
        return SensorSet({sensor.id: sensor})
    sensors: dict[str, Sensor] = {}
    taken: set[str] = set()
    for item in top.items("sensors"):
        sensor = _parse_sensor(item, source)
        ids = [sensor.id]
        if isinstance(sensor, camera_models.CameraRig):
            ids += [camera.id for camera in sensor.cameras]
        for sensor_id in ids:
            if sensor_id in taken:
                raise MapError(f"{source}: key 'id': {sensor_id} is given to two sensors")
            taken.add(sensor_id)
        sensors[sensor.id] = sensor
    extrinsics: dict[str, Extrinsics] = {}
    for item in top.items("extrinsics") if "extrinsics" in top else []:
        sensor_id, mount = _parse_extrinsics(item, source, sensors)
        if sensor_id in extrinsics:
            raise MapError(f"{source}: sensor {sensor_id} has two entries in 'extrinsics'")
        extrinsics[sensor_id] = mount
    rest = top.rest()
    rest.pop("extrinsics", None)
    return SensorSet(sensors, extrinsics, rest)


def note_unread_keys(sensor_set: SensorSet, source: str) -> list[str]:
    """Return one note that names the keys which are kept but not understood, none if there are none."""
    extras: list[Mapping[str, Any]] = [sensor_set.extra]
    for sensor in sensor_set.sensors.values():
        if isinstance(sensor, camera_models.CameraRig):
            extras += [sensor.extra, *sensor.camera_extra]
            extras += [camera.extra for camera in sensor.cameras]
        elif isinstance(sensor, Imu):
            extras.append(sensor.extra)
    extras += [mount.extra for mount in sensor_set.extrinsics.values()]
    names = sorted({key for extra in extras for key in _leaf_keys(extra)} - set(_KEPT_KEYS))
    words = [f"{name} ({hint}?)" if (hint := similar_key(name, _KEYS)) else name for name in names]
    return [f"{source}: keys that are not understood: {', '.join(words[:12])}"] if words else []


def _leaf_keys(extra: Mapping[str, Any]) -> Iterator[str]:
    for key, value in extra.items():
        if isinstance(value, Mapping) and "data" not in value:
            yield from _leaf_keys(value)
        else:
            yield str(key)


def write_sensors(sensor_set: SensorSet) -> str:
    """Return the text of a 2.x sensors.yaml."""
    value: dict[str, Any] = {
        "sensors": [sensor_entry(sensor) for sensor in sensor_set.sensors.values()],
        "extrinsics": [
            {
                "sensor_id": sensor_id,
                "base_sensor_id": mount.base_sensor_id,
                **_mount_entry(mount.T_B_S, mount.extra, "T_B_S", "T_S_B"),
            }
            for sensor_id, mount in sensor_set.extrinsics.items()
        ],
    }
    return dump_yaml(_merged(value, sensor_set.extra))


def sensor_entry(sensor: Sensor) -> dict[str, Any]:
    """Return the entry of one sensor as plain YAML values."""
    if isinstance(sensor, camera_models.CameraRig):
        return _rig_entry(sensor)
    if isinstance(sensor, Imu):
        return _imu_entry(sensor)
    return _merged({"id": sensor.id, "sensor_type": sensor.sensor_type}, sensor.keys)


# -- reading ------------------------------------------------------------------------------------


def _parse_sensor(value: Any, source: str) -> Sensor:
    entry = Entry(value, source)
    sensor_id = entry.identifier()
    entry.where = f"{source}: sensor {sensor_id}"
    kind = entry.text("sensor_type")
    if not kind:
        raise MapError(f"{entry.where}: key 'sensor_type' is missing")
    if kind == "IMU":
        return _parse_imu(entry, sensor_id)
    if kind == "NCAMERA" and not _has_lidar_camera(entry):
        return _parse_rig(entry, sensor_id, source)
    return OtherSensor(sensor_id, kind, dict(value))


def _has_lidar_camera(entry: Entry) -> bool:
    """Tell whether the rig holds a lidar, which has no image: the entry of such a rig is kept unchanged."""
    cameras = [Entry(item, entry.where) for item in entry.items("cameras")]
    return any(camera.child("camera").text("type") == _LIDAR_CAMERA for camera in cameras)


def _parse_imu(entry: Entry, sensor_id: str) -> Imu:
    default = Imu(id=sensor_id)
    numbers: dict[str, float] = {}
    key = "imu_sigmas" if "imu_sigmas" in entry and "sigmas" not in entry else "sigmas"
    if key in entry:
        sigmas = entry.child(key)
        for name in _NOISE_KEYS:
            numbers[name] = sigmas.number(name, getattr(default, name), positive=True)
    for name in _IMU_KEYS:
        numbers[name] = entry.number(name, getattr(default, name), positive=True)
    intrinsics = None
    if "imu_intrinsics" in entry:
        child = entry.child("imu_intrinsics")
        intrinsics = ImuIntrinsics(
            T_g=_upper_triangular(child, "T_g"),
            T_a=_upper_triangular(child, "T_a"),
            R_A_I=child.rotation("R_AI"),
        )
    return dataclasses.replace(
        default,
        **numbers,  # type: ignore[arg-type]
        intrinsics=intrinsics,
        topic=entry.text("topic", "hardware_id"),
        description=entry.text("description", "label"),
        extra=entry.rest(),
    )


def _upper_triangular(entry: Entry, key: str) -> F64:
    T = entry.matrix(key, 3, 3)
    if np.any(np.tril(T, -1) != 0.0) or np.any(np.diag(T) <= 0.0):
        raise MapError(
            f"{entry.where}: key '{key}' must be upper triangular with a positive diagonal"
        )
    return T


def _parse_rig(entry: Entry, sensor_id: str, source: str) -> camera_models.CameraRig:
    cameras, poses, extras = [], [], []
    for item in entry.items("cameras"):
        mounted = Entry(item, entry.where)
        inner = mounted.child("camera")
        camera_id = inner.identifier()
        where = f"{source}: camera {camera_id}"
        mounted.where, inner.where = where, where
        pose = _parse_mount(mounted, "T_B_C", "T_C_B")
        poses.append(pose[0])
        offset = mounted.integer("time_offset_ns", 0)
        delay = mounted.number("image_delay_s", 0.0)
        camera = _parse_camera(inner, camera_id)
        cameras.append(dataclasses.replace(camera, time_offset_ns=offset, image_delay_s=delay))
        rest = mounted.rest()
        rest.pop("camera", None)
        extras.append({**rest, **pose[1]})
    if not cameras:
        raise MapError(f"{entry.where}: key 'cameras' is empty")
    return camera_models.CameraRig(
        id=sensor_id,
        cameras=tuple(cameras),
        T_B_C=np.array(poses),
        topic=entry.text("topic", "hardware_id"),
        description=entry.text("description", "label"),
        extra=entry.rest(),
        camera_extra=tuple(extras),
    )


def _parse_camera(entry: Entry, camera_id: str) -> camera_models.Camera:
    entry.text("sensor_type")
    projection = _model(entry, "type", camera_models.Projection)
    lens = entry.child("distortion")
    lens.where = f"{entry.where}: distortion"
    distortion = _model(lens, "type", camera_models.Distortion)
    size = camera_models.DISTORTION_SIZE[distortion]
    parameters = np.zeros(0)
    if size > 0 or "parameters" in lens:
        parameters = lens.vector("parameters", size)
    intrinsics = entry.vector("intrinsics", camera_models.INTRINSICS_SIZE[projection])
    if np.any(intrinsics[-4:-2] <= 0.0):
        raise MapError(f"{entry.where}: key 'intrinsics': focal lengths must be positive")
    width, height = entry.integer("image_width"), entry.integer("image_height")
    if min(width, height) <= 0:
        raise MapError(f"{entry.where}: keys 'image_width', 'image_height' must be positive")
    topic, description = entry.text("topic", "hardware_id"), entry.text("description", "label")
    extra = entry.rest()
    line_delay_ns = _line_delay_ns(entry, height)
    if line_delay_ns != 0:
        extra.pop(_LINE_DELAY)
    return camera_models.Camera(
        id=camera_id,
        projection=projection,
        distortion=distortion,
        intrinsics=intrinsics,
        distortion_parameters=parameters,
        width_px=width,
        height_px=height,
        topic=topic,
        description=description,
        line_delay_ns=line_delay_ns,
        extra=extra,
    )


def _line_delay_ns(entry: Entry, height_px: int) -> int:
    """Return the time between two rows; an entry of zero is one of the keys that are kept."""
    delay_ns = entry.integer(_LINE_DELAY, 0)
    if abs(delay_ns) * height_px > _MAX_READOUT_NS:
        raise MapError(
            f"{entry.where}: key '{_LINE_DELAY}': {delay_ns} ns between rows are "
            f"{1e-9 * abs(delay_ns) * height_px:g} s for an image of {height_px}: give the time between two "
            "rows, in nanoseconds"
        )
    return delay_ns


def _model(entry: Entry, key: str, kinds: Any) -> Any:
    name = str(entry.raw(key))
    known = [kind.value for kind in kinds]
    if name not in known:
        raise MapError(f"{entry.where}: key '{key}': '{name}' is not one of {', '.join(known)}")
    return kinds(name)


def _parse_extrinsics(
    value: Any, source: str, sensors: Mapping[str, Sensor]
) -> tuple[str, Extrinsics]:
    entry = Entry(value, f"{source}: extrinsics")
    sensor_id = entry.identifier("sensor_id")
    entry.where = f"{source}: extrinsics of sensor {sensor_id}"
    base_id = entry.identifier("base_sensor_id")
    for key, wanted in (("sensor_id", sensor_id), ("base_sensor_id", base_id)):
        if wanted not in sensors:
            raise MapError(f"{entry.where}: key '{key}': there is no sensor {wanted}")
    T_B_S, raw = _parse_mount(entry, "T_B_S", "T_S_B")
    if sensor_id == base_id and np.max(np.abs(T_B_S - se3.identity())) > _SAME_POSE:
        raise MapError(f"{entry.where}: it is its own base, but its pose is not the identity")
    return sensor_id, Extrinsics(base_id, T_B_S, {**entry.rest(), **raw})


def _parse_mount(entry: Entry, forward: str, backward: str) -> tuple[F64, dict[str, Any]]:
    """Return the pose T_B_S (7,) given as T_B_S or T_S_B, and the raw key that gave it."""
    if forward in entry and backward in entry:
        raise MapError(f"{entry.where}: keys '{forward}' and '{backward}' cannot be combined")
    key = backward if backward in entry else forward
    pose = entry.pose(key)
    return (pose if key == forward else se3.inverse(pose)), {key: entry.raw(key)}


# -- writing ------------------------------------------------------------------------------------


def _merged(known: dict[str, Any], extra: Mapping[str, Any]) -> dict[str, Any]:
    """Return the known keys and those of `extra` that are not known, level by level."""
    result = dict(known)
    for key, value in extra.items():
        if key not in result:
            result[key] = value
        elif isinstance(result[key], dict) and isinstance(value, Mapping):
            result[key] = _merged(result[key], value)
    return result


def _matrix_entry(values: F64) -> dict[str, Any]:
    data = values.tolist()
    rows, cols = (len(data), 1) if values.ndim == 1 else values.shape
    return {"rows": rows, "cols": cols, "data": data}


def _mount_entry(
    T_B_S: F64, extra: Mapping[str, Any], forward: str, backward: str
) -> dict[str, Any]:
    """Return the mounting keys: the matrix as it was read if it still says the same."""
    others = {key: value for key, value in extra.items() if key not in (forward, backward)}
    for key in (forward, backward):
        if key in extra:
            pose = Entry(extra, "extrinsics").pose(key)
            if np.array_equal(pose if key == forward else se3.inverse(pose), T_B_S):
                return {key: extra[key], **others}
    return {forward: _matrix_entry(se3.to_matrix(T_B_S)), **others}


def _imu_entry(imu: Imu) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "id": imu.id,
        "sensor_type": "IMU",
        "topic": imu.topic,
        "description": imu.description,
        "sigmas": {name: float(getattr(imu, name)) for name in _NOISE_KEYS},
        **{name: float(getattr(imu, name)) for name in _IMU_KEYS},
    }
    if imu.intrinsics is not None:
        entry["imu_intrinsics"] = {
            "T_g": _matrix_entry(imu.intrinsics.T_g),
            "T_a": _matrix_entry(imu.intrinsics.T_a),
            "R_AI": _matrix_entry(imu.intrinsics.R_A_I),
        }
    return _merged(entry, imu.extra)


def _rig_entry(rig: camera_models.CameraRig) -> dict[str, Any]:
    extras = rig.camera_extra or tuple({} for _ in rig.cameras)
    cameras = []
    for camera, T_B_C, extra in zip(rig.cameras, rig.T_B_C, extras, strict=True):
        mount: dict[str, Any] = {"camera": _camera_entry(camera)}
        if camera.time_offset_ns != 0:
            mount["time_offset_ns"] = int(camera.time_offset_ns)
        if camera.image_delay_s != 0.0:
            mount["image_delay_s"] = float(camera.image_delay_s)
        mount.update(_mount_entry(T_B_C, extra, "T_B_C", "T_C_B"))
        cameras.append(mount)
    entry = {
        "id": rig.id,
        "sensor_type": "NCAMERA",
        "topic": rig.topic,
        "description": rig.description,
        "cameras": cameras,
    }
    return _merged(entry, rig.extra)


def _camera_entry(camera: camera_models.Camera) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "id": camera.id,
        "sensor_type": "CAMERA",
        "topic": camera.topic,
        "description": camera.description,
        "image_height": int(camera.height_px),
        "image_width": int(camera.width_px),
        "type": camera.projection.value,
        "intrinsics": _matrix_entry(np.asarray(camera.intrinsics)),
        "distortion": {
            "type": camera.distortion.value,
            "parameters": _matrix_entry(np.asarray(camera.distortion_parameters)),
        },
    }
    if camera.line_delay_ns != 0:
        entry[_LINE_DELAY] = int(camera.line_delay_ns)
    return _merged(entry, camera.extra)
