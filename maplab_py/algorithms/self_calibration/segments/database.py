"""The segment database: the most informative segments of all sessions of one device."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from maplab_py.algorithms.self_calibration.device import with_device_of
from maplab_py.algorithms.self_calibration.segments.splitting import extract_submap
from maplab_py.array_types import F64, I64
from maplab_py.errors import UserError
from maplab_py.vimap import VIMap
from maplab_py.vimap.ids import IdIndex, from_hex
from maplab_py.vimap.selection import sorted_by_time
from maplab_py.vimap.stacking import stack

Key = tuple[str, str]
"""First and last vertex of a segment."""


@dataclasses.dataclass(frozen=True)
class SegmentRecord:
    """A segment and its scores; a lower score is more informative."""

    mission: str
    first_vertex: str
    last_vertex: str
    keyframes: int
    begin_ns: int
    duration_s: float
    scores: Mapping[str, float]  # by table
    sigma: tuple[float, ...]  # of every parameter, given this segment and the priors
    unobservable: int  # directions that the segment does not determine
    gyro_rms_radps: float
    accel_change_mps2: float  # standard deviation of the specific force
    landmarks: int

    @property
    def key(self) -> Key:
        """Key of the segment."""
        return self.first_vertex, self.last_vertex


@dataclasses.dataclass(frozen=True, eq=False)
class SegmentDatabase:
    """The best segments of every table, with raw IMU, tracks, states and sensors, as one map.

    All scores belong to one calibration and one set of reference deviations, so that sessions can be
    compared; `parameter_names` lists the calibration's parameters.
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
        order = sorted(
            self.records, key=lambda record: (sign * record.scores[table], record.begin_ns)
        )
        return order[: self.capacity]

    def members(self) -> dict[Key, tuple[str, ...]]:
        """Return the tables that keep each segment, by its key."""
        tables: dict[Key, tuple[str, ...]] = {}
        for table in self.tables:
            for record in self.ranked(table):
                tables[record.key] = (*tables.get(record.key, ()), table)
        return tables

    def pruned(self, capacity: int) -> SegmentDatabase:
        """Return the database of the segments that tables of another capacity keep."""
        smaller = dataclasses.replace(self, capacity=capacity)
        return smaller.with_only(smaller.members())

    def without_missions(self, missions: Collection[str]) -> SegmentDatabase:
        """Return the database without the segments of some missions."""
        return self.with_only(
            [record.key for record in self.records if record.mission not in missions]
        )

    def with_only(self, keys: Collection[Key]) -> SegmentDatabase:
        """Return the database of some of its segments."""
        records = tuple(record for record in self.records if record.key in keys)
        if len(records) == len(self.records):
            return self
        vi_map = VIMap(sensors=self.vi_map.sensors)
        if records:
            vi_map = extract_submap(self.vi_map, rows_of(self.vi_map, records))
        return dataclasses.replace(self, vi_map=vi_map, records=records)

    def with_segments(self, vi_map: VIMap, records: Sequence[SegmentRecord]) -> SegmentDatabase:
        """Return the database with segments of a map added; nothing is dropped.

        Raises:
            UserError: A mission is in the database already.
        """
        known = {record.mission for record in self.records}
        if repeated := sorted(known & {record.mission for record in records}):
            raise UserError(f"the database has segments of mission {repeated[0]} already")
        if not records:
            return self
        added = extract_submap(vi_map, rows_of(vi_map, records))
        if len(self.vi_map.missions):
            added = sorted_by_time(stack(self.vi_map, with_device_of(added, self.vi_map)))
        return dataclasses.replace(self, vi_map=added, records=(*self.records, *records))

    def map_of(self, record: SegmentRecord) -> VIMap:
        """Return the map of one segment."""
        return extract_submap(self.vi_map, rows_of(self.vi_map, [record]))


def rows_of(vi_map: VIMap, records: Sequence[SegmentRecord]) -> I64:
    """Return the vertex rows of segments.

    Raises:
        UserError: The map lacks one.
    """
    index = IdIndex(vi_map.vertices.id)
    rows: list[I64] = [np.zeros(0, dtype=np.int64)]
    for record in records:
        first, last = (int(index.rows(from_hex(vertex)[None])[0]) for vertex in record.key)
        if first < 0 or last < 0 or last - first + 1 != record.keyframes:
            raise UserError(f"segment {record.first_vertex} is not in the map as it was")
        rows.append(np.arange(first, last + 1))
    return np.unique(np.concatenate(rows))
