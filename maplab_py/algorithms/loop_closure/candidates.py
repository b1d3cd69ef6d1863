"""From single descriptor matches to places: votes for database vertices, covisible neighbourhoods.

A match votes for every vertex that observes the matched landmark. The vertex with most votes and
the vertices that share landmarks with it are one place (Sattler et al., ICCV 2015: covisibility);
places of one mission are verified separately, as only a mission is rigid in itself.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.loop_closure.features import MapFeatures
from maplab_py.vimap import VIMap
from maplab_py.vimap.table import ragged_rows, starts_of_counts

I64 = NDArray[np.int64]
I32 = NDArray[np.int32]
Mask = NDArray[np.bool_]

_MIN_SHARED_LANDMARKS = 5
"""Vertices that observe as many common landmarks see the same place."""
_QUERIES_AT_ONCE = 1024


@dataclasses.dataclass(frozen=True, eq=False)
class Matches:
    """Matches of query features with database features (rows of `MapFeatures`)."""

    query: I64  # (M,) sorted
    database: I64  # (M,)
    bits: I32  # (M,) different bits

    def __len__(self) -> int:
        return len(self.query)

    def take(self, rows: I64 | Mask) -> Matches:
        """Return some of the matches."""
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
    """Which places are worth verifying."""

    min_time_ns: int
    other_missions_only: bool
    min_matches: int
    places_per_mission: int = 2
    fraction_best_scores: float = 0.25


def find_candidates(
    vi_map: VIMap, features: MapFeatures, matches: Matches, rule: CandidateRule
) -> Candidates:
    """Return the places of every mission that each query vertex may have seen."""
    from scipy.sparse import csr_array

    vertices, landmarks = len(vi_map.vertices), len(vi_map.landmarks)
    seen = _observers(vi_map)  # (L, V)
    query_vertex = features.vertex[matches.query]
    landmark = features.descriptors.label[matches.database]
    pair = np.divmod(np.unique(query_vertex * landmarks + landmark), max(landmarks, 1))
    matched = csr_array((np.ones(len(pair[0]), dtype=np.int32), pair), shape=(vertices, landmarks))
    shared = (seen.T @ seen).tocsr()
    queries = np.unique(query_vertex)
    found: list[I64] = []
    for begin in range(0, len(queries), _QUERIES_AT_ONCE):
        chunk = queries[begin : begin + _QUERIES_AT_ONCE]
        found += _best_places(vi_map, chunk, matched[chunk] @ seen, shared, rule)
    picks = np.concatenate(found) if found else np.zeros((0, 3), dtype=np.int64)
    picks = picks[np.lexsort((picks[:, 1], picks[:, 0]))]
    is_near = (shared >= _MIN_SHARED_LANDMARKS).astype(np.int8)[picks[:, 1]]
    place = (is_near @ seen.T).tocsr()  # (P, L) landmarks of the place
    return _with_matches(picks, place, query_vertex, landmark, rule)


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


def _best_places(
    vi_map: VIMap, queries: I64, votes: Any, shared: Any, rule: CandidateRule
) -> list[I64]:
    """Return rows [query vertex, place vertex, votes] of the best places per mission."""
    v = vi_map.vertices
    found = []
    for mission in range(len(vi_map.missions)):
        columns = np.arange(vi_map.vertex_start[mission], vi_map.vertex_start[mission + 1])
        score = votes[:, columns].toarray()
        same = v.mission[queries] == mission
        if same.any():
            near = np.abs(v.timestamp_ns[queries[same]][:, None] - v.timestamp_ns[columns])
            too_near = near < rule.min_time_ns
            score[same] = np.where(rule.other_missions_only | too_near, 0, score[same])
        floor = None
        for _ in range(rule.places_per_mission):
            if score.shape[1] == 0:
                break
            best = np.argmax(score, axis=1)
            value = score[np.arange(len(queries)), best]
            floor = value * rule.fraction_best_scores if floor is None else floor
            good = (value >= rule.min_matches) & (value >= floor)
            found.append(np.stack([queries, columns[best], value], axis=1)[good].astype(np.int64))
            near_best = shared[columns[best]][:, columns].toarray() >= _MIN_SHARED_LANDMARKS
            score[near_best] = 0
    return found


def _with_matches(
    picks: I64, place: Any, query_vertex: I64, landmark: I64, rule: CandidateRule
) -> Candidates:
    """Attach to every pick the matches of its query vertex with landmarks of its place."""
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
