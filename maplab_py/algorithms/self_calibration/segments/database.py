"""The segment database: the most informative segments of all sessions of one device."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import os
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.self_calibration.device import with_device_of
from maplab_py.algorithms.self_calibration.segments.splitting import extract_submap
from maplab_py.array_types import F64, I64
from maplab_py.atomic.system import opened_locked
from maplab_py.errors import MaplabError, UserError, os_errors_as
from maplab_py.input_files import DEFAULT_MAX_BYTES, RAISE_THE_BOUND, read_npz
from maplab_py.output_files import write_bytes
from maplab_py.sensors import SensorSet, sensors_yaml
from maplab_py.vimap import IdIndex, VIMap, from_hex, merge, to_hex
from maplab_py.vimap.selection import sorted_by_time
from maplab_py.vimap.table import Table
from maplab_py.vimap.tables import ImuSamples

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
            added = sorted_by_time(merge.stack(self.vi_map, with_device_of(added, self.vi_map)))
        return dataclasses.replace(self, vi_map=added, records=(*self.records, *records))

    def missions_recorded_in(self, vi_map: VIMap) -> set[str]:
        """Return the missions, by any id, whose segments have IMU samples of a map: the same recording."""
        samples, edges = self.vi_map.imu_samples, self.vi_map.imu_edges
        is_shared = np.isin(_as_words(samples), _as_words(vi_map.imu_samples))
        mission = self.vi_map.vertices.mission[np.repeat(edges.from_vertex, edges.sample_count)]
        shared = np.bincount(mission[is_shared], minlength=len(self.vi_map.missions))
        rows = np.flatnonzero(shared >= _SHARED_SAMPLES)
        return {to_hex(self.vi_map.missions.id[row]) for row in rows}

    def map_of(self, record: SegmentRecord) -> VIMap:
        """Return the map of one segment."""
        return extract_submap(self.vi_map, rows_of(self.vi_map, [record]))


_SHARED_SAMPLES = 3
"""Segments that adjoin share the sample at their common vertex, and its copies."""


def _as_words(samples: ImuSamples) -> NDArray[np.void]:
    """Return the samples (N,), time and values, as one value each."""
    columns = np.column_stack([samples.timestamp_ns, samples.accel_gyro.view(np.int64)])
    return np.ascontiguousarray(columns).view(f"V{columns.shape[1] * 8}")[:, 0]


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


FORMAT = "maplab-py segment database"
VERSION = 1
_HEADER_SHARE = 40
"""JSON takes up to this many times its size as objects."""

_TABLES = (
    "missions",
    "baseframes",
    "vertices",
    "frames",
    "keypoints",
    "landmarks",
    "imu_edges",
    "imu_samples",
)
_ADDED_LATER = ("frames/descriptor_layout",)
"""Columns that databases of before do not have; they get their fill values."""


_SECONDS_BETWEEN_TRIES, _SECONDS_TO_WAIT = 0.1, 600.0


@contextlib.contextmanager
def locked_database(path: Path | None) -> Iterator[None]:
    """Lock a database from reading to writing it, so that no process loses segments; None = nothing.

    Raises:
        UserError: Another process holds it for minutes, or its folder cannot be written.
    """
    if path is None or not path.parent.is_dir():
        yield
        return
    lock, until_s = path.with_name(path.name + ".lock"), time.monotonic() + _SECONDS_TO_WAIT
    with os_errors_as(UserError, f"{lock}: cannot be locked"):
        while (descriptor := opened_locked(lock)) is None:
            if time.monotonic() > until_s:
                raise UserError(f"{path}: another process has worked on it for minutes; stop that")
            time.sleep(_SECONDS_BETWEEN_TRIES)
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            lock.unlink()  # who waits for it sees that, and makes another
        os.close(descriptor)


def save_database(database: SegmentDatabase, path: Path) -> None:
    """Write a database at once: the file contains either the old or the new one.

    Raises:
        UserError: It cannot be written.
    """
    header = {
        "format": FORMAT,
        "version": VERSION,
        "tables": {name: list(groups) for name, groups in database.tables.items()},
        "metric": database.metric,
        "capacity": database.capacity,
        "selection": database.selection,
        "parameter_names": list(database.parameter_names),
        "records": [dataclasses.asdict(record) for record in database.records],
        "sensors": sensors_yaml.write_sensors(database.vi_map.sensors),
    }
    arrays: dict[str, Any] = {"sigma_ref": database.sigma_ref}
    for name in _TABLES:
        for column, values in getattr(database.vi_map, name).columns().items():
            if values.dtype.kind != "O":
                arrays[f"{name}/{column}"] = values
    text = json.dumps(header, sort_keys=True).encode()
    arrays["header"] = np.frombuffer(text, dtype=np.uint8)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    write_bytes(path, [buffer.getvalue()], overwrite=True)


def load_database(path: Path, max_bytes: int = DEFAULT_MAX_BYTES) -> SegmentDatabase:
    """Read what `save_database` has written; it may unpack to at most `max_bytes`.

    Raises:
        UserError: The file is missing, too large, damaged, not a database, or of a newer version.
    """
    try:
        archive = read_npz(path, max_bytes)
        if archive["header"].nbytes > max_bytes // _HEADER_SHARE:
            raise UserError(
                f"{path}: its header is larger than {max_bytes / _HEADER_SHARE / 1e6:g} MB; "
                f"{RAISE_THE_BOUND}"
            )
        header = json.loads(bytes(archive["header"]).decode())
        if not isinstance(header, dict) or header.get("format") != FORMAT:
            raise UserError(f"{path} is not a segment database")
        if header["version"] > VERSION:
            raise UserError(
                f"{path} has version {header['version']}; this program reads up to {VERSION}"
            )
        parts: dict[str, Any] = {name: _table(archive, name) for name in _TABLES}
        sigma_ref = archive["sigma_ref"]
        sensors = sensors_yaml.parse_sensors(header["sensors"], str(path), max_bytes)
        return SegmentDatabase(
            VIMap(sensors=sensors, **parts),
            tuple(
                SegmentRecord(**{**record, "sigma": tuple(record["sigma"])})
                for record in header["records"]
            ),
            {name: tuple(groups) for name, groups in header["tables"].items()},
            header["metric"],
            int(header["capacity"]),
            tuple(header["parameter_names"]),
            sigma_ref,
            header["selection"],
        )
    except FileNotFoundError:
        raise UserError(f"{path}: there is no such segment database") from None
    except MaplabError:
        raise
    except IsADirectoryError:
        raise UserError(f"{path} is a folder; a segment database is a file") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror})") from error
    except MemoryError as error:
        raise UserError(f"{path}: the segment database does not fit into memory") from error
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise UserError(
            f"{path} is damaged or not a segment database (collect_segments writes them)"
        ) from error


def read_calibration(path: Path, max_bytes: int = DEFAULT_MAX_BYTES) -> SensorSet:
    """Read the sensors of a sensors.yaml, a map folder or a segment database of bounded size.

    Raises:
        UserError: There is none, or it is damaged.
    """
    for file in (path / "vi_map" / "sensors.yaml", path / "sensors.yaml"):
        if path.is_dir() and file.is_file():
            return sensors_yaml.read_sensors(file, max_bytes)
    if path.is_file() and path.suffix not in (".yaml", ".yml"):
        return load_database(path, max_bytes).vi_map.sensors
    if not path.is_file():
        raise UserError(f"{path}: there is no such calibration (sensors.yaml or map folder)")
    return sensors_yaml.read_sensors(path, max_bytes)


def _table(archive: Any, name: str) -> Table:
    kind = type(getattr(VIMap(), name))
    columns = {
        field.name: archive[f"{name}/{field.name}"]
        for field in dataclasses.fields(kind)
        if field.metadata["dtype"].kind != "O"
        and (f"{name}/{field.name}" in archive or f"{name}/{field.name}" not in _ADDED_LATER)
    }
    length = len(next(iter(columns.values())))
    table: Table = kind.filled(length, **columns)
    return table
