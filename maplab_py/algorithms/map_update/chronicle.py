"""Chronicle of a map: a report of each update, and the differences that restore earlier maps.

A record is a text among the resources of the newest mission: reports of updates, and the columns of the map
before them as differences from those after. Rows that both maps have are stored as row numbers. A map keeps
a limited number of differences: beyond it two neighbours are merged, which restores the map before both.
"""

import base64
import dataclasses
import hashlib
import itertools
import json
import zlib
from collections.abc import Callable, Iterator
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
from maplab_py.vimap import IdIndex, ResourceOwner, VIMap, edits, to_hex_list, without_resources
from maplab_py.vimap.descriptors import DescriptorBlock
from maplab_py.vimap.table import Table, object_column
from maplab_py.vimap.tables import Resources

_MARK = "maplab-py update 3"
"""First line of a record; its facts and its differences follow."""
_DECODERS: dict[str, Callable[[str], bytes]] = {
    _MARK: base64.b64decode,
    "maplab-py update 2": base64.b85decode,
}
"""By the first line; base 85 is a tenth smaller, but Python takes 0.3 s for a megabyte."""
_STATES, _RECENT = 12, 4
"""Earlier states that a map leads back to, and how many of the newest stay one by one."""
_DAMAGES = (
    ValueError, TypeError, LookupError, AttributeError, ArithmeticError, RecursionError,
    SyntaxError,  # of a dtype
)  # fmt: skip
_MULTIPLIER = np.uint64(0x9E3779B97F4A7C15)


@dataclasses.dataclass(frozen=True)
class Record:
    """Updates of a map, of which the oldest is the first."""

    number: int  # in the order in which records were made
    facts: tuple[UpdateRecord, ...]
    before: str  # checksums of the maps
    after: str
    differences: bytes  # empty where they lead nowhere any more

    def content(self) -> bytes:
        """Return the text of the record."""
        facts = [dataclasses.asdict(fact) for fact in self.facts]
        head = json.dumps([self.number, facts, self.before, self.after])
        return f"{_MARK}\n{head}\n{base64.b64encode(self.differences).decode()}\n".encode()


def stored_order(vi_map: VIMap) -> VIMap:
    """Return the map with its landmarks in the order in which they are loaded again."""
    order = np.argsort(vi_map.landmarks.vertex, kind="stable")
    row = np.append(np.argsort(order), -1).astype(np.int32)
    keypoints = vi_map.keypoints.replace(landmark=row[vi_map.keypoints.landmark])
    return vi_map.replace(landmarks=vi_map.landmarks.take(order), keypoints=keypoints)


def with_record(
    before: VIMap, after: VIMap, report: MapUpdateReport, map_folder: Path | None = None
) -> VIMap:
    """Return the updated map, whose landmarks are in stored order, with a record of the update.

    Args:
        before: The map before the update.
        after: The map after it.
        report: Of the update.
        map_folder: Folder of the map, whose records are read; those that are damaged stay as they are.

    Raises:
        UserError: The record cannot be written, as on a full disk.
    """
    before = stored_order(before)
    known = _records(after, map_folder, skip_damaged=True)
    came_with = IdIndex(before.resources.id).rows(after.resources.id) < 0  # the session
    mine = [record for record, row in known if not came_with[row]]
    number = max((record.number for record in mine), default=0) + 1
    facts, states = UpdateRecord.of(report), (checksum(before), checksum(after))
    new = Record(number, (facts,), *states, difference(before, after))
    chain = _chain(mine, new.before)
    try:
        merged = _merged(chain, before) if len(chain) + 1 > _STATES else ()
    except MapError:  # older states cannot be made again
        merged, chain = (), chain[:_RECENT]
    written, removed = [], np.zeros(len(after.resources), dtype=np.bool_)
    for record, row in known:
        lasting: Record | None = record
        if came_with[row]:
            lasting = dataclasses.replace(record, number=number, after="", differences=b"")
        elif merged and record in merged[1:]:
            lasting = merged[0] if record is merged[1] else None
        elif record not in chain:
            lasting = dataclasses.replace(record, differences=b"")
        if lasting != record:
            removed[row] = True
            written += [] if lasting is None else [lasting]
    texts = NewResources(seed=after.missions.id.tobytes())
    rows = [texts.add(edits.TEXT_RESOURCE, record.content()) for record in (*written, new)]
    owner = edits.newest_mission(after, np.ones(len(after.missions), dtype=np.bool_))
    kept = without_resources(after, removed)
    return texts.attached(kept, rows, [owner] * len(rows), ResourceOwner.MISSION)


def _chain(known: list[Record], state: str) -> list[Record]:
    """Return the records that lead back from a state (checksum) one after the other, the newest first."""
    chain = []
    for record in known[::-1]:
        if record.after == state and record.differences:
            chain.append(record)
            state = record.before
    return chain


def _merged(chain: list[Record], latest: VIMap) -> tuple[Record, Record, Record]:
    """Return two neighbours of a chain that leads back from a map as one, the later and the earlier.

    They are those of the fewest updates among all but the newest, the oldest first.
    """
    updates = [len(a.facts) + len(b.facts) for a, b in itertools.pairwise(chain)]
    place = min(range(_RECENT, len(updates)), key=lambda row: (updates[row], -row))
    for record in chain[:place]:
        latest = map_before(latest, record)
    later, earlier = chain[place : place + 2]
    content = difference(map_before(map_before(latest, later), earlier), latest)
    facts = (*earlier.facts, *later.facts)
    both = Record(later.number, facts, earlier.before, later.after, content)
    return both, later, earlier


def records(vi_map: VIMap, map_folder: Path | None) -> list[Record]:
    """Return the updates of a map in the order in which they were made; other texts are skipped.

    Raises:
        MapError: A record is missing or damaged.
    """
    return [record for record, _ in _records(vi_map, map_folder)]


def _records(
    vi_map: VIMap, map_folder: Path | None, *, skip_damaged: bool = False
) -> list[tuple[Record, int]]:
    """Return the records and the resources (rows) that hold them."""
    result = []
    for row in edits.texts_of_missions(vi_map).tolist():
        try:
            record = _read(resource_path(vi_map, row, map_folder or Path()))
        except MapError:
            if not skip_damaged:
                raise
            continue
        if record is not None:
            result.append((record, row))
    return sorted(result, key=lambda item: item[0].number)


def _read(path: Path) -> Record | None:
    """Return the record in a file; None if it holds another text."""
    try:
        mark, _, rest = path.read_bytes().partition(b"\n")
        decode = _DECODERS.get(mark.decode(errors="replace"))
        if decode is None:
            return None
        head, content = (rest.decode() + "\n").split("\n")[:2]
        number, facts, before, after = json.loads(head)
        updates = tuple(UpdateRecord(**fact) for fact in facts)
        if not updates:
            raise ValueError
        for update in updates:
            datetime.fromisoformat(update.date)
        return Record(int(number), updates, str(before), str(after), decode(content))
    except OSError as error:
        raise MapError(f"{path}: the record cannot be read ({error.strerror})") from None
    except (ValueError, TypeError, RecursionError):
        raise MapError(f"{path}: the record of an update is damaged") from None


def map_at(vi_map: VIMap, map_folder: Path | None, end: str) -> tuple[VIMap, UpdateRecord | None]:
    """Return the map as it was before its first update with a session after a time, and that update.

    Args:
        map_folder: Its folder.
        end: The time, as in the dates of updates. None of them is after it: the map stays.

    Raises:
        MapError: Other commands changed the map since, or a record is damaged.
    """
    mine = [(record, row) for record, row in _records(vi_map, map_folder) if record.after]
    result, first = vi_map, None
    while any(fact.date >= end for record, _ in mine for fact in record.facts):
        record, _ = mine.pop()
        result, first = map_before(result, record), record.facts[0]
    if first is None:
        return vi_map, None
    rows = [row for _, row in mine]
    texts = vi_map.resources.take(np.array(rows, dtype=np.int64))
    owner = edits.newest_mission(result, np.ones(len(result.missions), dtype=np.bool_))
    texts = texts.replace(owner=np.full(len(texts), owner))
    is_new = IdIndex(result.resources.id).rows(texts.id) < 0
    joined = Resources.concatenate([result.resources, texts.take(is_new)])
    return result.replace(resources=joined), first


def map_before(vi_map: VIMap, record: Record) -> VIMap:
    """Return the map as it was before an update.

    Raises:
        MapError: It is not the map after that update, or the record is damaged.
    """
    vi_map = stored_order(vi_map)
    when = record.facts[-1].date
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
    """Return the differences that restore the map before an update."""
    texts = to_hex_list(before.resources.id[edits.texts_of_missions(before)])
    sensors = write_sensors(before.sensors)
    head: dict[str, Any] = {"sensors": sensors, "texts": texts, "columns": []}
    arrays: list[bytes] = []
    before, after = _without_texts(before), _without_texts(after)
    for table, name, column in _columns(before):
        rows, rest = _as_rows_of(column, getattr(after, table).columns()[name])
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
    plain_map = _without_texts(after)
    for table, name, count, values in head["columns"]:
        rows = np.cumsum(np.frombuffer(plain, "<i4", count, place), dtype=np.int64)
        place += 4 * count
        other = getattr(plain_map, table).columns()[name]
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
    texts = after.resources.take(edits.texts_of_missions(after))
    texts = texts.take(np.isin(to_hex_list(texts.id), head["texts"]))
    tables["resources"] = Resources.concatenate([tables["resources"].replace(folder=folder), texts])
    result = after.replace(sensors=parse_sensors(head["sensors"], "record"), **tables)
    return edits.with_texts_on_newest(result, np.ones(len(result.missions), dtype=np.bool_))


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


def _without_texts(vi_map: VIMap) -> VIMap:
    """Return the map without texts; its resources in an order that files do not change."""
    table = vi_map.resources
    table = table.take(np.setdiff1d(np.arange(len(table)), edits.texts_of_missions(vi_map)))
    order = np.lexsort((table.timestamp_ns, *table.sensor_id.T, *table.id.T))
    return vi_map.replace(resources=table.take(order))


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
