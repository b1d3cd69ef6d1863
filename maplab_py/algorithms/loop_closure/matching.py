"""Match keypoints with the nearest landmarks by their descriptors.

A single index over all landmarks finds the few nearest ones. Where many missions have observed a place,
its landmarks exist many times, and each mission gets too few of a query's neighbours to verify a place.
Then the neighbours only select missions: each query is compared with the missions to which most of them
belong, with an index for each, so that the work is proportional to the number of queries.
"""

import dataclasses
import functools
import hashlib
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import numpy as np

from maplab_py.algorithms.loop_closure.candidates import Matches
from maplab_py.algorithms.loop_closure.features import MapFeatures
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.array_types import I32, I64, NDArray, mask_of
from maplab_py.distinct import distinct
from maplab_py.memory import available_bytes
from maplab_py.vision.descriptors import differences
from maplab_py.vision.index import DescriptorSet, InvertedMultiIndex, MatchRule

_NEIGHBOURS = 3
_QUERIES_AT_ONCE = 1 << 18
"""Queries whose descriptors are copied together."""
_MIN_VOTES = 2
"""Matched keypoints of a query with a mission for it to be chosen."""


def match_features(
    features: MapFeatures,
    options: LoopClosureOptions,
    rule: MatchRule,
    apart: bool,
    asked: I64 | None = None,
) -> tuple[Matches, int]:
    """Match keypoints with the nearest landmarks; also return the number of landmarks searched.

    With `apart` the query's mission and the others are searched separately, because landmarks of
    the query's mission would displace those of others among the nearest neighbours.

    Args:
        rule: Which landmarks a query may match.
        apart: See above.
        asked: Features (rows, ascending) that are the queries; None = all.
    """
    d = features.descriptors
    search = _Search(
        features=features,
        options=options,
        rule=rule,
        queries=np.arange(len(features)) if asked is None else asked,
        database=np.flatnonzero(features.in_database),
        k=options.num_neighbors if options.num_neighbors > 0 else _NEIGHBOURS,
        largest=features.kind.largest(options.max_bit_fraction, options.max_descriptor_distance),
    )
    landmarks = len(distinct(d.label[search.database]))
    if landmarks == 0 or not len(search.queries):
        empty = np.zeros(0, dtype=np.int64)
        return Matches(empty, empty, empty.astype(np.int32)), landmarks
    if len(distinct(d.session[search.database])) > options.max_missions_per_query + 1:
        return search.in_chosen_missions(), landmarks
    return search.similar(*search.in_all_missions(apart)), landmarks


@dataclasses.dataclass(frozen=True, eq=False)
class _Search:
    """Search for the nearest database features of queries; both are rows of the features."""

    features: MapFeatures
    options: LoopClosureOptions
    rule: MatchRule
    queries: I64
    database: I64
    k: int  # neighbours
    largest: float  # difference of a match, as `differences` counts it

    def similar(self, query: I64, matched: I64) -> Matches:
        """Return the matches whose descriptors differ little enough."""
        words = self.features.descriptors.words
        matches = Matches(query, matched, differences(words, query, words, matched))
        return matches.take(matches.bits <= self.largest)

    def in_all_missions(self, apart: bool) -> tuple[I64, I64]:
        """Return the pairs of queries and their nearest database features."""
        d = self.features.descriptors
        asked = d if len(self.queries) == len(d) else d.take(self.queries)
        others = MatchRule(self.rule.min_time_ns, True)
        rows = nearest_rows(
            d.take(self.database),
            asked,
            self.k,
            [self.rule, others] if apart else [self.rule],
            seed=self.options.seed,
            words_per_query=self.options.num_words_for_nn_search,
            max_difference=self.largest,
        )
        row = rows[0]
        if apart:
            same_session = (row >= 0) & (d.session[self.database][row] == asked.session[:, None])
            row = np.concatenate([np.where(same_session, row, -1), rows[1]], axis=1)
        query, column = np.nonzero(row >= 0)
        return self.queries[query], self.database[row[query, column]]

    def in_chosen_missions(self) -> Matches:
        """Return the matches of each query with the missions chosen for it, from memory if possible."""
        o, features = self.options, self.features
        setting = (
            f"chosen missions {o.num_neighbors} {o.seed} {o.num_words_for_nn_search} "
            f"{o.max_missions_per_query} {self.largest!r} {features.kind!r} {self.rule!r}"
        )
        columns = (features.vertex, features.in_database, self.queries)
        key = setting, digest(*_columns(features.descriptors), *columns)
        query, matched, bits = MEMORY.result(key, self._in_chosen_missions)
        return Matches(query.astype(np.int64), matched.astype(np.int64), bits)

    def _in_chosen_missions(self) -> I32:
        """Return the matches (3, M) with the nearest features in chosen missions: query, feature, bits.

        A query's mission is always searched: it reveals places that look alike.
        """
        d, vertex = self.features.descriptors, self.features.vertex
        other = MatchRule(self.rule.min_time_ns, True)
        nearest = self._nearest(other, self.queries, self.database, max_difference=np.inf)
        size = int(d.session.max()) + 1
        chosen = _chosen_missions(
            self.features, *nearest, self.options.max_missions_per_query, size
        )
        del nearest
        parts = [np.zeros((3, 0), dtype=np.int32)]
        for mission in range(size):
            in_mission = self.database[d.session[self.database] == mission]
            wants = mask_of(int(vertex.max()) + 1, chosen[chosen % size == mission] // size)
            is_asked = (d.session[self.queries] == mission) | wants[vertex[self.queries]]
            if len(in_mission) and is_asked.any():
                asked = self.queries[is_asked]
                m = self.similar(*self._nearest(self.rule, asked, in_mission, self.largest))
                parts.append(np.stack([m.query, m.database, m.bits]).astype(np.int32))
        result = np.concatenate(parts, axis=1)
        return result[:, np.argsort(result[0], kind="stable")]

    def _nearest(
        self, rule: MatchRule, query: I64, database: I64, max_difference: float
    ) -> tuple[I64, I64]:
        """Return the pairs of query features and their nearest database features, not remembered."""
        d = self.features.descriptors
        index = InvertedMultiIndex(
            d.take(database),
            seed=self.options.seed,
            cells_per_query=self.options.num_words_for_nn_search,
            max_distance=max_difference,
        )
        parts = []
        for begin in range(0, len(query), _QUERIES_AT_ONCE):
            some = query[begin : begin + _QUERIES_AT_ONCE]
            row = index.nearest(d.take(some), self.k, rule).row
            i, j = np.nonzero(row >= 0)
            parts.append((some[i], database[row[i, j]]))
        asked, matched = (np.concatenate(column) for column in zip(*parts, strict=True))
        return asked, matched


def _chosen_missions(features: MapFeatures, query: I64, matched: I64, most: int, size: int) -> I64:
    """Return the missions with most matches of each query vertex, as vertex * size + mission."""
    mission = features.descriptors.session[matched].astype(np.int64)
    key = distinct(query * size + mission)  # a keypoint votes once for a mission
    voters = features.vertex[key // size] * size + key % size
    pair, votes = np.unique(voters, return_counts=True)
    pair, votes = pair[votes >= _MIN_VOTES], votes[votes >= _MIN_VOTES]
    order = np.lexsort((pair, -votes, pair // size))
    vertex = pair[order] // size
    starts = np.flatnonzero(np.append(True, vertex[1:] != vertex[:-1]))
    rank = np.arange(len(order)) - np.repeat(starts, np.diff(np.append(starts, len(order))))
    return np.asarray(pair[order[rank < most]])


# Results of descriptor searches, kept for the commands that repeat them.
#
# `aam`, `relax` and `lc` change poses, base frames or landmarks one after the other, but search the same
# descriptors for the same neighbours. A search is known by the digest of everything that its result
# depends on, so a result is used again only for equal input, and using it changes no result.

_MIN_BYTES, _SHARE = 64_000_000, 1.0 / 16.0
"""Memory of all results: a share of what is available, and no less than so much. A result has 12 bytes per
query and search, or per match of a map of many missions."""


class SearchMemory:
    """Results of the latest searches; threads may share it."""

    def __init__(self, max_bytes: int | None = None) -> None:
        """Create an empty memory.

        Args:
            max_bytes: Memory of all results [bytes].
        """
        # the oldest results are dropped where all together take more; None = a share of the memory that is
        # available then
        self.max_bytes = max_bytes
        self._lock = threading.Lock()
        self._rows: OrderedDict[Hashable, I32] = OrderedDict()
        self._bytes = 0

    def __len__(self) -> int:
        return len(self._rows)

    def result(self, key: Hashable, search: Callable[[], I32]) -> I32:
        """Return the result of a search, read-only, from memory if it is there.

        Args:
            key: All that the result depends on.
            search: Makes the result.
        """
        with self._lock:
            if key in self._rows:
                self._rows.move_to_end(key)
                return self._rows[key]
        rows = search()
        rows.setflags(write=False)
        with self._lock:
            if key not in self._rows:
                self._rows[key] = rows
                self._bytes += rows.nbytes
            most = self.max_bytes
            if most is None:
                most = max(_MIN_BYTES, int(_SHARE * (available_bytes() + self._bytes)))
            while self._bytes > most:
                self._bytes -= self._rows.popitem(last=False)[1].nbytes
        return rows


MEMORY = SearchMemory()


def nearest_rows(
    database: DescriptorSet,
    queries: DescriptorSet,
    k: int,
    rules: Sequence[MatchRule],
    *,
    seed: int,
    words_per_query: int,
    max_difference: float = np.inf,
    memory: SearchMemory = MEMORY,
) -> list[I32]:
    """Return the rows (Q, k) of the nearest database descriptors, -1 for none, for each rule.

    The index is built only if one of the searches is not remembered.

    Args:
        queries: What to search for (Q).
        k: Neighbours.
        rules: Which database descriptors a query may match.
        seed: Seed of the index.
        words_per_query: Cells of the multi-index that are searched per query.
        max_difference: Neighbours that differ by more are not wanted.
        memory: Where results are kept.
    """
    key = seed, words_per_query, k, max_difference, digest(*_columns(database), *_columns(queries))

    @functools.cache
    def index() -> InvertedMultiIndex:
        return InvertedMultiIndex(
            database, seed=seed, cells_per_query=words_per_query, max_distance=max_difference
        )

    def search(rule: MatchRule) -> I32:
        return index().nearest(queries, k, rule).row

    return [memory.result((key, rule), functools.partial(search, rule)) for rule in rules]


def _columns(descriptors: DescriptorSet) -> tuple[NDArray[Any], ...]:
    return descriptors.projected, *descriptors.columns


def digest(*columns: NDArray[Any]) -> bytes:
    """Return a digest of arrays with their types and shapes."""
    result = hashlib.blake2b(digest_size=32)
    for column in columns:
        result.update(f"{column.dtype} {column.shape}".encode())
        result.update(np.ascontiguousarray(column).data)
    return result.digest()
