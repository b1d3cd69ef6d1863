"""Decide which landmarks to merge by the verified observations that say so."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.array_types import F64, I64, Mask
from maplab_py.distinct import distinct
from maplab_py.vimap import VIMap
from maplab_py.vimap.queries import observer_counts
from maplab_py.vision.track_union import unite_tracks

_ROUNDS = 4
"""Merged landmarks collect the votes of their members; later rounds merge next to nothing."""


@dataclasses.dataclass(frozen=True, eq=False)
class Votes:
    """Verified observations (N,) that two landmarks are one point."""

    first: I64  # (N,) landmark that the query observes
    second: I64  # (N,) landmark that it was matched with
    query: I64  # (N,) query vertex
    bits: NDArray[np.int32]  # (N,) different bits
    is_doubtful: Mask  # (N,) the positions say little for one point; see `Agreement.is_doubtful`


@dataclasses.dataclass(frozen=True, eq=False)
class United:
    """Pairs of landmarks to merge, one row per vote for them."""

    first: I64  # (P,)
    second: I64  # (P,)
    vote: I64  # (P,) row of `Votes`
    wanted: I64  # (P,) query vertices that had to agree
    too_few: int  # pairs that fewer query vertices support
    seen_together: int  # pairs that one image sees both of


@dataclasses.dataclass(frozen=True, eq=False)
class Pairs:
    """Pairs (P,) of landmarks, `first` the larger row."""

    of_vote: I64  # (N,)
    first: I64
    second: I64
    votes: I64  # query vertices that support the pair
    bits: F64  # mean number of different bits
    is_doubtful: Mask  # according to any vote


def unite(vi_map: VIMap, votes: Votes, min_votes: int) -> United:
    """Return the pairs that enough query vertices support and no image contradicts.

    A pair needs `min_votes` query vertices, or all vertices that observe one of the two landmarks where
    they are fewer: after keyframing many landmarks have a single observer. Doubtful pairs need one
    more. Votes are counted again after merging: those for several landmarks that were merged are votes
    for one.

    Args:
        vi_map: The map.
        votes: Verified observations; the landmarks of a vote differ.
        min_votes: Number of query vertices.
    """
    count = len(vi_map.landmarks)
    image = vi_map.keypoint_frame[vi_map.observations].astype(np.int64)
    observers = observer_counts(vi_map)
    label = np.arange(count)
    links = np.zeros((2, 0), dtype=np.int64)
    none = np.zeros(0, dtype=np.int64)
    parts = [(none, none, none, none)]
    for _ in range(_ROUNDS):
        pairs = count_pairs(votes, label)
        wanted = np.minimum(observers[pairs.first], observers[pairs.second])
        wanted = np.minimum(wanted, min_votes + pairs.is_doubtful)
        enough = pairs.votes >= wanted
        order = np.lexsort((pairs.second, pairs.first, pairs.bits, -pairs.votes))
        order = order[enough[order]]
        both = np.stack([pairs.first[order], pairs.second[order]])
        # what earlier rounds have merged comes first
        first, second = np.concatenate([links, both], axis=1)
        fits = unite_tracks(first, second, vi_map.observation_start, image, len(vi_map.frames))
        fits = fits[links.shape[1] :]
        if not fits.any():
            break
        is_united = np.zeros(len(pairs.votes) + 1, dtype=np.bool_)
        is_united[order[fits]] = True
        vote = np.flatnonzero(is_united[pairs.of_vote])
        of_vote = pairs.of_vote[vote]
        parts.append((pairs.first[of_vote], pairs.second[of_vote], vote, wanted[of_vote]))
        links = np.concatenate([links, both[:, fits]], axis=1)
        label = _components(links, count)
        np.maximum.at(observers, label, observers)
    merged = [np.concatenate(column) for column in zip(*parts, strict=True)]
    return United(
        first=merged[0],
        second=merged[1],
        vote=merged[2],
        wanted=merged[3],
        too_few=int(np.count_nonzero(~enough)),
        seen_together=int(np.count_nonzero(~fits)),
    )


def count_pairs(votes: Votes, label: I64) -> Pairs:
    """Count the votes for pairs of landmarks.

    A pair is the same in both directions. Votes for landmarks that are merged belong to pair -1.

    Args:
        votes: Verified observations.
        label: Landmark (L,) that each landmark has been merged into.
    """
    count = max(len(label), 1)
    a, b = label[votes.first], label[votes.second]
    open_ = np.flatnonzero(a != b)
    key = np.maximum(a, b)[open_] * count + np.minimum(a, b)[open_]
    key, pair = np.unique(key, return_inverse=True)
    pair = pair.astype(np.int64)
    span = int(votes.query.max(initial=0)) + 1
    voters = distinct(pair * span + votes.query[open_])
    number = np.bincount(voters // span, minlength=len(key))
    mean = np.bincount(pair, weights=votes.bits[open_], minlength=len(key)) / np.maximum(
        np.bincount(pair, minlength=len(key)), 1
    )
    of_vote = np.full(len(a), -1, dtype=np.int64)
    of_vote[open_] = pair
    is_doubtful = np.bincount(pair, weights=votes.is_doubtful[open_], minlength=len(key)) > 0
    return Pairs(of_vote, key // count, key % count, number, mean, is_doubtful)


def _components(links: I64, count: int) -> I64:
    """Return the smallest row (count,) that each landmark is connected with by links (2, N)."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    graph = coo_array((np.ones(links.shape[1], dtype=np.int8), tuple(links)), shape=(count, count))
    groups, label = connected_components(graph, directed=False)
    smallest = np.full(groups, count, dtype=np.int64)
    np.minimum.at(smallest, label, np.arange(count))
    return np.asarray(smallest[label])
