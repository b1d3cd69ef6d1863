"""Content of a file of a map: columns from which it is written, and which tell whether it has changed."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from maplab_py.array_types import I64, U64, NDArray
from maplab_py.vimap.table import starts_of_counts

Columns = Mapping[str, NDArray[Any]]
"""All that a file says, by name. Other entities are named by their ids, never by their rows."""
Words = list[list[int]]


@dataclasses.dataclass(frozen=True, eq=False)
class FileContent:
    """A file of a map before it is written."""

    kind: int  # kind of its entities (proto value)
    name: str  # name of the file
    columns: Columns  # all that it says
    to_bytes: Callable[[Columns], bytes]  # makes the bytes of the file of nothing but the columns
    # names of the columns that are contiguous parts of the map's own and seldom change
    measurements: tuple[str, ...] = ()

    def data(self) -> bytes:
        """Return the bytes of the file, not compressed."""
        return self.to_bytes(self.columns)

    def digest(self, measurements: ColumnDigests) -> bytes:
        """Return a hash of the columns: files of equal digests have equal bytes.

        Args:
            measurements: Knows the digests of measurements that are as they were at the last save.
        """
        others = [values for name, values in self.columns.items() if name not in self.measurements]
        key = str(self.kind).encode()
        if self.measurements:
            ids = next(iter(self.columns.values()))
            first = key + ids[:1].tobytes()
            key += measurements.of(first, [self.columns[name] for name in self.measurements])
        return hashlib.blake2b(key + digest_of(others), digest_size=DIGEST_BYTES).digest()


@dataclasses.dataclass(frozen=True, eq=False)
class Groups:
    """Rows of a table grouped by the rows of another one."""

    order: I64  # the rows, group after group, in their order within a group
    start: I64  # offsets (groups + 1) into `order`

    @classmethod
    def of(cls, keys: NDArray[Any], count: int) -> Groups:
        """Group rows by their keys (rows of the other table), negative ones left out."""
        order = np.argsort(keys, kind="stable")
        order = order[np.count_nonzero(keys < 0) :]
        return cls(order, starts_of_counts(np.bincount(keys[keys >= 0], minlength=count)))

    def members(self, groups: range) -> I64:
        """Return the rows of consecutive groups."""
        return self.order[self.start[groups.start] : self.start[groups.stop]]

    def counts(self, groups: range) -> I64:
        """Return the number of rows of each of consecutive groups."""
        return np.diff(self.start[groups.start : groups.stop + 1])


def words(ids: U64) -> Words:
    """Return the words of ids (N, 2) as the files have them."""
    return ids.byteswap().tolist()  # type: ignore[no-any-return]


def starts(counts: NDArray[Any]) -> list[int]:
    """Return offsets (N + 1) of counts (N,)."""
    return starts_of_counts(counts).tolist()  # type: ignore[no-any-return]


def merge_unknown(message: Any, unknown: bytes) -> None:
    """Add the fields that this program does not know."""
    if unknown:
        message.MergeFromString(unknown)


def extend_finite(field: Any, covariance: NDArray[np.float64]) -> None:
    """Write a covariance unless the map has none (NaN)."""
    if np.isfinite(covariance).all():
        field.extend(covariance.reshape(-1).tolist())


# Digests of the measurements in the files of a map, kept from one save to the next.
#
# Keypoints and IMU samples are most of a map and hardly ever change. Their columns in a file are parts of the
# map's own columns: while such a part has the same bytes as in the map that was saved before, its digest is
# the same, and a comparison of memory takes a tenth of the time of a hash.


DIGEST_BYTES = 16
_WORD = 8


class ColumnDigests:
    """The digests of one save; they hold the columns that they are of."""

    def __init__(self, before: ColumnDigests | None = None) -> None:
        """Start with those of the save before."""
        self._before = before._parts if before is not None else {}
        self._parts: dict[bytes, tuple[list[NDArray[Any]], bytes]] = {}

    def of(self, key: bytes, columns: Iterable[NDArray[Any]]) -> bytes:
        """Return the digest of contiguous columns.

        Args:
            key: Under which they are compared with those of the save before.
            columns: The columns; they must not be written to any more.
        """
        parts = list(columns)
        old, digest = self._before.get(key, ([], b""))
        if len(old) != len(parts) or not all(map(_are_same, old, parts)):
            digest = digest_of(parts)
        self._parts[key] = parts, digest
        return digest


def digest_of(columns: Iterable[NDArray[Any]]) -> bytes:
    """Return a hash of columns, with their types and shapes."""
    parts = list(columns)
    types = [(values.dtype.char, values.shape) for values in parts]
    contents = [
        _of_objects(values) if values.dtype == object else values.tobytes() for values in parts
    ]
    whole = b"".join((repr((types, [*map(len, contents)])).encode(), *contents))
    return hashlib.blake2b(whole, digest_size=DIGEST_BYTES).digest()


def _of_objects(values: NDArray[Any]) -> bytes:
    """Return bytes that tell a column of objects: the distinct ones, and which of them each row has."""
    place = {value: at for at, value in enumerate(dict.fromkeys(values.tolist()))}
    index = [place[value] for value in values] if len(place) > 1 else []
    return repr((list(place), index)).encode()


def _are_same(a: NDArray[Any], b: NDArray[Any]) -> bool:
    """Tell whether two contiguous columns have the same type, shape and bytes."""
    if a.dtype != b.dtype or a.shape != b.shape:
        return False
    return a.ctypes.data == b.ctypes.data or np.array_equal(_words(a), _words(b))


def _words(values: NDArray[Any]) -> NDArray[Any]:
    return values.reshape(-1).view(np.uint8 if values.nbytes % _WORD else np.uint64)
