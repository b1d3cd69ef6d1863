"""Match keypoints with the nearest landmarks by their descriptors.

One index over all landmarks finds the few nearest ones. Where many missions have seen a place, its
landmarks exist many times and each mission gets so few of a query's neighbours that no place can be
verified. Then the neighbours only choose the missions: each query is compared with those that most of
them belong to, one index for each, so that the work grows with the number of queries alone.
"""

from __future__ import annotations

import numpy as np

from maplab_py.algorithms.loop_closure.candidates import Matches
from maplab_py.algorithms.loop_closure.features import MapFeatures
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.search_memory import nearest_rows
from maplab_py.array_types import I64
from maplab_py.vision.descriptors import differences
from maplab_py.vision.index import MatchRule

_NEIGHBOURS = 3
_MIN_VOTES = 2
"""Matched keypoints of a query with a mission for it to be chosen."""


def match_features(
    features: MapFeatures, options: LoopClosureOptions, rule: MatchRule, apart: bool
) -> tuple[Matches, int]:
    """Match keypoints with the nearest landmarks; also return the number of landmarks searched.

    With `apart` the query's mission and the others are searched separately, because landmarks of
    the query's mission would displace those of others among the nearest neighbours.
    """
    database = np.flatnonzero(features.in_database)
    landmarks = len(np.unique(features.descriptors.label[database]))
    if landmarks == 0:
        empty = np.zeros(0, dtype=np.int64)
        return Matches(empty, empty, empty.astype(np.int32)), 0
    d = features.descriptors
    missions = np.unique(d.session[database])
    queries = np.arange(len(features))
    if len(missions) > options.max_missions_per_query + 1:
        query, matched = _in_chosen_missions(features, options, rule, database)
    else:
        query, matched = _in_all_missions(features, options, rule, apart, queries, database)
    bits = differences(d.words, query, d.words, matched)
    matches = Matches(query, matched, bits)
    largest = features.kind.largest(options.max_bit_fraction, options.max_descriptor_distance)
    return matches.take(bits <= largest), landmarks


def _in_all_missions(
    features: MapFeatures,
    options: LoopClosureOptions,
    rule: MatchRule,
    apart: bool,
    query: I64,
    database: I64,
) -> tuple[I64, I64]:
    """Return the pairs of query features and their nearest database features."""
    d = features.descriptors
    others = MatchRule(rule.min_time_ns, True)
    rows = nearest_rows(
        options.detector_engine,
        d.take(database),
        d.take(query),
        options.num_neighbors if options.num_neighbors > 0 else _NEIGHBOURS,
        [rule, others] if apart else [rule],
        seed=options.seed,
        words_per_query=options.num_words_for_nn_search,
    )
    row = rows[0]
    if apart:
        same_session = (row >= 0) & (d.session[database][row] == d.session[query][:, None])
        row = np.concatenate([np.where(same_session, row, -1), rows[1]], axis=1)
    i, j = np.nonzero(row >= 0)
    return query[i], database[row[i, j]]


def _in_chosen_missions(
    features: MapFeatures, options: LoopClosureOptions, rule: MatchRule, database: I64
) -> tuple[I64, I64]:
    """Return the pairs of query features and their nearest features in the missions chosen for them.

    A query's mission is always searched: it reveals places that look alike.
    """
    d = features.descriptors
    queries = np.arange(len(features))
    other = MatchRule(rule.min_time_ns, True)
    nearest = _in_all_missions(features, options, other, False, queries, database)
    size = int(d.session.max()) + 1
    chosen = _chosen_missions(features, *nearest, options.max_missions_per_query, size)
    parts = []
    for mission in range(size):
        in_mission = database[d.session[database] == mission]
        wants = (d.session == mission) | np.isin(features.vertex * size + mission, chosen)
        asked = np.flatnonzero(wants)
        if len(in_mission) and len(asked):
            parts.append(_in_all_missions(features, options, rule, False, asked, in_mission))
    query = np.concatenate([part[0] for part in parts])
    matched = np.concatenate([part[1] for part in parts])
    order = np.argsort(query, kind="stable")
    return query[order], matched[order]


def _chosen_missions(features: MapFeatures, query: I64, matched: I64, most: int, size: int) -> I64:
    """Return the missions with most matches of each query vertex, as vertex * size + mission."""
    mission = features.descriptors.session[matched].astype(np.int64)
    key = np.unique(query * size + mission)  # a keypoint votes once for a mission
    voters = features.vertex[key // size] * size + key % size
    pair, votes = np.unique(voters, return_counts=True)
    pair, votes = pair[votes >= _MIN_VOTES], votes[votes >= _MIN_VOTES]
    order = np.lexsort((pair, -votes, pair // size))
    vertex = pair[order] // size
    starts = np.flatnonzero(np.append(True, vertex[1:] != vertex[:-1]))
    rank = np.arange(len(order)) - np.repeat(starts, np.diff(np.append(starts, len(order))))
    return np.asarray(pair[order[rank < most]])
