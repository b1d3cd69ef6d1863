"""Results of descriptor searches, kept for the commands that repeat them.

`aam`, `relax` and `lc` change poses, base frames or landmarks one after the other, but search the same
descriptors for the same neighbours. A search is known by the digest of everything that its result
depends on, so a result is used again only for equal input, and using it changes no result.
"""

from __future__ import annotations

import hashlib
import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maplab_py.array_types import I32
from maplab_py.memory import available_bytes
from maplab_py.vision.index import DescriptorSet, MatchRule
from maplab_py.vision.index_engines import make_index

_MIN_BYTES, _SHARE = 64_000_000, 1.0 / 16.0
"""Memory of all results: a share of what is available, and no less than so much. A result has 12 bytes per
query and search, or per match of a map of many missions."""


class SearchMemory:
    """Results of the latest searches; threads may share it.

    Attributes:
        max_bytes: The oldest results are dropped where all together take more; None = a share of the
            memory that is available then.
    """

    def __init__(self, max_bytes: int | None = None) -> None:
        """Create an empty memory.

        Args:
            max_bytes: Memory of all results [bytes].
        """
        self.max_bytes = max_bytes
        self._lock = threading.Lock()
        self._rows: OrderedDict[bytes, I32] = OrderedDict()
        self._bytes = 0

    def __len__(self) -> int:
        return len(self._rows)

    def get(self, key: bytes) -> I32 | None:
        """Return the result of a search, None if it is not remembered."""
        with self._lock:
            if key not in self._rows:
                return None
            self._rows.move_to_end(key)
            return self._rows[key]

    def put(self, key: bytes, rows: I32) -> None:
        """Remember the result of a search, which becomes read-only."""
        rows.setflags(write=False)
        with self._lock:
            if key in self._rows:
                return
            self._rows[key] = rows
            self._bytes += rows.nbytes
            most = self.max_bytes
            if most is None:
                most = max(_MIN_BYTES, int(_SHARE * (available_bytes() + self._bytes)))
            while self._bytes > most:
                self._bytes -= self._rows.popitem(last=False)[1].nbytes


_memory = SearchMemory()


def nearest_rows(
    engine: str,
    database: DescriptorSet,
    queries: DescriptorSet,
    k: int,
    rules: Sequence[MatchRule],
    *,
    seed: int,
    words_per_query: int,
    max_difference: float = np.inf,
    memory: SearchMemory = _memory,
) -> list[I32]:
    """Return the rows (Q, k) of the nearest database descriptors, -1 for none, for each rule.

    The index is built only if one of the searches is not remembered.

    Args:
        engine: One of `vision.index_engines.INDEX_ENGINES`.
        database: What to search in.
        queries: What to search for (Q).
        k: Neighbours.
        rules: Which database descriptors a query may match.
        seed: Seed of the index.
        words_per_query: Cells of the multi-index that are searched per query.
        max_difference: Neighbours that differ by more are not wanted.
        memory: Where results are kept.
    """
    setting = f"{engine} {seed} {words_per_query} {k} {max_difference!r}"
    common = hashlib.blake2b(setting.encode(), digest_size=32)
    for descriptors in (database, queries):
        _add(common, descriptors)
    keys = [_key(common, rule) for rule in rules]
    results = [memory.get(key) for key in keys]
    if any(rows is None for rows in results):
        index = make_index(
            engine,
            database,
            seed=seed,
            words_per_query=words_per_query,
            max_difference=max_difference,
        )
        for number, (rule, key) in enumerate(zip(rules, keys, strict=True)):
            if results[number] is None:
                rows = index.nearest(queries, k, rule).row
                memory.put(key, rows)
                results[number] = rows
    return [rows for rows in results if rows is not None]


def remembered(
    descriptors: DescriptorSet,
    columns: Sequence[NDArray[Any]],
    setting: str,
    search: Callable[[], I32],
    memory: SearchMemory = _memory,
) -> I32:
    """Return the result of a search over descriptors, from memory where nothing has changed.

    Args:
        descriptors: What is searched for and in.
        columns: What else the result depends on.
        setting: Its parameters.
        search: The search.
        memory: Where results are kept.
    """
    digest = hashlib.blake2b(setting.encode(), digest_size=32)
    _add(digest, descriptors)
    for column in columns:
        _add_column(digest, column)
    key = digest.digest()
    result = memory.get(key)
    if result is None:
        result = search()
        memory.put(key, result)
    return result


def _add(digest: hashlib.blake2b, descriptors: DescriptorSet) -> None:
    """Add all columns."""
    for column in (descriptors.projected, *descriptors.columns):
        _add_column(digest, column)


def _add_column(digest: hashlib.blake2b, column: NDArray[Any]) -> None:
    """Add an array with its type and shape."""
    digest.update(f"{column.dtype} {column.shape}".encode())
    digest.update(np.ascontiguousarray(column).data)


def _key(common: hashlib.blake2b, rule: MatchRule) -> bytes:
    digest = common.copy()
    digest.update(repr(rule).encode())
    return digest.digest()
