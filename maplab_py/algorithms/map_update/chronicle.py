"""Chronicle of a map: what each update did, and what leads back to the map before it.

A record is a text among the resources of the newest mission: its report, and the columns of the map before
as differences from those after it. Rows of a column that both maps hold are numbers of rows.
"""

import base64
import dataclasses
import hashlib
import json
import zlib
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.algorithms.map_update.options import MapUpdateReport, UpdateRecord
from maplab_py.array_types import I64, NDArray
from maplab_py.errors import MapError
from maplab_py.sensors.sensors_yaml import parse_sensors, write_sensors
from maplab_py.storage.extension_fields import PACKED, unpacked
from maplab_py.storage.resources.new import NewResources
from maplab_py.storage.resources.store import MAP_FOLDER, resource_path
from maplab_py.vimap import IdIndex, ResourceOwner, VIMap
from maplab_py.vimap.descriptors import DescriptorBlock
from maplab_py.vimap.table import Table, object_column

_TEXT = 11
"""Number of the resource type of texts."""
_MARK = "maplab-py update 1"
"""First line of a record; its facts and its differences follow."""
_DAMAGES = (
    ValueError, TypeError, LookupError, AttributeError, ArithmeticError, RecursionError,
    SyntaxError,  # of a dtype
)  # fmt: skip
_MULTIPLIER = np.uint64(0x9E3779B97F4A7C15)


@dataclasses.dataclass(frozen=True)
class Record:
    """An update of a map."""

    facts: UpdateRecord
    before: str  # checksums of the maps
    after: str
    differences: bytes


def stored_order(vi_map: VIMap) -> VIMap:
    """Return the map with its landmarks in the order in which they are loaded again."""
    order = np.argsort(vi_map.landmarks.vertex, kind="stable")
    row = np.append(np.argsort(order), -1).astype(np.int32)
    keypoints = vi_map.keypoints.replace(landmark=row[vi_map.keypoints.landmark])
    return vi_map.replace(landmarks=vi_map.landmarks.take(order), keypoints=keypoints)


def with_record(before: VIMap, after: VIMap, report: MapUpdateReport) -> VIMap:
    """Return the updated map, whose landmarks are in stored order, with a record of the update.

    Raises:
        UserError: The record cannot be written, as on a full disk.
    """
    before = stored_order(before)
    facts = UpdateRecord.of(report)
    head = json.dumps([dataclasses.asdict(facts), checksum(before), checksum(after)])
    content = base64.b85encode(difference(before, after)).decode()
    new = NewResources(seed=after.missions.id.tobytes())
    row = new.add(_TEXT, f"{_MARK}\n{head}\n{content}\n".encode())
    newest = int(np.argmax(_begins(after)))
    return new.attached(after, [row], [newest], ResourceOwner.MISSION)


def on_newest_mission(vi_map: VIMap) -> VIMap:
    """Return the map with the texts of its missions on the newest mission, which an update keeps."""
    table = vi_map.resources
    rows = _texts(vi_map)
    owner = table.owner.copy()
    owner[rows] = int(np.argmax(_begins(vi_map)))
    return vi_map.replace(resources=table.replace(owner=owner)) if len(rows) else vi_map


def records(vi_map: VIMap, map_folder: Path | None) -> list[Record]:
    """Return the updates of a map in the order in which they were made; other texts are skipped.

    Raises:
        MapError: A record is missing or damaged.
    """
    result = []
    for row in _texts(vi_map).tolist():
        path = resource_path(vi_map, row, map_folder or Path())
        try:
            mark, _, rest = path.read_bytes().partition(b"\n")
            if mark != _MARK.encode():
                continue
            head, content = rest.decode().splitlines()
            facts, before, after = json.loads(head)
            record = UpdateRecord(**facts)
            datetime.fromisoformat(record.date)
            result.append(Record(record, str(before), str(after), base64.b85decode(content)))
        except OSError as error:
            raise MapError(f"{path}: the record cannot be read ({error.strerror})") from None
        except (ValueError, TypeError, RecursionError):
            raise MapError(f"{path}: the record of an update is damaged") from None
    return result


def map_before(vi_map: VIMap, record: Record) -> VIMap:
    """Return the map as it was before an update.

    Raises:
        MapError: It is not the map after that update, or the record is damaged.
    """
    vi_map = stored_order(vi_map)
    when = record.facts.date
    if checksum(vi_map) != record.after:
        raise MapError(
            f"other commands changed the map after the update of {when}: its state before cannot be "
            "made again; map_log still tells what the update did"
        )
    try:
        result = restored(vi_map, record.differences)
    except _DAMAGES:
        raise MapError(f"the record of the update of {when} is damaged") from None
    if checksum(result) != record.before:
        raise MapError(f"the record of the update of {when} is damaged")
    return result


def difference(before: VIMap, after: VIMap) -> bytes:
    """Return what leads from the map after an update back to that before it."""
    head: dict[str, Any] = {"sensors": write_sensors(before.sensors), "columns": []}
    arrays: list[bytes] = []
    for table, name, column in _columns(before):
        rows, rest = _as_rows_of(column, _table(after, table).columns()[name])
        values = _plain(rest) if rest.dtype == object else [rest.dtype.str, list(rest.shape)]
        head["columns"].append([table, name, len(rows), values])
        arrays.append(np.diff(rows, prepend=0).astype("<i4").tobytes())
        if rest.dtype != object:
            arrays.append(rest.tobytes())
    text = json.dumps(head).encode()
    return PACKED + zlib.compress(b"".join([len(text).to_bytes(4, "little"), text, *arrays]), 9)


def restored(after: VIMap, content: bytes) -> VIMap:
    """Return the map before an update from that after it and their difference.

    Raises:
        ValueError: The difference is damaged.
    """
    plain = bytes(unpacked(content))
    place = 4 + int.from_bytes(plain[:4], "little")
    head = json.loads(plain[4:place])
    columns: dict[str, dict[str, NDArray[Any]]] = {}
    for table, name, count, values in head["columns"]:
        rows = np.cumsum(np.frombuffer(plain, "<i4", count, place), dtype=np.int64)
        place += 4 * count
        other = _table(after, table).columns()[name]
        if other.dtype == object:
            rest = _objects(name, values)
        else:
            dtype, shape = np.dtype(values[0]), tuple(values[1])
            size = int(np.prod(shape, dtype=np.int64))
            rest = np.frombuffer(plain, dtype, size, place).reshape(shape)
            place += rest.nbytes
        columns.setdefault(table, {})[name] = _of_rows(rows, other, rest)
    tables = {table: type(getattr(after, table))(**values) for table, values in columns.items()}
    known = IdIndex(after.resources.id).rows(tables["resources"].columns()["id"])
    folder = np.append(after.resources.folder, MAP_FOLDER)[known]  # others are in the map's folder
    tables["resources"] = tables["resources"].replace(folder=folder)
    return after.replace(sensors=parse_sensors(head["sensors"], "record"), **tables)


def checksum(vi_map: VIMap) -> str:
    """Return a checksum of the tables but for the resources and the names of missions."""
    digest = hashlib.blake2b(digest_size=12)
    for table, name, column in _columns(vi_map):
        if table == "resources" or name == "name":
            continue
        is_plain = column.dtype != object
        content = column.tobytes() if is_plain else json.dumps(_plain(column)).encode()
        digest.update(b"%d:%d;" % (len(column), len(content)) + content)
    return digest.hexdigest()


def _columns(vi_map: VIMap) -> Iterator[tuple[str, str, NDArray[Any]]]:
    for field in dataclasses.fields(vi_map):
        table = getattr(vi_map, field.name)
        if isinstance(table, Table):
            for name, column in table.columns().items():
                yield field.name, name, column


def _table(vi_map: VIMap, name: str) -> Table:
    """Return a table; resources in an order that neither files nor further records change."""
    table: Table = getattr(vi_map, name)
    if table is not vi_map.resources:
        return table
    resources, is_text = vi_map.resources, np.zeros(len(table), dtype=np.bool_)
    is_text[_texts(vi_map)] = True
    keys = (resources.timestamp_ns, *resources.sensor_id.T, *resources.id.T)
    order = np.lexsort((*(np.where(is_text, 0, key) for key in keys), is_text))
    return resources.take(order)


def _as_rows_of(column: NDArray[Any], other: NDArray[Any]) -> tuple[I64, NDArray[Any]]:
    """Return the rows (N,) of another column with equal content, or -1 and such rows in their order."""
    none = np.full(len(column), -1, dtype=np.int64)
    if column.dtype == object:
        place = {value: row for row, value in reversed(list(enumerate(other.tolist())))}
        rows = np.array([place.get(value, -1) for value in column.tolist()], dtype=np.int64)
        return rows, column[rows < 0]
    if column.shape[1:] != other.shape[1:] or column[:1].nbytes <= 4 or len(other) == 0:
        return none, column  # small numbers pack better as they are
    keys, first = np.unique(_hashes(other), return_index=True)
    mine = _hashes(column)
    nearest = np.minimum(np.searchsorted(keys, mine), len(keys) - 1)
    rows = np.where(keys[nearest] == mine, first[nearest], -1)
    same = _words(other[rows]) == _words(column)
    rows[~same.all(axis=1)] = -1
    return rows, column[rows < 0]


def _of_rows(rows: I64, other: NDArray[Any], rest: NDArray[Any]) -> NDArray[Any]:
    missing = rows < 0
    if missing.all():
        return rest
    if np.count_nonzero(missing) != len(rest):
        raise ValueError("the numbers of rows differ")
    result = other[rows]
    result[missing] = rest
    return result


def _words(column: NDArray[Any]) -> NDArray[np.uint64]:
    """Return the rows as 64-bit words (N, words), padded with zeros."""
    content = np.ascontiguousarray(column).view(np.uint8).reshape(len(column), -1)
    padded = np.pad(content, ((0, 0), (0, -content.shape[1] % 8)))
    return padded.view(np.uint64)


def _hashes(column: NDArray[Any]) -> NDArray[np.uint64]:
    result = np.zeros(len(column), dtype=np.uint64)
    for word in _words(column).T:
        result = (result ^ word) * _MULTIPLIER
        result ^= result >> np.uint64(29)
    return result


def _plain(values: NDArray[Any]) -> list[Any]:
    """Return the objects of a column as JSON types."""
    return [value.hex() if isinstance(value, bytes) else value for value in values.tolist()]


def _objects(name: str, values: list[Any]) -> NDArray[Any]:
    if name == "unknown":
        return object_column([bytes.fromhex(value) for value in values])
    if name == "descriptor_blocks":
        return object_column(
            [None if v is None else tuple(DescriptorBlock(*block) for block in v) for v in values]
        )
    return object_column([str(value) for value in values])


def _texts(vi_map: VIMap) -> I64:
    table = vi_map.resources
    return np.flatnonzero((table.type == _TEXT) & (table.owner_kind == ResourceOwner.MISSION))


def _begins(vi_map: VIMap) -> I64:
    rows = np.minimum(vi_map.vertex_start[:-1], max(len(vi_map.vertices) - 1, 0))
    return np.asarray(vi_map.vertices.timestamp_ns[rows])
