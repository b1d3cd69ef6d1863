"""Digests of the measurements in the files of a map, kept from one save to the next.

Keypoints and IMU samples are most of a map and hardly ever change. Their columns in a file are parts of the
map's own columns: while such a part has the same bytes as in the map that was saved before, its digest is
the same, and a comparison of memory takes a tenth of the time of a hash.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
