"""What a file of a map says: columns from which it is written, and which tell whether it has changed."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maplab_py.array_types import I64, U64
from maplab_py.storage.column_digests import DIGEST_BYTES, ColumnDigests, digest_of
from maplab_py.vimap.table import starts_of_counts

Columns = Mapping[str, NDArray[Any]]
"""All that a file says, by name. Other entities are named by their ids, never by their rows."""
Words = list[list[int]]


@dataclasses.dataclass(frozen=True, eq=False)
class FileContent:
    """A file of a map before it is written.

    Attributes:
        kind: Kind of its entities (proto value).
        name: Name of the file.
        columns: All that it says.
        to_bytes: Makes the bytes of the file of nothing but the columns.
        measurements: Names of the columns that are contiguous parts of the map's own and seldom change.
    """

    kind: int
    name: str
    columns: Columns
    to_bytes: Callable[[Columns], bytes]
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
    """Rows of a table grouped by the rows of another one.

    Attributes:
        order: The rows, group after group, in their order within a group.
        start: Offsets (groups + 1) into `order`.
    """

    order: I64
    start: I64

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
