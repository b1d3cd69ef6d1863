"""The segment database: the most informative segments of all sessions of one device."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.self_calibration.segments import restricted
from maplab_py.errors import UserError
from maplab_py.sensors import SensorSet
from maplab_py.vimap import MissionSensor, VIMap
from maplab_py.vimap.ids import IdIndex, from_hex, to_hex
from maplab_py.vimap.queries import mission_sensor_id
from maplab_py.vimap.selection import keep_rows
from maplab_py.vimap.stacking import stack

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


@dataclasses.dataclass(frozen=True)
class SegmentRecord:
    """A segment and its scores; less is more informative."""

    mission: str
    first_vertex: str
    last_vertex: str
    keyframes: int
    begin_ns: int
    duration_s: float
    scores: Mapping[str, float]  # by table
    sigma: tuple[float, ...]  # of every parameter, given this segment and the priors
    unobservable: int  # directions that the segment says nothing about
    gyro_rms_radps: float
    accel_change_mps2: float  # standard deviation of the specific force
    landmarks: int

    @property
    def key(self) -> tuple[str, str]:
        """What tells segments apart."""
        return self.first_vertex, self.last_vertex


@dataclasses.dataclass(frozen=True, eq=False)
class SegmentDatabase:
    """N best segments per table, with raw IMU, tracks, states and calibration, as one map.

    Scores belong to one calibration and one set of reference deviations, so that sessions can be
    compared; `parameter_names` says what they are scores of.
    """

    vi_map: VIMap
    records: tuple[SegmentRecord, ...]
    tables: Mapping[str, tuple[str, ...]]  # basic groups of every table
    metric: str
    capacity: int  # segments per table
    parameter_names: tuple[str, ...]
    sigma_ref: F64
    selection: str = "informative"

    def __len__(self) -> int:
        return len(self.records)

    def ranked(self, table: str) -> list[SegmentRecord]:
        """Return the records of a table, the most informative first, at most `capacity`."""
        sign = -1.0 if self.selection == "least_informative" else 1.0
        order = sorted(self.records, key=lambda one: (sign * one.scores[table], one.begin_ns))
        return order[: self.capacity]

    def members(self) -> dict[tuple[str, str], tuple[str, ...]]:
        """Return the tables that keep each segment, by its key."""
        found: dict[tuple[str, str], tuple[str, ...]] = {}
        for table in self.tables:
            for one in self.ranked(table):
                found[one.key] = (*found.get(one.key, ()), table)
        return found

    def pruned(self, capacity: int | None = None) -> SegmentDatabase:
        """Return the database of the segments that a table keeps, with another capacity if given."""
        smaller = dataclasses.replace(self, capacity=capacity or self.capacity)
        kept = smaller.members()
        return smaller.only([one for one in self.records if one.key in kept])

    def without(self, keys: set[tuple[str, str]]) -> SegmentDatabase:
        """Return the database without some segments."""
        return self.only([one for one in self.records if one.key not in keys])

    def without_missions(self, missions: set[str]) -> SegmentDatabase:
        """Return the database without the segments of some missions."""
        return self.only([one for one in self.records if one.mission not in missions])

    def only(self, records: list[SegmentRecord]) -> SegmentDatabase:
        """Return the database of some of its segments."""
        if len(records) == len(self.records):
            return self
        rows = rows_of(self.vi_map, records)
        vi_map = restricted(self.vi_map, rows) if len(rows) else VIMap(sensors=self.vi_map.sensors)
        return dataclasses.replace(self, vi_map=vi_map, records=tuple(records))

    def with_segments(self, vi_map: VIMap, records: list[SegmentRecord]) -> SegmentDatabase:
        """Return the database with segments of a map added; nothing is dropped.

        Raises:
            UserError: A mission is in the database already.
        """
        known = {one.mission for one in self.records}
        if again := sorted(known & {one.mission for one in records}):
            raise UserError(f"the database has segments of mission {again[0]} already")
        if not records:
            return self
        added = restricted(vi_map, rows_of(vi_map, records))
        if len(self.vi_map.missions):
            added = stack(self.vi_map, with_device(added, self.vi_map))
            order = np.lexsort((added.vertices.timestamp_ns, added.vertices.mission))
            added = keep_rows(added, vertices=order)
        return dataclasses.replace(self, vi_map=added, records=(*self.records, *records))

    def map_of(self, record: SegmentRecord) -> VIMap:
        """Return the map of one segment."""
        return restricted(self.vi_map, rows_of(self.vi_map, [record]))


def rows_of(vi_map: VIMap, records: list[SegmentRecord]) -> I64:
    """Return the vertex rows of segments.

    Raises:
        UserError: The map lacks one.
    """
    index = IdIndex(vi_map.vertices.id)
    rows: list[I64] = [np.zeros(0, dtype=np.int64)]
    for one in records:
        first, last = (
            int(index.rows(from_hex(text)[None])[0]) for text in (one.first_vertex, one.last_vertex)
        )
        if first < 0 or last < 0 or last - first + 1 != one.keyframes:
            raise UserError(f"segment {one.first_vertex} is not in the map as it was")
        rows.append(np.arange(first, last + 1))
    return np.unique(np.concatenate(rows))


def device_of(vi_map: VIMap, missions: NDArray[np.integer] | None = None) -> tuple[str, str]:
    """Return the ids of the IMU and the camera rig that all missions (rows, None = all) share.

    Raises:
        UserError: Missions have different ones.
    """
    rows = range(len(vi_map.missions)) if missions is None else np.asarray(missions).tolist()
    found = {
        (
            mission_sensor_id(vi_map, row, MissionSensor.IMU),
            mission_sensor_id(vi_map, row, MissionSensor.NCAMERA),
        )
        for row in rows
    }
    if len(found) != 1:
        raise UserError(
            f"the missions were recorded with {len(found)} devices or calibrations: "
            "choose those of one with --map_mission_list"
        )
    return found.pop()


def with_device(vi_map: VIMap, like: VIMap) -> VIMap:
    """Return a map whose missions use the IMU and the rig, and the calibration, of another's.

    Raises:
        UserError: The rigs differ in more than calibration.
    """
    imu_id, rig_id = device_of(like)
    own_rig = device_of(vi_map)[1]
    cameras = [
        [(c.projection, c.distortion, c.width_px, c.height_px) for c in rig.cameras]
        for rig in (vi_map.sensors.camera_rig(own_rig), like.sensors.camera_rig(rig_id))
    ]
    if cameras[0] != cameras[1]:
        raise UserError(
            "the map was recorded with other cameras than the database: their number, models or "
            "resolutions differ; use another database file"
        )
    sensor_id = np.array(vi_map.missions.sensor_id)
    sensor_id[:, MissionSensor.IMU] = from_hex(imu_id)
    sensor_id[:, MissionSensor.NCAMERA] = from_hex(rig_id)
    return vi_map.replace(
        sensors=like.sensors, missions=vi_map.missions.replace(sensor_id=sensor_id)
    )


def with_calibration(sensors: SensorSet, calibrated: SensorSet) -> SensorSet:
    """Return sensors with those of a calibration in place of what has the same id."""
    mounts = {k: v for k, v in calibrated.extrinsics.items() if k in calibrated.sensors}
    return dataclasses.replace(
        sensors,
        sensors={**sensors.sensors, **calibrated.sensors},
        extrinsics={**sensors.extrinsics, **mounts},
    )


def mission_names(vi_map: VIMap) -> list[str]:
    """Return the ids of the missions in hexadecimal digits."""
    return [to_hex(words) for words in vi_map.missions.id]
