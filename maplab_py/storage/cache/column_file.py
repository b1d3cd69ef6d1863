"""A file with all columns of a map, to be mapped into memory.

A line of text, the size and the CRC-32 of a header, the header (JSON), and the numbers of every column
at a multiple of 4096 bytes. The header says what the map's files were, and for every column its place,
type, shape and CRC-32. The file's time of change is in the header, too, so that a file that another program
has written to is told from one that has not been touched.

Descriptors, which are the larger half of a map, are not read to be checked: their CRC-32 is that of samples.
"""

import dataclasses
import json
import math
import mmap
import os
import struct
import time
import zlib
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maplab_py.atomic import replaced_file
from maplab_py.cancellation import check_cancelled
from maplab_py.storage.checksums import map_in_threads
from maplab_py.vimap import DescriptorBlock, Missions, VIMap
from maplab_py.vimap.table import Table, object_column, ragged_rows, starts_of_counts

_MAGIC = b"maplab-py columns 1\n"
_SIZES = struct.Struct("<QI")
_PAGE = 4096
_MAX_HEADER = 1 << 22
_SAMPLES = 64
_ON_DISK = {"keypoints.descriptor"}
"""Columns that are read when a command needs them, not when the map is loaded."""
_SIDE_FILE = {(Missions, "name")}
"""Columns that come from a side file of the map."""


class UnusableColumns(Exception):
    """The file is damaged, of another version or of another map; the text says what is wrong."""


@dataclasses.dataclass(frozen=True)
class _Place:
    """Place of a column in the file."""

    name: str
    dtype: str
    shape: tuple[int, ...]
    offset: int
    crc: int

    @property
    def size(self) -> int:
        """Bytes of the column."""
        return int(np.dtype(self.dtype).itemsize * math.prod(self.shape))


def write_columns(path: Path, vi_map: VIMap, facts: Mapping[str, Any]) -> None:
    """Write the tables of a map and what the header shall say beside.

    Raises:
        UserError: The file cannot be written.
        Cancelled: The user has asked to stop.
    """
    columns = {name: np.ascontiguousarray(values) for name, values in _numbers(vi_map)}
    offset, places = 0, []
    for (name, values), crc in zip(columns.items(), _checksums(columns), strict=True):
        places.append(_Place(name, values.dtype.str, values.shape, offset, crc))
        offset += _whole_pages(values.nbytes)
    written_ns = time.time_ns()
    header = {
        "facts": dict(facts),
        "written_ns": written_ns,
        "size": offset,
        "columns": [dataclasses.astuple(place) for place in places],
    }
    text = json.dumps(header).encode()
    start = _MAGIC + _SIZES.pack(len(text), zlib.crc32(text)) + text
    with replaced_file(path, durable=False) as stream:
        stream.write(start.ljust(_whole_pages(len(start)), b"\0"))
        for values in columns.values():
            check_cancelled()
            stream.write(values.reshape(-1).view(np.uint8).data)
            stream.write(bytes(_whole_pages(values.nbytes) - values.nbytes))
        stream.flush()
        os.utime(stream.fileno(), ns=(written_ns, written_ns))


def read_columns(path: Path, facts: Mapping[str, Any]) -> tuple[VIMap, dict[str, Any]]:
    """Map a file into memory; return the map's tables and all facts of the header.

    The file may be replaced or deleted while it is mapped: the map keeps what it has.

    Raises:
        UnusableColumns: The file is not what `write_columns` has written for these facts.
        OSError: It cannot be read.
    """
    try:
        header, data = _opened(path)
        written_for = dict(header["facts"])
        differing = [name for name, value in facts.items() if written_for.get(name) != value]
        if differing:
            raise UnusableColumns(f"it was written for another {differing[0]}")
        places = [_Place(n, d, tuple(s), o, c) for n, d, s, o, c in header["columns"]]
        columns = {place.name: _column(data, place) for place in places}
        wrong = [
            place.name
            for place, crc in zip(places, _checksums(columns), strict=True)
            if crc != place.crc
        ]
        if wrong:
            raise UnusableColumns(f"{wrong[0]} does not have its checksum")
        return _map_of(columns), written_for
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
        raise UnusableColumns(f"its columns do not make a map ({error})") from error


def mapped_bytes(array: NDArray[Any]) -> int:
    """Return the bytes of an array that lie in a file that is mapped into memory."""
    owner: Any = array
    while isinstance(owner, np.ndarray):
        owner = owner.base
    if isinstance(owner, memoryview):
        owner = owner.obj
    return array.nbytes if isinstance(owner, mmap.mmap) else 0


def _opened(path: Path) -> tuple[dict[str, Any], NDArray[np.uint8]]:
    """Return the checked header, and the bytes of all columns."""
    with path.open("rb") as stream:
        status = os.fstat(stream.fileno())
        start = stream.read(len(_MAGIC) + _SIZES.size)
        if not start.startswith(_MAGIC) or len(start) < len(_MAGIC) + _SIZES.size:
            raise UnusableColumns("it is not a file of columns of this version")
        length, crc = _SIZES.unpack_from(start, len(_MAGIC))
        text = stream.read(min(length, _MAX_HEADER))
        if len(text) != length or zlib.crc32(text) != crc:
            raise UnusableColumns("its header is damaged")
        header = json.loads(text)
        first = _whole_pages(len(start) + length)
        if status.st_size != first + header["size"]:
            raise UnusableColumns("it is truncated")
        if status.st_mtime_ns != header["written_ns"]:
            raise UnusableColumns("another program has written to it")
        if not header["size"]:
            return header, np.zeros(0, dtype=np.uint8)
        mapped = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
    return header, np.frombuffer(mapped, dtype=np.uint8)[first:]


def _column(data: NDArray[np.uint8], place: _Place) -> NDArray[Any]:
    if not 0 <= place.offset <= place.offset + place.size <= len(data):
        raise UnusableColumns(f"{place.name} lies outside of it")
    numbers = data[place.offset : place.offset + place.size]
    return numbers.view(place.dtype).reshape(place.shape)


def _whole_pages(size: int) -> int:
    return -(-size // _PAGE) * _PAGE


def _tables(vi_map: VIMap) -> Iterator[tuple[str, Table]]:
    for field in dataclasses.fields(vi_map):
        table = getattr(vi_map, field.name)
        if isinstance(table, Table):
            yield field.name, table


def _numbers(vi_map: VIMap) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield all columns of numbers by name; columns of objects have three each."""
    for table_name, table in _tables(vi_map):
        for name, values in table.columns().items():
            full_name = f"{table_name}.{name}"
            if (type(table), name) in _SIDE_FILE:
                continue
            if values.dtype != object:
                yield full_name, values
                continue
            for part, numbers in encoded(values.tolist()).items():
                yield f"{full_name}.{part}", numbers


def _map_of(columns: Mapping[str, NDArray[Any]]) -> VIMap:
    """Return the map with tables of the columns.

    Raises:
        KeyError: A column is missing.
        ValueError: Columns do not fit each other.
    """
    left = dict(columns)
    tables: dict[str, Any] = {}
    for table_name, table in _tables(VIMap()):
        values = {}
        for name, empty in table.columns().items():
            full_name = f"{table_name}.{name}"
            if (type(table), name) in _SIDE_FILE:
                continue
            if empty.dtype == object:
                parts = {
                    part: left.pop(f"{full_name}.{part}") for part in ("index", "length", "items")
                }
                values[name] = decoded(parts)
                continue
            values[name] = left.pop(full_name)
            if values[name].dtype != empty.dtype:
                raise ValueError(f"{full_name} holds {values[name].dtype}")
        length = len(next(iter(values.values())))
        tables[table_name] = type(table).filled(length, **values)
    if left:
        raise ValueError(f"{next(iter(left))} is no column")
    return VIMap(**tables)


def _checksums(columns: Mapping[str, NDArray[Any]]) -> list[int]:
    """Return the CRC-32 of every column, of those that stay on disk that of samples."""
    return map_in_threads(_checksum, columns, columns.values())


def _checksum(name: str, values: NDArray[Any]) -> int:
    flat = values.reshape(-1).view(np.uint8)
    if name not in _ON_DISK or len(flat) <= _SAMPLES * _PAGE:
        return zlib.crc32(flat.data)
    crc = 0
    for first in np.linspace(0, len(flat) - _PAGE, _SAMPLES).astype(np.int64):
        crc = zlib.crc32(flat[first : first + _PAGE].data, crc)
    return crc


# Columns of Python objects as columns of numbers: distinct values, and which of them each row has.
#
# Two kinds of objects are known: bytes (unknown fields) and descriptor blocks of frames.


_NONE = -1
"""Length of the value None."""
_BLOCK_WIDTH = len(DescriptorBlock._fields)

Parts = dict[str, NDArray[Any]]
"""`index` (N,) into D distinct values, `length` (D,) of each, and `items` of all of them."""


def encoded(values: Sequence[Any]) -> Parts:
    """Return the parts of a column (N,) of bytes, or of tuples of descriptor blocks or None."""
    place = {value: at for at, value in enumerate(dict.fromkeys(values))}
    items: NDArray[Any]
    index = np.fromiter(map(place.__getitem__, values), np.int32, len(values))
    length = [_NONE if value is None else len(value) for value in place]
    if all(isinstance(value, bytes) for value in place):
        items = np.frombuffer(b"".join(place), dtype=np.uint8)
    else:
        blocks = [tuple(block) for value in place for block in value or ()]
        items = np.array(blocks, dtype=np.int64).reshape(-1, _BLOCK_WIDTH)
    return {"index": index, "length": np.array(length, dtype=np.int64), "items": items}


def decoded(parts: Mapping[str, NDArray[Any]]) -> NDArray[Any]:
    """Return the column (N,).

    Raises:
        ValueError: The parts do not fit each other.
    """
    index, length, items = parts["index"], parts["length"], parts["items"]
    count = np.maximum(length, 0)
    start = starts_of_counts(count)
    if int(start[-1]) != len(items) or (
        len(index) and not 0 <= index.min() <= index.max() < len(length)
    ):
        raise ValueError("the values of a column of objects do not fit their lengths")
    if items.ndim == 1:
        data = items.tobytes()
        values: list[Any] = [data[a:b] for a, b in pairwise(start)]
    else:
        blocks = [
            DescriptorBlock(*row)
            for row in items[ragged_rows(start, np.arange(len(count)))].tolist()
        ]
        values = [
            None if size == _NONE else tuple(blocks[first : first + size])
            for first, size in zip(start[:-1].tolist(), length.tolist(), strict=True)
        ]
    return np.asarray(object_column(values)[index])
