"""Nearest descriptors of a database, by an inverted multi-index."""

import dataclasses
from typing import NamedTuple

import numpy as np

from maplab_py.array_types import F32, I8, I32, I64, U64, Rows
from maplab_py.vision.descriptors import DescriptorKind
from maplab_py.vision.kmeans import kmeans, nearest_centre
from maplab_py.vision.projection import learn_projection
from maplab_py.vision.search_kernels import Cells, search_cells


class DescriptorColumns(NamedTuple):
    """Descriptors as the compiled searches take them, see `DescriptorSet`."""

    words: U64 | I8  # (N, W)
    label: I64  # (N,)
    session: I32  # (N,)
    time_ns: I64  # (N,)


class DescriptorSet(Rows):
    """Descriptors with the labels, sessions and times that restrict matches."""

    projected: F32  # (N, dimensions)
    words: U64 | I8  # (N, W), packed bits, or signed bytes of descriptors that are not binary
    label: I64  # (N,) landmark; a match of equal non-negative labels is not reported
    session: I32  # (N,) mission
    time_ns: I64  # (N,)

    @property
    def columns(self) -> DescriptorColumns:
        """Bits, and what restricts matches."""
        return DescriptorColumns(self.words, self.label, self.session, self.time_ns)


class MatchRule(NamedTuple):
    """Restriction of the database descriptors that a query may match."""

    min_time_ns: int = 0  # within a session, matches closer in time are left out
    other_sessions_only: bool = False


@dataclasses.dataclass(frozen=True, eq=False)
class Neighbours:
    """The k nearest neighbours of every query in ascending order, one per label."""

    row: I32  # (Q, k), -1 where there are fewer than k
    distance: F32  # (Q, k) as `differences`, or squared in the projected space; inf where none


_SHORT = DescriptorKind(8)
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
            rank_by_bits: Compare descriptors inside the cells by Hamming distance, which is more
                discriminative; else by squared distance in the projected space.
            max_distance: Maximum distance of neighbours; a bound saves time.
        """
        points = database.projected
        # dimensions are sorted by variance: give each half every other dimension
        halves = np.ascontiguousarray(points[:, 0::2]), np.ascontiguousarray(points[:, 1::2])
        words = round(np.sqrt(len(points) / _DESCRIPTORS_PER_CELL))
        words = int(np.clip(words, _MIN_WORDS, _MAX_WORDS))
        words = max(min(words, len(points)), 1)
        self._centres = tuple(kmeans(half, words, seed=seed + i) for i, half in enumerate(halves))
        self._cells_per_query = cells_per_query
        self._rank_by_bits = rank_by_bits
        # the kernel wants less than a bound
        self._bound = np.nextafter(np.float32(max_distance), np.float32(np.inf))
        first, second = (
            nearest_centre(half, centre) for half, centre in zip(halves, self._centres, strict=True)
        )
        cell = first.astype(np.int64) * len(self._centres[1]) + second
        self._rows = np.argsort(cell, kind="stable")
        cells = len(self._centres[0]) * len(self._centres[1])
        self._start = np.searchsorted(cell[self._rows], np.arange(cells + 1))
        self._sorted = database.take(self._rows)

    def nearest(self, queries: DescriptorSet, k: int, rule: MatchRule) -> Neighbours:
        """Return the nearest database descriptors that the rule allows, one per label."""
        row = np.full((len(queries), k), -1, dtype=np.int32)
        if len(self._rows) == 0:
            return Neighbours(row, np.full(row.shape, np.inf, dtype=np.float32))
        distance = np.full((len(queries), k), self._bound, dtype=np.float32)
        first, second = self._centres
        cells = Cells(first, second, self._start, self._cells_per_query, self._rank_by_bits)
        database = self._sorted
        search_cells(
            queries.projected, queries.columns, cells, database.projected, database.columns,
            rule, row, distance,
        )  # fmt: skip
        valid = row >= 0
        row[valid] = self._rows[row[valid]]
        distance[~valid] = np.inf
        return Neighbours(row, distance)


def compile_kernels(kind: DescriptorKind = _SHORT) -> None:
    """Compile the projection and the search on random tracks.

    Args:
        kind: Descriptors of 8 bytes; bits and numbers have kernels of their own.
    """
    label = np.repeat(np.arange(60), 5)
    descriptors = np.random.default_rng(0).integers(0, 256, (60, 8), dtype=np.uint8)[label]
    database = DescriptorSet(
        projected=learn_projection(descriptors, label, kind=kind, dimensions=4).project(
            descriptors
        ),
        words=kind.comparable(descriptors),
        label=label,
        session=np.zeros(len(label), dtype=np.int32),
        time_ns=np.zeros(len(label), dtype=np.int64),
    )
    InvertedMultiIndex(database, cells_per_query=4).nearest(database, 2, MatchRule())
