"""The clouds of sensors in a map: where they were recorded, and their points."""

from __future__ import annotations

import dataclasses
import itertools
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.cloud_registration.registration import PreparedCloud, prepare_cloud
from maplab_py.array_types import F64, I64
from maplab_py.errors import MapError, UserError
from maplab_py.geometry import se3
from maplab_py.geometry.association import nearest_rows
from maplab_py.geometry.interpolation import interpolate_poses
from maplab_py.interop.ply import parse_ply
from maplab_py.storage.resources import ResourceStore
from maplab_py.vimap import MissionSensor, ResourceOwner, VIMap
from maplab_py.vimap.ids import as_keys, to_hex
from maplab_py.vimap.queries import mission_sensor_id
from maplab_py.vimap.resource_queries import resources_of

CLOUD_TYPES = (16, 17, 21)
"""Resource types of clouds: plain, with colours, with intensities."""
_KEPT = 400
"""Number of prepared clouds in memory."""


@dataclasses.dataclass(frozen=True, eq=False)
class Scans:
    """Clouds (N) of sensors, by mission and time; S is the sensor at the time of the cloud."""

    resource: I64  # (N,) rows
    mission: I64  # (N,) rows
    time_ns: I64  # (N,)
    vertex: I64  # (N,) row of the vertex nearest in time
    T_V_S: F64  # (N, 7) in the body frame of that vertex
    T_G_S: F64  # (N, 7)

    def __len__(self) -> int:
        return len(self.resource)

    def take(self, rows: I64) -> Scans:
        """Return some of the clouds."""
        names = [field.name for field in dataclasses.fields(self)]
        return Scans(**{name: getattr(self, name)[rows] for name in names})


def map_scans(vi_map: VIMap, missions: I64, every_nth: int = 1) -> Scans:
    """Return the clouds of the sensors of some missions (rows).

    Clouds of times without vertices nearby (outside the mission) are left out.

    Raises:
        UserError: There is none.
        MapError: A sensor has no extrinsics.
    """
    table = vi_map.resources
    chosen = resources_of(vi_map, CLOUD_TYPES, missions)
    chosen &= table.owner_kind == ResourceOwner.SENSOR
    rows = np.flatnonzero(chosen)
    keys = as_keys(table.sensor_id[rows])
    order = np.lexsort((table.timestamp_ns[rows], keys, table.owner[rows]))
    parts = []
    for group in _groups(table.owner[rows][order], keys[order]):
        inside = _of_sensor(vi_map, rows[order[group]][::every_nth])
        if len(inside):
            parts.append(inside)
    if not parts:
        raise UserError(
            "the map has no clouds of a sensor: import_point_clouds attaches some (clouds of cameras "
            "are not registered)"
        )
    names = [field.name for field in dataclasses.fields(Scans)]
    return Scans(**{n: np.concatenate([getattr(part, n) for part in parts]) for n in names})


def _groups(owner: NDArray[np.int32], keys: NDArray[np.void]) -> list[slice]:
    """Return the runs of equal owner and sensor."""
    if not len(owner):
        return []
    change = np.flatnonzero((owner[1:] != owner[:-1]) | (keys[1:] != keys[:-1])) + 1
    return [slice(a, b) for a, b in itertools.pairwise([0, *change.tolist(), len(owner)])]


def _of_sensor(vi_map: VIMap, rows: I64) -> Scans:
    """Return the clouds (rows of resources, by time) of a sensor in one mission."""
    table = vi_map.resources
    mission = int(table.owner[rows[0]])
    first, last = vi_map.vertex_start[mission : mission + 2].tolist()
    times = vi_map.vertices.timestamp_ns[first:last]
    if len(times):
        stamp = table.timestamp_ns[rows]
        rows = rows[(stamp >= times[0]) & (stamp <= times[-1])]
    if not len(times) or not len(rows):
        rows = rows[:0]
    stamp = table.timestamp_ns[rows]
    empty = np.zeros((0, 7))
    if not len(rows):
        none = np.zeros(0, dtype=np.int64)
        return Scans(none, none, none, none, empty, empty)
    T_G_I, _ = interpolate_poses(times, vi_map.T_G_I[first:last], stamp)
    imu_id = mission_sensor_id(vi_map, mission, MissionSensor.IMU)
    T_I_S = vi_map.sensors.T_I_S(imu_id, to_hex(table.sensor_id[rows[0]]))
    T_G_S = se3.compose(T_G_I, T_I_S)
    vertex = first + nearest_rows(times, stamp)
    return Scans(
        rows,
        np.full(len(rows), mission, dtype=np.int64),
        stamp.astype(np.int64),
        vertex,
        se3.relative(vi_map.T_G_I[vertex], T_G_S),
        T_G_S,
    )


class CloudReader:
    """Reads and prepares clouds; keeps the latest ones."""

    def __init__(self, vi_map: VIMap, map_folder: Path, voxel_size_m: float) -> None:
        """Serve the clouds of a map whose resources are in its folder."""
        self._vi_map, self._store = vi_map, ResourceStore(vi_map, map_folder)
        self._voxel_size_m = voxel_size_m
        self.cloud = lru_cache(maxsize=_KEPT)(self._read)
        """Return the prepared cloud of a resource (row); MapError if it is damaged or too small."""

    def _read(self, row: int) -> PreparedCloud:
        name = f"cloud {to_hex(self._vi_map.resources.id[row])}"
        points = parse_ply(self._store.load(row), name).p
        if not np.isfinite(points).all():
            raise MapError(f"{name} has points that are not finite: remove_resources, import again")
        return prepare_cloud(points, self._voxel_size_m, name)
