"""Match keypoints with the nearest landmarks by their descriptors.

A single index over all landmarks finds the few nearest ones. Where many missions have observed a place,
its landmarks exist many times, and each mission gets too few of a query's neighbours to verify a place.
Then the neighbours only select missions: each query is compared with the missions to which most of them
belong, with an index for each, so that the work is proportional to the number of queries.
"""

import hashlib
import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from maplab_py.algorithms.loop_closure.candidates import Matches
from maplab_py.algorithms.loop_closure.features import MapFeatures
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.array_types import I32, I64, NDArray
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
        features: Keypoints and landmarks.
        options: How they are compared.
        rule: Which landmarks a query may match.
        apart: See above.
        asked: Features (rows, ascending) that are the queries; None = all.
    """
    queries = np.arange(len(features)) if asked is None else asked
    database = np.flatnonzero(features.in_database)
    landmarks = len(distinct(features.descriptors.label[database]))
    if landmarks == 0 or not len(queries):
        empty = np.zeros(0, dtype=np.int64)
        return Matches(empty, empty, empty.astype(np.int32)), landmarks
    d = features.descriptors
    missions = distinct(d.session[database])
    if len(missions) > options.max_missions_per_query + 1:
        return _in_chosen_missions(features, options, rule, database, queries), landmarks
    query, matched = _in_all_missions(features, options, rule, apart, database, queries)
    return _similar(features, options, query, matched), landmarks


def _similar(
    features: MapFeatures, options: LoopClosureOptions, query: I64, matched: I64
) -> Matches:
    """Return the matches whose descriptors differ little enough."""
    words = features.descriptors.words
    bits = differences(words, query, words, matched)
    kept = bits <= _largest(features, options)
    return Matches(query[kept], matched[kept], bits[kept])


def _largest(features: MapFeatures, options: LoopClosureOptions) -> float:
    """Return the largest difference of a match, as `differences` counts it."""
    return features.kind.largest(options.max_bit_fraction, options.max_descriptor_distance)


def _in_all_missions(
    features: MapFeatures,
    options: LoopClosureOptions,
    rule: MatchRule,
    apart: bool,
    database: I64,
    queries: I64,
) -> tuple[I64, I64]:
    """Return the pairs of features and their nearest database features."""
    d = features.descriptors
    asked = d if len(queries) == len(d) else d.take(queries)
    others = MatchRule(rule.min_time_ns, True)
    rows = nearest_rows(
        d.take(database),
        asked,
        _neighbours(options),
        [rule, others] if apart else [rule],
        seed=options.seed,
        words_per_query=options.num_words_for_nn_search,
        max_difference=_largest(features, options),
    )
    row = rows[0]
    if apart:
        same_session = (row >= 0) & (d.session[database][row] == asked.session[:, None])
        row = np.concatenate([np.where(same_session, row, -1), rows[1]], axis=1)
    query, column = np.nonzero(row >= 0)
    return queries[query], database[row[query, column]]


def _in_chosen_missions(
    features: MapFeatures,
    options: LoopClosureOptions,
    rule: MatchRule,
    database: I64,
    queries: I64,
) -> Matches:
    """Return the matches of each query with the missions chosen for it; see `remembered`."""
    setting = (
        f"chosen missions {options.num_neighbors} {options.seed} "
        f"{options.num_words_for_nn_search} {options.max_missions_per_query} "
        f"{_largest(features, options)!r} {features.kind!r} {rule!r}"
    )
    columns = (features.vertex, features.in_database, queries)
    query, matched, bits = remembered(
        features.descriptors,
        columns,
        setting,
        lambda: _searched_missions(features, options, rule, database, queries),
    )
    return Matches(query.astype(np.int64), matched.astype(np.int64), bits)


def _searched_missions(
    features: MapFeatures,
    options: LoopClosureOptions,
    rule: MatchRule,
    database: I64,
    queries: I64,
) -> I32:
    """Return the matches (3, M) with the nearest features in chosen missions: query, feature, bits.

    A query's mission is always searched: it reveals places that look alike.
    """
    d = features.descriptors
    other = MatchRule(rule.min_time_ns, True)
    nearest = _nearest(features, options, other, queries, database, max_difference=np.inf)
    size = int(d.session.max()) + 1
    chosen = _chosen_missions(features, *nearest, options.max_missions_per_query, size)
    del nearest
    parts = [np.zeros((3, 0), dtype=np.int32)]
    for mission in range(size):
        in_mission = database[d.session[database] == mission]
        wants = np.zeros(int(features.vertex.max()) + 1, dtype=np.bool_)
        wants[chosen[chosen % size == mission] // size] = True
        asked = queries[(d.session[queries] == mission) | wants[features.vertex[queries]]]
        if len(in_mission) and len(asked):
            pairs = _nearest(
                features, options, rule, asked, in_mission, _largest(features, options)
            )
            matches = _similar(features, options, *pairs)
            parts.append(np.stack([matches.query, matches.database, matches.bits]).astype(np.int32))
    result = np.concatenate(parts, axis=1)
    return result[:, np.argsort(result[0], kind="stable")]


def _nearest(
    features: MapFeatures,
    options: LoopClosureOptions,
    rule: MatchRule,
    query: I64,
    database: I64,
    max_difference: float,
) -> tuple[I64, I64]:
    """Return the pairs of query features and their nearest database features, not remembered."""
    d = features.descriptors
    index = InvertedMultiIndex(
        d.take(database),
        seed=options.seed,
        cells_per_query=options.num_words_for_nn_search,
        max_distance=max_difference,
    )
    parts = []
    for begin in range(0, len(query), _QUERIES_AT_ONCE):
        some = query[begin : begin + _QUERIES_AT_ONCE]
        row = index.nearest(d.take(some), _neighbours(options), rule).row
        i, j = np.nonzero(row >= 0)
        parts.append((some[i], database[row[i, j]]))
    asked, matched = (np.concatenate(column) for column in zip(*parts, strict=True))
    return asked, matched


def _neighbours(options: LoopClosureOptions) -> int:
    return options.num_neighbors if options.num_neighbors > 0 else _NEIGHBOURS


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
        database: What to search in.
        queries: What to search for (Q).
        k: Neighbours.
        rules: Which database descriptors a query may match.
        seed: Seed of the index.
        words_per_query: Cells of the multi-index that are searched per query.
        max_difference: Neighbours that differ by more are not wanted.
        memory: Where results are kept.
    """
    setting = f"{seed} {words_per_query} {k} {max_difference!r}"
    common = hashlib.blake2b(setting.encode(), digest_size=32)
    for descriptors in (database, queries):
        _add(common, descriptors)
    keys = [_key(common, rule) for rule in rules]
    results = [memory.get(key) for key in keys]
    if any(rows is None for rows in results):
        index = InvertedMultiIndex(
            database, seed=seed, cells_per_query=words_per_query, max_distance=max_difference
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
