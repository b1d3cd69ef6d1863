"""Sensors without a model that measurements of other programs belong to."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from maplab_py.array_types import F64, I64, U64
from maplab_py.errors import MapError, UserError
from maplab_py.geometry import se3
from maplab_py.sensors import Extrinsics, OtherSensor
from maplab_py.vimap import MissionSensor, VIMap
from maplab_py.vimap.ids import from_hex, random_ids, to_hex
from maplab_py.vimap.queries import mission_sensor_id

UNKNOWN_SIGMA_RAD = 1e3
"""Deviation of orientations that were not measured: they weigh nothing."""


def content_words(vi_map: VIMap, mission: int, kind: str, times_ns: I64, values: F64) -> U64:
    """Return an id (2,) that follows from measurements and the mission that gets them.

    Six decimals of the values count: their last digits differ between processors.
    """
    content = hashlib.blake2b(kind.encode(), digest_size=16)
    content.update(vi_map.missions.id[mission].tobytes())
    content.update(np.ascontiguousarray(times_ns).tobytes())
    content.update(np.ascontiguousarray(values.round(6) + 0.0).tobytes())  # + 0: no negative zero
    rng = np.random.default_rng(int.from_bytes(content.digest(), "little"))
    return np.asarray(random_ids(1, rng)[0], dtype=np.uint64)


def with_sensor(
    vi_map: VIMap,
    mission: int,
    kind: MissionSensor,
    words: U64,
    T_I_S: F64,
    keys: Mapping[str, Any],
) -> VIMap:
    """Return the map with a sensor on the body of a mission (row).

    Raises:
        UserError: The map has a sensor of this id, that is, these measurements already, or there is nothing
            to mount the sensor on.
    """
    sensor_id, name = to_hex(words), kind.name
    if sensor_id in vi_map.sensors.sensors:
        raise UserError(f"the map has these measurements already, of sensor {sensor_id}")
    entry = {"id": sensor_id, "sensor_type": name, **keys}
    sensors = vi_map.sensors
    base = _base(vi_map, mission)
    is_off_body = bool(np.any(T_I_S[:4] != [0.0, 0.0, 0.0, 1.0]) or np.any(T_I_S[4:] != 0.0))
    if not base and is_off_body:
        raise UserError(
            "the mission has neither IMU nor odometry nor cameras to mount a sensor on: leave out its lever "
            "arm"
        )
    T_B_S = se3.relative(sensors.T_R_S(base), T_I_S) if base else se3.identity()
    if base and base == mission_sensor_id(vi_map, mission, MissionSensor.IMU):
        T_B_S = np.asarray(T_I_S)
    mounts = {**sensors.extrinsics, sensor_id: Extrinsics(base or sensor_id, T_B_S)}
    ids = np.array(vi_map.missions.sensor_id)
    ids[mission, kind] = from_hex(sensor_id)
    return vi_map.replace(
        sensors=type(sensors)(
            {**sensors.sensors, sensor_id: OtherSensor(sensor_id, name, entry)},
            mounts,
            sensors.extra,
        ),
        missions=vi_map.missions.replace(sensor_id=ids),
    )


def _base(vi_map: VIMap, mission: int) -> str:
    """Return the id of the sensor of a mission that others are mounted on, empty if there is none."""
    kinds = (MissionSensor.IMU, MissionSensor.ODOMETRY_6DOF, MissionSensor.NCAMERA)
    known = vi_map.sensors.sensors
    candidates = (mission_sensor_id(vi_map, mission, kind) for kind in kinds)
    return next((sensor for sensor in candidates if sensor in known), "")


def mounting(vi_map: VIMap, mission: int, sensor_id: str) -> F64:
    """Return T_I_S (7,) of a sensor or camera on the IMU of a mission; empty = the IMU itself.

    Raises:
        UserError: The map has no such sensor.
    """
    if not sensor_id:
        return se3.identity()
    imu_id = mission_sensor_id(vi_map, mission, MissionSensor.IMU)
    try:
        return np.asarray(vi_map.sensors.T_I_S(imu_id, sensor_id))
    except MapError as error:
        raise UserError(f"--sensor_id={sensor_id}: {error}") from error


def without_sensors(vi_map: VIMap, words: U64) -> VIMap:
    """Return the map without sensors (N, 2) that no measurement refers to any more."""
    removed = {to_hex(word) for word in words}
    sensors = vi_map.sensors
    return vi_map.replace(
        sensors=type(sensors)(
            {key: sensor for key, sensor in sensors.sensors.items() if key not in removed},
            {key: mount for key, mount in sensors.extrinsics.items() if key not in removed},
            sensors.extra,
        )
    )
