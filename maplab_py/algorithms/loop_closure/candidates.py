"""Group descriptor matches into candidate places by votes and covisibility.

A match votes for every vertex that observes the matched landmark. The vertex with most votes and
the vertices that share landmarks with it form a place (Sattler 2015: covisibility).
Places of each mission are verified separately because only a single mission is rigid.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from maplab_py.algorithms.loop_closure.features import MapFeatures
from maplab_py.array_types import I32, I64, Mask
from maplab_py.memory import require_memory
from maplab_py.vimap import VIMap
from maplab_py.vimap.table import ragged_rows, starts_of_counts

_MIN_SHARED_LANDMARKS = 5
"""Number of common landmarks above which vertices belong to the same place."""
_QUERIES_AT_ONCE = 1024
_BYTES_PER_LANDMARK, _BYTES_PER_MATCH = 48, 77
"""Memory per listed landmark of a place and per match of a query [bytes]."""
_SAMPLE = 64


@dataclasses.dataclass(frozen=True, eq=False)
class Matches:
    """Matches of query features with database features (rows of `MapFeatures`)."""

    query: I64  # (M,) sorted
    database: I64  # (M,)
    bits: I32  # (M,) different bits, or squared distance of descriptors that are not binary

    def __len__(self) -> int:
        return len(self.query)

    def take(self, rows: I64 | Mask) -> Matches:
        """Return the matches of a mask or rows."""
        return Matches(self.query[rows], self.database[rows], self.bits[rows])


@dataclasses.dataclass(frozen=True, eq=False)
class Candidates:
    """Pairs of a query vertex and a place, with the matches between them (CSR)."""

    query_vertex: I64  # (P,)
    place_vertex: I64  # (P,) the vertex with most votes
    votes: I64  # (P,)
    start: I64  # (P + 1,)
    match: I64  # rows of `Matches`, by candidate


@dataclasses.dataclass(frozen=True)
class CandidateRule:
    """Criteria for places to be verified."""

    min_time_ns: int
    other_missions_only: bool
    min_matches: int
    places_per_mission: int = 2
    fraction_best_scores: float = 0.25


def find_candidates(
    vi_map: VIMap, features: MapFeatures, matches: Matches, rule: CandidateRule
) -> Candidates:
    """Return the candidate places in every mission for each query vertex."""
    from scipy.sparse import csr_array

    vertices, landmarks = len(vi_map.vertices), len(vi_map.landmarks)
    seen = _observers(vi_map)  # (L, V)
    query_vertex = features.vertex[matches.query]
    landmark = features.descriptors.label[matches.database]
    pair = np.divmod(np.unique(query_vertex * landmarks + landmark), max(landmarks, 1))
    matched = csr_array((np.ones(len(pair[0]), dtype=np.int32), pair), shape=(vertices, landmarks))
    shared = (seen.T @ seen).tocsr()
    near = (shared >= _MIN_SHARED_LANDMARKS).astype(np.int8).tocsr()
    near.sort_indices()
    queries = np.unique(query_vertex)
    places: list[I64] = []
    for begin in range(0, len(queries), _QUERIES_AT_ONCE):
        chunk = queries[begin : begin + _QUERIES_AT_ONCE]
        places.append(_best_places(vi_map, chunk, matched[chunk] @ seen, near, rule))
    picks = np.concatenate(places) if places else np.zeros((0, 3), dtype=np.int64)
    picks = picks[np.lexsort((picks[:, 1], picks[:, 0]))]
    is_near = near[picks[:, 1]]
    _require_memory(picks, is_near, seen, query_vertex)
    place = (is_near @ seen.T).tocsr()  # (P, L) landmarks of the place
    return _with_matches(picks, place, query_vertex, landmark, rule)


def _require_memory(picks: I64, is_near: Any, seen: Any, query_vertex: I64) -> None:
    """Check that the landmarks and matches of all places fit into memory.

    The number of distinct landmarks in a place is estimated from some of the places.
    """
    sample = np.unique(np.linspace(0, len(picks) - 1, _SAMPLE).astype(np.int64))[: len(picks)]
    landmarks = (is_near[sample] @ seen.T).nnz * len(picks) / max(len(sample), 1)
    matches = np.bincount(query_vertex, minlength=is_near.shape[1])[picks[:, 0]].sum()
    needed = _BYTES_PER_LANDMARK * landmarks + _BYTES_PER_MATCH * float(matches)
    require_memory(needed, f"looking at {len(picks)} pairs of places")


def _observers(vi_map: VIMap) -> Any:
    """Return the matrix (L, V) of ones where a vertex observes a landmark."""
    from scipy.sparse import csr_array

    rows = vi_map.observations
    landmark, vertex = vi_map.keypoints.landmark[rows], vi_map.keypoint_vertex[rows]
    shape = (len(vi_map.landmarks), len(vi_map.vertices))
    seen = csr_array((np.ones(len(rows), dtype=np.int32), (landmark, vertex)), shape=shape)
    seen.sum_duplicates()
    seen.data[:] = 1
    return seen


def _best_places(vi_map: VIMap, queries: I64, votes: Any, near: Any, rule: CandidateRule) -> I64:
    """Return rows [query vertex, place vertex, votes] of the best places per query and mission.

    Args:
        vi_map: The map.
        queries: Query vertices (Q,).
        votes: Votes (Q, V), sparse.
        near: Vertices (V, V) that belong to one place, sparse.
        rule: Criteria.
    """
    v = vi_map.vertices
    entries = votes.tocoo()
    query, place = (np.asarray(axis, dtype=np.int64) for axis in entries.coords)
    value = entries.data.astype(np.int64)
    same = v.mission[queries[query]] == v.mission[place]
    apart = np.abs(v.timestamp_ns[queries[query]] - v.timestamp_ns[place]) >= rule.min_time_ns
    kept = (value >= rule.min_matches) & (~same | (apart & (not rule.other_missions_only)))
    query, place, value = query[kept], place[kept], value[kept]
    group = query * len(vi_map.missions) + v.mission[place]
    order = np.lexsort((place, -value, group))
    query, place, value, group = query[order], place[order], value[order], group[order]
    picks, floor = [], np.zeros(0)
    for number in range(rule.places_per_mission):
        is_first = np.append(True, group[1:] != group[:-1])[: len(group)]
        first = np.flatnonzero(is_first)
        if len(first) == 0:
            break
        of_group = np.cumsum(is_first) - 1
        if number == 0:
            floor = np.zeros(len(queries) * len(vi_map.missions))
            floor[group[first]] = value[first] * rule.fraction_best_scores
        good = first[value[first] >= floor[group[first]]]
        picks.append(np.stack([queries[query[good]], place[good], value[good]], axis=1))
        left = ~_contains(near, place[first][of_group], place)
        query, place, value, group = query[left], place[left], value[left], group[left]
    return np.concatenate(picks) if picks else np.zeros((0, 3), dtype=np.int64)


def _contains(matrix: Any, row: I64, column: I64) -> Mask:
    """Return which entries (row, column) (N,) a sparse matrix (V, V) with sorted indices has."""
    width = matrix.shape[1]
    stored = np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr)) * width + matrix.indices
    wanted = row * width + column
    where = np.searchsorted(stored, wanted)
    return np.asarray(np.append(stored, -1)[where] == wanted)


def _with_matches(
    picks: I64, place: Any, query_vertex: I64, landmark: I64, rule: CandidateRule
) -> Candidates:
    """Return the matches of each query vertex with the landmarks of its place."""
    order = np.argsort(query_vertex, kind="stable")
    size = int(query_vertex.max(initial=-1)) + 1
    of_vertex = starts_of_counts(np.bincount(query_vertex, minlength=size))
    rows = order[ragged_rows(of_vertex, picks[:, 0])]
    pick = np.repeat(np.arange(len(picks)), np.diff(of_vertex)[picks[:, 0]])
    # is landmark[row] in place[pick]: look the pair up among the matrix' sorted entries
    place.sort_indices()
    width = place.shape[1]
    entry = np.repeat(np.arange(len(picks)), np.diff(place.indptr)) * width + place.indices
    wanted = pick * width + landmark[rows]
    where = np.searchsorted(entry, wanted)
    inside = np.append(entry, -1)[where] == wanted
    rows, pick = rows[inside], pick[inside]
    count = np.bincount(pick, minlength=len(picks))
    enough = count >= rule.min_matches
    kept = enough[pick]
    return Candidates(
        query_vertex=picks[enough, 0],
        place_vertex=picks[enough, 1],
        votes=picks[enough, 2],
        start=starts_of_counts(count[enough]),
        match=rows[kept],
    )
