"""The descriptor indices that can be chosen by name."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maplab_py.vision.descriptor_kind import DescriptorKind
from maplab_py.vision.index import DescriptorIndex, DescriptorSet, MatchRule, Neighbours
from maplab_py.vision.projection import learn_projection
from maplab_py.vision.search_kernels import search_all

INDEX_ENGINES = ("imi", "kd", "hamming")
_SHORT = DescriptorKind(8)


def make_index(
    engine: str,
    database: DescriptorSet,
    *,
    seed: int,
    words_per_query: int,
    max_difference: float = np.inf,
) -> DescriptorIndex:
    """Build an index.

    Args:
        engine: One of INDEX_ENGINES: "imi" (inverted multi-index over projected descriptors),
            "kd" (KD-tree, exact in the projected space) or "hamming" (exhaustive, exact).
        database: What to search in.
        seed: Seed of the vocabulary.
        words_per_query: Cells of the multi-index that are searched per query.
        max_difference: Neighbours that differ by more are not wanted, which saves "imi" time; the others
            may return them.
    """
    if engine == "hamming":
        return HammingIndex(database)
    if engine == "kd":
        return TreeIndex(database)
    from maplab_py.vision.multi_index import InvertedMultiIndex

    return InvertedMultiIndex(
        database, seed=seed, cells_per_query=words_per_query, max_distance=max_difference
    )


def compile_kernels(kind: DescriptorKind = _SHORT) -> None:
    """Compile the projection and the search of every index on random tracks.

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
    for engine in INDEX_ENGINES:
        make_index(engine, database, seed=0, words_per_query=4).nearest(database, 2, MatchRule())


class HammingIndex:
    """Compares every query with every database descriptor: exact but slow on large maps."""

    def __init__(self, database: DescriptorSet) -> None:
        """Keep the descriptors."""
        self._database = database

    def nearest(self, queries: DescriptorSet, k: int, rule: MatchRule) -> Neighbours:
        """Return the nearest database descriptors that the rule allows, one per label."""
        row = np.full((len(queries), k), -1, dtype=np.int32)
        distance = np.full((len(queries), k), np.inf, dtype=np.float32)
        search_all(queries.columns, self._database.columns, rule, row, distance)
        return Neighbours(row, distance)


_FIRST_LOOK, _LAST_LOOK = 8, 512
"""Initial number of candidates per wanted neighbour; increased while the rule leaves too few."""


class TreeIndex:
    """Searches neighbours until k are found that the rule allows."""

    def __init__(self, database: DescriptorSet) -> None:
        """Build the tree."""
        from scipy.spatial import cKDTree

        self._database = database
        self._tree = cKDTree(database.projected)

    def nearest(self, queries: DescriptorSet, k: int, rule: MatchRule) -> Neighbours:
        """Return the nearest database descriptors that the rule allows, one per label."""
        row = np.full((len(queries), k), -1, dtype=np.int32)
        distance = np.full((len(queries), k), np.inf, dtype=np.float32)
        todo, look = np.arange(len(queries)), _FIRST_LOOK * k
        while len(todo) and len(self._database):
            look = min(look, len(self._database))
            part, gap = self._nearest(queries.take(todo), k, look, rule)
            row[todo], distance[todo] = part, gap
            is_last = look == len(self._database) or look >= _LAST_LOOK * k
            todo = todo[:0] if is_last else todo[part[:, -1] < 0]
            look *= 8
        return Neighbours(row, distance)

    def _nearest(
        self, queries: DescriptorSet, k: int, look: int, rule: MatchRule
    ) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        d = self._database
        gap, nearest = self._tree.query(queries.projected, k=np.arange(1, look + 1))
        label = d.label[nearest]
        session = d.session[nearest]
        apart = np.abs(d.time_ns[nearest] - queries.time_ns[:, None]) >= rule.min_time_ns
        other = session != queries.session[:, None]
        allowed = other | (apart & (not rule.other_sessions_only))
        allowed &= (label != queries.label[:, None]) | (label < 0)
        # of each label only the nearest: equal labels stand together after a stable sort
        order = np.argsort(np.where(allowed, label, -2), axis=1, kind="stable")
        sorted_label = np.take_along_axis(np.where(allowed, label, -2), order, axis=1)
        again = np.zeros_like(allowed)
        again[:, 1:] = (sorted_label[:, 1:] == sorted_label[:, :-1]) & (sorted_label[:, 1:] >= 0)
        repeated = np.zeros_like(allowed)
        np.put_along_axis(repeated, order, again, axis=1)
        allowed &= ~repeated
        rank = np.cumsum(allowed, axis=1) - 1
        query, column = np.nonzero(allowed & (rank < k))
        row = np.full((len(queries), k), -1, dtype=np.int32)
        distance = np.full((len(queries), k), np.inf, dtype=np.float32)
        place = rank[query, column]
        row[query, place] = nearest[query, column]
        distance[query, place] = gap[query, column] ** 2
        return row, distance
