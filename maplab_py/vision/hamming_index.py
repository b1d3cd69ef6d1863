"""Exhaustive search for the descriptors with the fewest different bits."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maplab_py.vision.index import DescriptorSet, MatchRule, Neighbours
from maplab_py.vision.search_kernels import search_all

I64 = NDArray[np.int64]


class HammingIndex:
    """Compares every query with every database descriptor: exact, and slow on large maps."""

    def __init__(self, database: DescriptorSet, rows: I64 | None = None) -> None:
        """Take the descriptors in.

        Args:
            database: What to search in.
            rows: Number (N,) that each one has in results; None = 0, 1, 2 and so on.
        """
        self._database = database
        self._rows = np.arange(len(database)) if rows is None else rows
        self._next = int(self._rows.max(initial=-1)) + 1

    def nearest(self, queries: DescriptorSet, k: int, rule: MatchRule) -> Neighbours:
        """Return the nearest database descriptors that the rule allows, one per label."""
        row = np.full((len(queries), k), -1, dtype=np.int32)
        distance = np.full((len(queries), k), np.inf, dtype=np.float32)
        d = self._database
        search_all(
            queries.words, queries.label, queries.session, queries.time_ns,
            d.words, d.label, d.session, d.time_ns,
            rule.min_time_ns, rule.other_sessions_only, row, distance,
        )  # fmt: skip
        found = row >= 0
        row[found] = self._rows[row[found]]
        return Neighbours(row, distance)

    def added(self, more: DescriptorSet) -> HammingIndex:
        """Return an index that holds more descriptors."""
        rows = np.concatenate([self._rows, self._next + np.arange(len(more))])
        return HammingIndex(DescriptorSet.concatenate(self._database, more), rows)

    def without_session(self, session: int) -> HammingIndex:
        """Return an index that holds no descriptor of a session any more."""
        kept = np.flatnonzero(self._database.session != session)
        index = HammingIndex(self._database.take(kept), self._rows[kept])
        index._next = self._next
        return index
