"""128-bit ids: two uint64 words, printed as 32 lower-case hexadecimal digits, all zero = invalid."""

import uuid
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from maplab_py.errors import UserError

IdArray = NDArray[np.uint64]
"""Ids as an array (..., 2) of uint64: the first 16 hexadecimal digits, then the last 16."""

HEX_DIGITS = 32
_AT_ONCE = 1 << 20
"""Ids that are looked up at once: each takes 100 bytes meanwhile."""
SHORT_ID_DIGITS = 8
"""Digits of an id in tables."""


def to_hex(id_words: IdArray) -> str:
    """Format one id (2,) as 32 hexadecimal digits."""
    return f"{int(id_words[0]):016x}{int(id_words[1]):016x}"


def to_hex_list(ids: IdArray) -> list[str]:
    """Format ids (N, 2) as a list of N strings."""
    return [f"{high:016x}{low:016x}" for high, low in ids.reshape(-1, 2).tolist()]


def from_hex(text: str) -> IdArray:
    """Parse 32 hexadecimal digits to an id (2,).

    Raises:
        UserError: The text is not an id.
    """
    stripped = text.strip().lower()
    if len(stripped) != HEX_DIGITS or any(c not in "0123456789abcdef" for c in stripped):
        raise UserError(f"'{text}' is not an id: 32 hexadecimal digits are expected")
    return np.array([int(stripped[:16], 16), int(stripped[16:], 16)], dtype=np.uint64)


def is_valid(ids: IdArray) -> NDArray[np.bool_]:
    """Tell for ids (..., 2) which are not all zero."""
    return np.asarray(np.any(ids != 0, axis=-1))


def random_ids(count: int, rng: np.random.Generator | None = None) -> IdArray:
    """Draw `count` new ids; from the operating system's entropy unless a generator is given."""
    if rng is None:
        rng = np.random.default_rng(uuid.uuid4().int)
    return rng.integers(1, np.iinfo(np.uint64).max, size=(count, 2), dtype=np.uint64)


def as_keys(ids: IdArray) -> NDArray[np.void]:
    """View ids (N, 2) as N opaque 16-byte keys that sort, compare and go through np.unique."""
    contiguous = np.ascontiguousarray(ids, dtype=">u8")
    return contiguous.view("V16").reshape(-1)


class IdIndex:
    """Row look-up for a column of unique ids.

    Ids are mixed to 64 bits, which sort and search many times faster than pairs of words; a hit is
    then compared in full. Should two different ids of the column mix to the same number (about one
    chance in 10^10 for 50,000 ids), pairs of words are searched instead.
    """

    def __init__(self, ids: IdArray) -> None:
        """Index ids (N, 2)."""
        self._ids = ids
        mixed = _mixed(ids)
        self._order = np.argsort(mixed, kind="stable")
        self._sorted = mixed[self._order]
        self._is_unique = bool((self._sorted[1:] != self._sorted[:-1]).all())

    def rows(self, ids: IdArray) -> NDArray[np.int64]:
        """Return the row of every id (N, 2), -1 where it is not in the column."""
        if len(self._sorted) == 0 or len(ids) == 0:
            return np.full(len(ids), -1, dtype=np.int64)
        if not self._is_unique:
            return self._rows_by_words(ids)
        result = np.empty(len(ids), dtype=np.int64)
        for first in range(0, len(ids), _AT_ONCE):
            part = slice(first, first + _AT_ONCE)
            result[part] = self._rows(ids[part])
        return result

    def _rows(self, ids: IdArray) -> NDArray[np.int64]:
        place = np.searchsorted(self._sorted, _mixed(ids))
        row = self._order[np.minimum(place, len(self._order) - 1)]
        return np.where((self._ids[row] == ids).all(axis=1), row, -1).astype(np.int64)

    def _rows_by_words(self, ids: IdArray) -> NDArray[np.int64]:
        words, inverse = np.unique(np.concatenate([self._ids, ids]), axis=0, return_inverse=True)
        inverse = inverse.reshape(-1)
        row_of_word = np.full(len(words), -1, dtype=np.int64)
        row_of_word[inverse[: len(self._ids)]] = np.arange(len(self._ids))
        return np.asarray(row_of_word[inverse[len(self._ids) :]])


def _mixed(ids: IdArray) -> NDArray[np.uint64]:
    """Mix both words of ids (N, 2) to one (multiplications modulo 2^64, odd constants)."""
    high, low = np.asarray(ids[:, 0]), np.asarray(ids[:, 1])
    mixed = high * np.uint64(0x9E3779B97F4A7C15) + (low ^ (low >> np.uint64(29)))
    return np.asarray((mixed ^ (mixed >> np.uint64(32))) * np.uint64(0xD6E8FEB86659FD93))


def distinct_prefixes(ids: list[str]) -> list[str]:
    """Return the shortest prefixes, of four or more digits, of ids that no other id begins with."""
    ordered = sorted(ids)
    shared: dict[str, int] = dict.fromkeys(ids, 0)
    for first, second in pairwise(ordered):
        differs = (a != b for a, b in zip(first, second, strict=True))
        common = next((place for place, differ in enumerate(differs) if differ), len(first))
        shared[first] = max(shared[first], common)
        shared[second] = max(shared[second], common)
    return [id_[: max(4, shared[id_] + 1)] for id_ in ids]
