"""The segment database as a file: an archive of table columns with a header."""

from __future__ import annotations

import dataclasses
import io
import json
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.algorithms.self_calibration.segments.database import SegmentDatabase, SegmentRecord
from maplab_py.errors import MaplabError, UserError
from maplab_py.input_files import DEFAULT_MAX_BYTES, RAISE_THE_BOUND, read_npz
from maplab_py.output_files import write_bytes
from maplab_py.sensors import SensorSet
from maplab_py.sensors.sensors_yaml import parse_sensors, read_sensors, write_sensors
from maplab_py.vimap import VIMap
from maplab_py.vimap.table import Table

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
        "sensors": write_sensors(database.vi_map.sensors),
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
        sensors = parse_sensors(header["sensors"], str(path), max_bytes)
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
            return read_sensors(file, max_bytes)
    if path.is_file() and path.suffix not in (".yaml", ".yml"):
        return load_database(path, max_bytes).vi_map.sensors
    if not path.is_file():
        raise UserError(f"{path}: there is no such calibration (sensors.yaml or map folder)")
    return read_sensors(path, max_bytes)


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
