"""Group descriptor matches into candidate places by votes and covisibility.

A match votes for every vertex that observes the matched landmark. The vertex with most votes and
the vertices that share landmarks with it form a place (Sattler 2015: covisibility).
Places of each mission are verified separately because only a single mission is rigid.
"""

import itertools
from typing import Any

import numpy as np

from maplab_py.algorithms.loop_closure.features import MapFeatures
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.array_types import I32, I64, Mask, Rows
from maplab_py.distinct import distinct
from maplab_py.memory import require_memory
from maplab_py.vimap import Groups, VIMap, observation_matrix, ragged_rows, starts_of_counts

MIN_SHARED_LANDMARKS = 5
"""Number of common landmarks above which vertices belong to the same place."""
_PLACES_PER_MISSION = 2
_QUERIES_AT_ONCE = 1024
_BYTES_PER_LANDMARK, _BYTES_PER_MATCH = 48, 77
"""Memory per listed landmark of a place and per match of a query [bytes]."""
_SAMPLE = 64
_PART_BYTES = 5e7
"""Memory of the landmarks and matches of the places that are looked at together."""


class Matches(Rows):
    """Matches of query features with database features (rows of `MapFeatures`)."""

    query: I64  # (M,) sorted
    database: I64  # (M,)
    bits: I32  # (M,) different bits, or squared distance of descriptors that are not binary


class Candidates(Groups, items=("match",)):
    """Pairs of a query vertex and a place, with the matches between them."""

    query_vertex: I64  # (P,)
    place_vertex: I64  # (P,) the vertex with most votes
    votes: I64  # (P,)
    match: I64  # rows of `Matches`, by candidate


class _MatchesByVertex(Groups, items=("row", "landmark")):
    """Matches ordered by their query vertex (V of them)."""

    row: I64  # (M,) of `Matches`
    landmark: I64  # (M,)


def find_candidates(
    vi_map: VIMap, features: MapFeatures, matches: Matches, options: LoopClosureOptions
) -> Candidates:
    """Return the candidate places in every mission for each query vertex."""
    seen = observation_matrix(vi_map).T.tocsr()  # (L, V)
    seen.sort_indices()
    near = _near(seen)
    picks = _all_places(vi_map, features, matches, seen, near, options)
    vertex = features.vertex[matches.query]
    order = np.argsort(vertex, kind="stable")
    by_vertex = _MatchesByVertex(
        start=starts_of_counts(np.bincount(vertex, minlength=len(vi_map.vertices))),
        row=order,
        landmark=features.descriptors.label[matches.database[order]],
    )
    cuts = _cuts(picks, near, seen, by_vertex)
    parts = [
        _with_matches(picks[begin:end], near, seen, by_vertex, options)
        for begin, end in itertools.pairwise(cuts)
    ]
    return Candidates.concatenate(parts)


def _all_places(
    vi_map: VIMap,
    features: MapFeatures,
    matches: Matches,
    seen: Any,
    near: Any,
    options: LoopClosureOptions,
) -> I64:
    """Return the rows of `_best_places` of all queries, in their order."""
    from scipy.sparse import csr_array

    landmarks, vertices = seen.shape
    # ones where a query vertex is matched with a landmark
    key = features.vertex[matches.query] * landmarks
    key += features.descriptors.label[matches.database]
    pair = np.divmod(distinct(key), max(landmarks, 1))
    ones = np.ones(len(pair[0]), dtype=np.int32)
    matched = csr_array((ones, pair), shape=(vertices, landmarks))
    queries = np.flatnonzero(np.diff(matched.indptr))
    places: list[I64] = [np.zeros((0, 3), dtype=np.int64)]
    for begin in range(0, len(queries), _QUERIES_AT_ONCE):
        chunk = queries[begin : begin + _QUERIES_AT_ONCE]
        places.append(_best_places(vi_map, chunk, matched[chunk] @ seen, near, options))
    picks = np.concatenate(places)
    return picks[np.lexsort((picks[:, 1], picks[:, 0]))]


def _near(seen: Any) -> Any:
    """Return the matrix (V, V) of ones where two vertices belong to one place."""
    shared = (seen.T @ seen).tocsr()
    near = (shared >= MIN_SHARED_LANDMARKS).astype(np.int8).tocsr()
    near.sort_indices()
    return near


def _cuts(picks: I64, near: Any, seen: Any, matches: _MatchesByVertex) -> I64:
    """Return where picks are divided so that each part takes a bounded amount of memory.

    The number of distinct landmarks of a place is estimated from some of the places.
    """
    if not len(picks):
        return np.zeros(2, dtype=np.int64)
    sample = np.unique(np.linspace(0, len(picks) - 1, _SAMPLE).astype(np.int64))
    landmarks = (near[picks[sample, 1]] @ seen.T).nnz / len(sample)
    of_pick = np.diff(matches.start)[picks[:, 0]]
    needed = np.cumsum(_BYTES_PER_LANDMARK * landmarks + _BYTES_PER_MATCH * of_pick)
    part = (needed / _PART_BYTES).astype(np.int64)
    begins = np.flatnonzero(np.diff(part, prepend=-1))
    largest = float(np.diff(np.append(np.append(0.0, needed[begins[1:] - 1]), needed[-1])).max())
    require_memory(largest, f"looking at {len(picks)} pairs of places")
    return np.append(begins, len(picks))


def _best_places(
    vi_map: VIMap, queries: I64, votes: Any, near: Any, options: LoopClosureOptions
) -> I64:
    """Return rows [query vertex, place vertex, votes] of the best places per query and mission.

    Args:
        queries: Query vertices (Q,).
        votes: Votes (Q, V), sparse.
        near: Vertices (V, V) that belong to one place, sparse.
    """
    v = vi_map.vertices
    entries = votes.tocoo()
    query, place = (np.asarray(axis, dtype=np.int64) for axis in entries.coords)
    value = entries.data.astype(np.int64)
    same = v.mission[queries[query]] == v.mission[place]
    apart = np.abs(v.timestamp_ns[queries[query]] - v.timestamp_ns[place]) >= round(
        options.min_image_time_seconds * 1e9
    )
    kept = (value >= options.min_verify_matches_num) & (~same | apart)
    query, place, value = query[kept], place[kept], value[kept]
    group = query * len(vi_map.missions) + v.mission[place]
    order = np.lexsort((place, -value, group))
    query, place, value, group = query[order], place[order], value[order], group[order]
    picks, floor, stored = [], np.zeros(0), sparse_entries(near)
    for number in range(_PLACES_PER_MISSION):
        is_first = np.append(True, group[1:] != group[:-1])[: len(group)]
        first = np.flatnonzero(is_first)
        if len(first) == 0:
            break
        of_group = np.cumsum(is_first) - 1
        if number == 0:
            floor = np.zeros(len(queries) * len(vi_map.missions))
            floor[group[first]] = value[first] * options.fraction_best_scores
        good = first[value[first] >= floor[group[first]]]
        picks.append(np.stack([queries[query[good]], place[good], value[good]], axis=1))
        left = ~is_among(stored, place[first][of_group] * near.shape[1] + place)
        query, place, value, group = query[left], place[left], value[left], group[left]
    return np.concatenate(picks) if picks else np.zeros((0, 3), dtype=np.int64)


def sparse_entries(matrix: Any) -> I64:
    """Return the entries (E,) of a sparse matrix (R, C) with sorted indices, as row * C + column."""
    rows = np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))
    return np.asarray(rows * matrix.shape[1] + matrix.indices)


def is_among(entries: I64, wanted: I64) -> Mask:
    """Return which values (N,) are among sorted ones (E,)."""
    return np.asarray(np.append(entries, -1)[np.searchsorted(entries, wanted)] == wanted)


def _with_matches(
    picks: I64, near: Any, seen: Any, matches: _MatchesByVertex, options: LoopClosureOptions
) -> Candidates:
    """Return the matches of each query vertex with the landmarks of its place."""
    place = (near[picks[:, 1]] @ seen.T).tocsr()  # (P, L) landmarks of the place
    place.sort_indices()
    row = ragged_rows(matches.start, picks[:, 0])
    pick = np.repeat(np.arange(len(picks)), np.diff(matches.start)[picks[:, 0]])
    inside = is_among(sparse_entries(place), pick * place.shape[1] + matches.landmark[row])
    row, pick = matches.row[row[inside]], pick[inside]
    count = np.bincount(pick, minlength=len(picks))
    enough = count >= options.min_verify_matches_num
    return Candidates(
        query_vertex=picks[enough, 0],
        place_vertex=picks[enough, 1],
        votes=picks[enough, 2],
        start=starts_of_counts(count[enough]),
        match=row[enough[pick]],
    )
