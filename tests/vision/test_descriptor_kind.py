import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplab_py.errors import UserError
from maplab_py.vimap.descriptors import DescriptorDepth, FeatureType
from maplab_py.vision.descriptors import STEPS_PER_UNIT, DescriptorKind, differences
from maplab_py.vision.index import DescriptorSet, InvertedMultiIndex, MatchRule
from maplab_py.vision.projection import (
    DescriptorProjection,
    learn_projection,
    load_projection,
    save_projection,
)
from tests.support.float_features import as_numbers
from tests.vision.synthetic import tracks

RECALL = 0.9
FLOAT = DescriptorKind(64 * 4, FeatureType.SUPERPOINT, DescriptorDepth.FLOAT32)
SIFT = DescriptorKind(128, FeatureType.SIFT)


def raw(numbers: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(numbers, dtype="<f4").view(np.uint8)


@given(st.integers(0, 2**32 - 1), st.sampled_from([1e-30, 1.0, 512.0, 1e30]))
def test_distances_are_those_of_unit_vectors(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    numbers = np.clip(rng.normal(size=(40, 64)), -2.5, 2.5)
    steps = FLOAT.steps(raw(scale * numbers))
    unit = numbers / np.linalg.norm(numbers, axis=1, keepdims=True)
    rows = np.arange(40)
    other = rng.permutation(40)
    exact = np.linalg.norm(unit - unit[other], axis=1)
    counted = np.sqrt(differences(steps, rows, steps, other)) / STEPS_PER_UNIT
    np.testing.assert_allclose(counted, exact, atol=0.05)
    cosine = np.einsum("nd,nd->n", unit, unit[other])
    np.testing.assert_allclose(1.0 - 0.5 * counted**2, cosine, atol=0.06)


def test_what_has_no_length_matches_nothing() -> None:
    numbers = np.zeros((4, 64), dtype=np.float32)
    numbers[1, 3], numbers[2, 5] = np.nan, np.inf
    numbers[3, 0] = 2.0
    steps = FLOAT.steps(raw(numbers))
    assert not steps[:3].any()
    distance = differences(steps, np.arange(3), steps, np.full(3, 3))
    # a single number of unit length is kept up to half of it
    assert (distance == 127**2).all()
    assert FLOAT.has_content(raw(numbers)).tolist() == [False, False, False, True]
    assert not SIFT.has_content(np.zeros((1, 128), dtype=np.uint8)).any()
    assert DescriptorKind(8).has_content(np.zeros((1, 8), dtype=np.uint8)).all()


def test_limits_are_in_the_unit_of_differences() -> None:
    assert DescriptorKind(48).largest(0.25, 9.0) == 96.0
    assert SIFT.largest(0.25, 0.5) == (0.5 * STEPS_PER_UNIT) ** 2
    xfeat = DescriptorKind(256, FeatureType.XFEAT, DescriptorDepth.FLOAT32)
    assert xfeat.largest(0.25, 0.45) == pytest.approx((0.6 * STEPS_PER_UNIT) ** 2)
    assert (SIFT.largest_projected(40.0, 10), xfeat.largest_projected(40.0, 24)) == (40.0, 120.0)
    assert xfeat.largest_projected(40.0, 10) == 30.0  # a summary map from before
    assert (DescriptorKind(48).dimensions, SIFT.dimensions, FLOAT.dimensions) == (384, 128, 64)
    assert SIFT.words == "SIFT of 128 bytes"


def test_bits_and_numbers_are_not_compared() -> None:
    rows = np.zeros(1, dtype=np.int64)
    words = DescriptorKind(64).comparable(np.zeros((1, 64), dtype=np.uint8))
    steps = FLOAT.comparable(raw(np.ones((1, 64))))
    with pytest.raises(ValueError, match="cannot be compared"):
        differences(words, rows, steps, rows)


@pytest.fixture(scope="module")
def features() -> DescriptorSet:
    bits, label = tracks(300, 6, flips=0.05, seed=2)
    descriptors = raw(as_numbers(bits[:, :24]))  # the other bits are noise
    projection = learn_projection(descriptors, label, kind=FLOAT)
    return DescriptorSet(
        projected=projection.project(descriptors),
        words=FLOAT.comparable(descriptors),
        label=label,
        session=np.zeros(len(label), dtype=np.int32),
        time_ns=np.zeros(len(label), dtype=np.int64),
    )


def test_the_index_finds_the_track_of_a_descriptor(features: DescriptorSet) -> None:
    index = InvertedMultiIndex(features, cells_per_query=32)
    strangers = dataclasses.replace(features, label=np.full(len(features), -1))
    row = index.nearest(strangers.take(np.arange(0, 1800, 7)), 1, MatchRule()).row[:, 0]
    assert np.mean(features.label[row] == features.label[::7]) > 0.97


def test_distances_are_those_of_the_numbers_and_mostly_the_smallest(
    features: DescriptorSet,
) -> None:
    queries = features.take(np.arange(0, 300, 3))
    found = InvertedMultiIndex(features, cells_per_query=32).nearest(queries, 2, MatchRule())
    steps = features.words.astype(np.float64)
    distance = ((queries.words.astype(np.float64)[:, None] - steps[None]) ** 2).sum(axis=2)
    distance[queries.label[:, None] == features.label[None]] = np.inf
    nearest = distance[np.arange(len(queries)), found.row[:, 0]]
    np.testing.assert_array_equal(found.distance[:, 0], nearest)
    assert np.mean(nearest == distance.min(axis=1)) > RECALL


def test_a_projection_of_numbers_is_linear_in_the_signed_bytes(features: DescriptorSet) -> None:
    rng = np.random.default_rng(1)
    descriptors = raw(rng.normal(size=(20, 64)))
    matrix = rng.normal(size=(10, 64)).astype(np.float32)
    projection = DescriptorProjection(matrix, FLOAT)
    expected = FLOAT.steps(descriptors).astype(np.float64) @ matrix.T.astype(np.float64)
    np.testing.assert_allclose(projection.project(descriptors), expected, rtol=1e-4, atol=1e-2)


def test_a_projection_of_numbers_comes_back_from_its_file(tmp_path) -> None:
    matrix = np.random.default_rng(0).normal(size=(10, 128)).astype(np.float32)
    save_projection(DescriptorProjection(matrix, SIFT), tmp_path / "p.npz")
    again = load_projection(tmp_path / "p.npz")
    assert again.kind == SIFT
    assert again.descriptor_size == 128
    np.savez(tmp_path / "odd.npz", matrix=matrix, kind=np.array([100, 3, 0]))
    with pytest.raises(UserError, match="numbers"):
        load_projection(tmp_path / "odd.npz")
