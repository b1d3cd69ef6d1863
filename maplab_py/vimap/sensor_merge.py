"""Join the sensors of two maps: equal calibrations are shared, different ones get new ids."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from maplab_py.geometry import se3
from maplab_py.sensors import CameraRig, Extrinsics, OtherSensor, SensorSet, sensor_set
from maplab_py.vimap.ids import IdArray, from_hex, random_ids, to_hex
from maplab_py.vimap.tables import MissionSensor
from maplab_py.vimap.vi_map import VIMap

_TEXT_FIELDS = frozenset({"id", "topic", "description", "extra", "camera_extra"})
"""Fields that do not belong to the calibration."""


def conflicting_sensors(base: SensorSet, other: SensorSet) -> tuple[str, ...]:
    """Return the ids that both sets have with different calibrations or mounts.

    A sensor mounted on one that conflicts conflicts too: its pose is relative to it.
    """
    common = [sensor_id for sensor_id in other.sensors if sensor_id in base.sensors]
    conflicts = {
        sensor_id
        for sensor_id in common
        if not same_calibration(base.sensors[sensor_id], other.sensors[sensor_id])
        or not _same_mount(base, other, sensor_id)
    }
    while True:
        more = {s for s in common if s not in conflicts and _base_of(other, s) in conflicts}
        if not more:
            return tuple(sensor_id for sensor_id in common if sensor_id in conflicts)
        conflicts |= more


def same_calibration(a: sensor_set.Sensor, b: sensor_set.Sensor) -> bool:
    """Return whether two calibrations are equal, ignoring texts, topics and unknown keys."""
    if type(a) is not type(b):
        return False
    if isinstance(a, OtherSensor) and isinstance(b, OtherSensor):
        texts = {"id", "topic", "description"}
        keys_a = {k: v for k, v in a.keys.items() if k not in texts}
        keys_b = {k: v for k, v in b.keys.items() if k not in texts}
        return a.sensor_type == b.sensor_type and _equal(keys_a, keys_b)
    return _equal(a, b)


def _equal(a: Any, b: Any) -> bool:
    if dataclasses.is_dataclass(a) and not isinstance(a, type):
        names = [f.name for f in dataclasses.fields(a) if f.name not in _TEXT_FIELDS]
        return type(a) is type(b) and all(_equal(getattr(a, n), getattr(b, n)) for n in names)
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and bool(np.array_equal(a, b))
    if isinstance(a, Mapping):
        return (
            isinstance(b, Mapping) and a.keys() == b.keys() and all(_equal(a[k], b[k]) for k in a)
        )
    if isinstance(a, (list, tuple)):
        return (
            isinstance(b, (list, tuple))
            and len(a) == len(b)
            and all(_equal(x, y) for x, y in zip(a, b, strict=True))
        )
    return bool(a == b)


def _base_of(sensors: SensorSet, sensor_id: str) -> str:
    entry = sensors.extrinsics.get(sensor_id)
    return sensor_id if entry is None else entry.base_sensor_id


def _same_mount(a: SensorSet, b: SensorSet, sensor_id: str) -> bool:
    same_base = _base_of(a, sensor_id) == _base_of(b, sensor_id)
    poses = [
        np.asarray(s.T_B_S(sensor_id)) if sensor_id in s.extrinsics else se3.identity()
        for s in (a, b)
    ]
    return same_base and bool(np.array_equal(poses[0], poses[1]))


def with_renamed_sensors(vi_map: VIMap, new_ids: Mapping[str, str]) -> VIMap:
    """Return the map with some sensors under other ids, wherever they are named."""
    if not new_ids:
        return vi_map
    missions, edges = vi_map.missions, vi_map.transformation_edges
    absolute, resources = vi_map.absolute_poses, vi_map.resources
    sensor_id = _renamed(missions.sensor_id.reshape(-1, 2), new_ids)
    return vi_map.replace(
        sensors=_renamed_set(vi_map.sensors, new_ids),
        missions=missions.replace(sensor_id=sensor_id.reshape(-1, len(MissionSensor), 2)),
        transformation_edges=edges.replace(sensor_id=_renamed(edges.sensor_id, new_ids)),
        absolute_poses=absolute.replace(sensor_id=_renamed(absolute.sensor_id, new_ids)),
        resources=resources.replace(sensor_id=_renamed(resources.sensor_id, new_ids)),
    )


def _renamed(ids: IdArray, new_ids: Mapping[str, str]) -> IdArray:
    renamed = ids.copy()
    for old, new in new_ids.items():
        renamed[np.all(ids == from_hex(old), axis=1)] = from_hex(new)
    return renamed


def _renamed_set(sensors: SensorSet, new_ids: Mapping[str, str]) -> SensorSet:
    def mount(entry: Extrinsics) -> Extrinsics:
        base = new_ids.get(entry.base_sensor_id, entry.base_sensor_id)
        return dataclasses.replace(entry, base_sensor_id=base)

    renamed: dict[str, sensor_set.Sensor] = {}
    for old, sensor in sensors.sensors.items():
        renamed[new_ids.get(old, old)] = (
            _with_id(sensor, new_ids[old]) if old in new_ids else sensor
        )
    mounts = {new_ids.get(old, old): mount(entry) for old, entry in sensors.extrinsics.items()}
    return dataclasses.replace(sensors, sensors=renamed, extrinsics=mounts)


def _with_id(sensor: sensor_set.Sensor, sensor_id: str) -> sensor_set.Sensor:
    """Give a sensor another id; a rig's cameras get ids derived from it."""
    if isinstance(sensor, OtherSensor):
        keys = {**sensor.keys, "id": sensor_id} if "id" in sensor.keys else sensor.keys
        return dataclasses.replace(sensor, id=sensor_id, keys=keys)
    if isinstance(sensor, CameraRig):
        rng = np.random.default_rng([int(word) for word in from_hex(sensor_id)])
        ids = random_ids(len(sensor.cameras), rng)
        cameras = tuple(
            dataclasses.replace(camera, id=to_hex(row))
            for camera, row in zip(sensor.cameras, ids, strict=True)
        )
        return dataclasses.replace(sensor, id=sensor_id, cameras=cameras)
    return dataclasses.replace(sensor, id=sensor_id)


def union(base: SensorSet, other: SensorSet) -> SensorSet:
    """Return the sensors of both sets; the base's entry is used for ids in both."""
    return SensorSet(
        sensors={
            **base.sensors,
            **{k: v for k, v in other.sensors.items() if k not in base.sensors},
        },
        extrinsics={
            **base.extrinsics,
            **{k: v for k, v in other.extrinsics.items() if k not in base.sensors},
        },
        extra={**other.extra, **base.extra},
    )
