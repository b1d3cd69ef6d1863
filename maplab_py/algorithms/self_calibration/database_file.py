"""The segment database as a file: one archive of columns with a header, replaced as a whole."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.algorithms.self_calibration.database import SegmentDatabase, SegmentRecord
from maplab_py.errors import MaplabError, UserError
from maplab_py.sensors.sensors_yaml import parse_sensors, write_sensors
from maplab_py.vimap import VIMap
from maplab_py.vimap.table import Table

FORMAT = "maplab-py segment database"
VERSION = 1

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


def save_database(database: SegmentDatabase, path: Path) -> None:
    """Write a database; whoever looks, and whenever the program dies, old or new is there.

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
        "records": [dataclasses.asdict(one) for one in database.records],
        "sensors": write_sensors(database.vi_map.sensors),
    }
    arrays: dict[str, Any] = {"sigma_ref": database.sigma_ref}
    for name in _TABLES:
        for column, values in getattr(database.vi_map, name).columns().items():
            if values.dtype.kind != "O":
                arrays[f"{name}/{column}"] = values
    text = json.dumps(header, sort_keys=True).encode()
    arrays["header"] = np.frombuffer(text, dtype=np.uint8)
    temporary = path.with_name(f".{path.name}.saving-{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("wb") as file:
            np.savez_compressed(file, **arrays)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        raise UserError(f"{path}: cannot be saved ({error.strerror})") from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def load_database(path: Path) -> SegmentDatabase:
    """Read what `save_database` has written.

    Raises:
        UserError: The file is missing, damaged, not a database, or of a newer version.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            header = json.loads(bytes(archive["header"]).decode())
            if header.get("format") != FORMAT:
                raise UserError(f"{path} is not a segment database")
            if header["version"] > VERSION:
                raise UserError(
                    f"{path} has version {header['version']}; this program reads up to {VERSION}"
                )
            parts: dict[str, Any] = {name: _table(archive, name) for name in _TABLES}
            sigma_ref = archive["sigma_ref"]
        sensors = parse_sensors(header["sensors"], str(path))
        return SegmentDatabase(
            VIMap(sensors=sensors, **parts),
            tuple(
                SegmentRecord(**{**one, "sigma": tuple(one["sigma"])}) for one in header["records"]
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
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise UserError(
            f"{path} is damaged or not a segment database (collect_segments writes them)"
        ) from error


def _table(archive: Any, name: str) -> Table:
    kind = type(getattr(VIMap(), name))
    columns = {
        field.name: archive[f"{name}/{field.name}"]
        for field in dataclasses.fields(kind)
        if field.metadata["dtype"].kind != "O"
    }
    length = len(next(iter(columns.values())))
    table: Table = kind.filled(length, **columns)
    return table
