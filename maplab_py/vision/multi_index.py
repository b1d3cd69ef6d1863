"""Inverted multi-index: descriptors in the cells of two small vocabularies.

Projected descriptors are split into two halves, each quantised with its own vocabulary; a cell is
a pair of words and lists the descriptors that fall into it. A query visits the cells nearest to
it (by the sum of both halves' distances) and compares exhaustively inside.
Source: Babenko and Lempitsky, The inverted multi-index, CVPR 2012.
"""

from __future__ import annotations

import copy

import numpy as np
from numpy.typing import NDArray

from maplab_py.vision.index import DescriptorSet, MatchRule, Neighbours
from maplab_py.vision.kmeans import kmeans, nearest_centre
from maplab_py.vision.search_kernels import search_cells

I64 = NDArray[np.int64]

_DESCRIPTORS_PER_CELL = 40
_MIN_WORDS, _MAX_WORDS = 4, 256


class InvertedMultiIndex:
    """Approximate nearest neighbours: exact inside the cells that are visited."""

    def __init__(
        self,
        database: DescriptorSet,
        *,
        seed: int = 0,
        cells_per_query: int = 24,
        rank_by_bits: bool = True,
        max_distance: float = np.inf,
    ) -> None:
        """Build the vocabularies and the cell lists.

        Args:
            database: What to search in.
            seed: Seed of the vocabularies.
            cells_per_query: Cells that a query visits.
            rank_by_bits: Compare descriptors inside the cells by Hamming distance, which tells
                more than the projection; else by squared distance in the projected space.
            max_distance: What differs by more is no neighbour; a bound saves time.
        """
        points = database.projected
        # dimensions come sorted by how much they tell: give each half every other one
        halves = np.ascontiguousarray(points[:, 0::2]), np.ascontiguousarray(points[:, 1::2])
        words = round(np.sqrt(len(points) / _DESCRIPTORS_PER_CELL))
        words = int(np.clip(words, _MIN_WORDS, _MAX_WORDS))
        words = max(min(words, len(points)), 1)
        self._centres = tuple(kmeans(half, words, seed=seed + i) for i, half in enumerate(halves))
        self._cells_per_query = cells_per_query
        self._rank_by_bits = rank_by_bits
        # the kernel wants less than a bound
        self._bound = np.nextafter(np.float32(max_distance), np.float32(np.inf))
        self._next = len(points)
        self._fill(database, np.arange(len(points)))

    def _fill(self, database: DescriptorSet, rows: I64) -> None:
        """Make the cell lists; `rows` are the numbers (N,) that the descriptors have in results."""
        first, second = (
            nearest_centre(np.ascontiguousarray(database.projected[:, half::2]), centre)
            for half, centre in enumerate(self._centres)
        )
        cell = first.astype(np.int64) * len(self._centres[1]) + second
        order = np.argsort(cell, kind="stable")
        cells = len(self._centres[0]) * len(self._centres[1])
        self._start = np.searchsorted(cell[order], np.arange(cells + 1))
        self._rows = rows[order]
        self._sorted = database.take(order)

    def added(self, more: DescriptorSet) -> InvertedMultiIndex:
        """Return an index that holds more descriptors; the vocabularies stay as they are."""
        index = copy.copy(self)
        index._next = self._next + len(more)
        rows = np.concatenate([self._rows, self._next + np.arange(len(more))])
        index._fill(DescriptorSet.concatenate(self._sorted, more), rows)
        return index

    def without_session(self, session: int) -> InvertedMultiIndex:
        """Return an index that holds no descriptor of a session any more."""
        index = copy.copy(self)
        kept = np.flatnonzero(self._sorted.session != session)
        index._fill(self._sorted.take(kept), self._rows[kept])
        return index

    def nearest(self, queries: DescriptorSet, k: int, rule: MatchRule) -> Neighbours:
        """Return the nearest database descriptors that the rule allows, one per label."""
        row = np.full((len(queries), k), -1, dtype=np.int32)
        if len(self._rows) == 0:
            return Neighbours(row, np.full(row.shape, np.inf, dtype=np.float32))
        distance = np.full((len(queries), k), self._bound, dtype=np.float32)
        d = self._sorted
        search_cells(
            queries.projected, queries.words, queries.label, queries.session, queries.time_ns,
            self._centres[0], self._centres[1], self._start,
            d.projected, d.words, d.label, d.session, d.time_ns,
            self._cells_per_query, self._rank_by_bits,
            rule.min_time_ns, rule.other_sessions_only, row, distance,
        )  # fmt: skip
        found = row >= 0
        row[found] = self._rows[row[found]]
        distance[~found] = np.inf
        return Neighbours(row, distance)
