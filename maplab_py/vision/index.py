"""Nearest descriptors of a database: what an index offers, and which ones there are."""

from __future__ import annotations

import dataclasses
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
U64 = NDArray[np.uint64]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]

INDEX_ENGINES = ("imi", "kd", "hamming")


@dataclasses.dataclass(frozen=True, eq=False)
class DescriptorSet:
    """Descriptors with what decides which of them may be matched."""

    projected: F32  # (N, dimensions)
    words: U64  # (N, W), packed bits
    label: I64  # (N,) landmark; a match of equal non-negative labels is not reported
    session: I32  # (N,) mission
    time_ns: I64  # (N,)

    def __len__(self) -> int:
        return len(self.label)

    def take(self, rows: I64) -> DescriptorSet:
        """Return the descriptors of the given rows."""
        return DescriptorSet(
            self.projected[rows],
            self.words[rows],
            self.label[rows],
            self.session[rows],
            self.time_ns[rows],
        )

    @classmethod
    def concatenate(cls, first: DescriptorSet, second: DescriptorSet) -> DescriptorSet:
        """Return the descriptors of both.

        Raises:
            ValueError: Their lengths or dimensions differ.
        """
        return cls(
            *(
                np.concatenate([getattr(first, field.name), getattr(second, field.name)])
                for field in dataclasses.fields(cls)
            )
        )


@dataclasses.dataclass(frozen=True)
class MatchRule:
    """Which database descriptors a query may be matched with."""

    min_time_ns: int = 0  # within a session, matches closer in time are left out
    other_sessions_only: bool = False


@dataclasses.dataclass(frozen=True, eq=False)
class Neighbours:
    """The k nearest of every query, nearest first; of each label only the nearest descriptor."""

    row: I32  # (Q, k), -1 where there are fewer than k
    distance: F32  # (Q, k) bits, or squared distance in the projected space; inf where none


class DescriptorIndex(Protocol):
    """A search structure over a database of descriptors.

    Rows of the result count the descriptors in the order in which they came in; removing some does
    not renumber the others.
    """

    def nearest(self, queries: DescriptorSet, k: int, rule: MatchRule) -> Neighbours:
        """Return the nearest database descriptors that the rule allows, one per label."""

    def added(self, more: DescriptorSet) -> DescriptorIndex:
        """Return an index that holds more descriptors."""

    def without_session(self, session: int) -> DescriptorIndex:
        """Return an index that holds no descriptor of a session any more."""


def make_index(
    engine: str, database: DescriptorSet, *, seed: int, words_per_query: int
) -> DescriptorIndex:
    """Build an index.

    Args:
        engine: One of INDEX_ENGINES: "imi" (inverted multi-index over projected descriptors),
            "kd" (KD-tree, exact in the projected space) or "hamming" (exhaustive, exact).
        database: What to search in.
        seed: Seed of the vocabulary.
        words_per_query: Cells of the multi-index that are searched per query.
    """
    if engine == "hamming":
        from maplab_py.vision.hamming_index import HammingIndex

        return HammingIndex(database)
    if engine == "kd":
        from maplab_py.vision.tree_index import TreeIndex

        return TreeIndex(database)
    from maplab_py.vision.multi_index import InvertedMultiIndex

    return InvertedMultiIndex(database, seed=seed, cells_per_query=words_per_query)
