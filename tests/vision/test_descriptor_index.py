import dataclasses

import numpy as np
import pytest

from maplab_py.vision.descriptors import differences, pack_words
from maplab_py.vision.index import InvertedMultiIndex, MatchRule
from tests.vision.synthetic import descriptor_set, nearest_by_bits, tracks


@pytest.fixture(scope="module")
def features():
    descriptors, label = tracks(1500, 6, flips=0.08, seed=7)
    return descriptors, descriptor_set(descriptors, label)


def exact_bits(descriptors, a, b):
    bits = np.unpackbits(descriptors, axis=1)
    return np.count_nonzero(bits[a] != bits[b], axis=1)


@pytest.mark.parametrize("size", [5, 8, 48, 64])
def test_hamming_counts_different_bits(size):
    rng = np.random.default_rng(size)
    descriptors = rng.integers(0, 256, size=(50, size), dtype=np.uint8)
    a, b = rng.integers(0, 50, size=(2, 200))
    words = pack_words(descriptors)
    np.testing.assert_array_equal(differences(words, a, words, b), exact_bits(descriptors, a, b))


def test_descriptors_of_different_lengths_are_not_compared():
    rows = np.zeros(1, dtype=np.int64)
    with pytest.raises(ValueError, match="cannot be compared"):
        differences(np.zeros((1, 6), np.uint64), rows, np.zeros((1, 8), np.uint64), rows)


def test_multi_index_recall_by_bits(features):
    _, database = features
    is_query = np.arange(len(database)) % 6 == 5  # the last of each track, of no landmark yet
    queries = database.take(np.flatnonzero(is_query)[::2])
    queries = dataclasses.replace(queries, label=np.full(len(queries), -1))
    rest = database.take(np.flatnonzero(~is_query))
    found = InvertedMultiIndex(rest, cells_per_query=32).nearest(queries, 1, MatchRule())
    exact = nearest_by_bits(rest, queries)
    assert np.all(found.distance[:, 0] >= exact)
    assert np.mean(found.distance[:, 0] == exact) >= 0.9


def test_multi_index_recall_in_projected_space(features):
    _, database = features
    index = InvertedMultiIndex(database, cells_per_query=32, rank_by_bits=False)
    queries = np.arange(0, len(database), 11)
    found = index.nearest(database.take(queries), 1, MatchRule())
    points = database.projected
    exact = np.empty(len(queries))
    for i, query in enumerate(queries):
        distance = np.sum((points - points[query]) ** 2, axis=1)
        distance[database.label == database.label[query]] = np.inf
        exact[i] = distance.min()
    assert np.mean(found.distance[:, 0] <= exact * 1.0001 + 1e-6) >= 0.9


def test_each_label_once_nearest_first(features):
    _, database = features
    index = InvertedMultiIndex(database, cells_per_query=32)
    found = index.nearest(database.take(np.arange(300)), 4, MatchRule())
    assert np.all(np.diff(found.distance, axis=1) >= 0)
    for query, rows in enumerate(found.row):
        labels = database.label[rows[rows >= 0]]
        assert len(set(labels.tolist())) == len(labels)
        assert database.label[query] not in labels


@pytest.mark.parametrize("share", [0.2, 0.7])
def test_a_bound_on_differences_leaves_out_nothing_that_is_nearer(features, share):
    _, database = features
    queries = database.take(np.arange(300))
    index = InvertedMultiIndex(database, cells_per_query=32)
    whole = index.nearest(queries, 4, MatchRule())
    bits = float(np.floor(np.quantile(whole.distance, share)))
    index = InvertedMultiIndex(database, cells_per_query=32, max_distance=bits)
    bounded = index.nearest(queries, 4, MatchRule())
    within = whole.distance <= bits
    assert 0 < within.sum() < within.size
    np.testing.assert_array_equal(bounded.row, np.where(within, whole.row, -1))


def test_rule_keeps_near_times_and_own_session_out():
    descriptors, label = tracks(200, 6, flips=0.08, seed=8)
    time_ns = np.tile(np.arange(6) * 10**9, 200)
    database = descriptor_set(descriptors, label, time_ns=time_ns)
    index = InvertedMultiIndex(database, cells_per_query=256)
    unlabelled = database.take(np.arange(len(label)))
    object.__setattr__(unlabelled, "label", np.full(len(label), -1))
    found = index.nearest(unlabelled, 3, MatchRule(min_time_ns=2 * 10**9))
    query, k = np.nonzero(found.row >= 0)
    assert np.all(np.abs(time_ns[query] - time_ns[found.row[query, k]]) >= 2 * 10**9)
    own = index.nearest(unlabelled, 3, MatchRule(other_sessions_only=True))
    assert np.all(own.row == -1)


def test_an_empty_index_has_no_neighbours(features):
    _, database = features
    index = InvertedMultiIndex(database.take(np.arange(0)))
    assert np.all(index.nearest(database.take(np.arange(5)), 2, MatchRule()).row == -1)
