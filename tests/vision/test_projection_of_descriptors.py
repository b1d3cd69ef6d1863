import numpy as np
import pytest

from maplab_py.errors import EstimationError
from maplab_py.vision.projection import DescriptorProjection, learn_projection
from tests.vision.synthetic import tracks


def nearest_is_same_track(points, label):
    distance = np.sum((points[:, None] - points[None]) ** 2, axis=2)
    np.fill_diagonal(distance, np.inf)
    return np.mean(label[np.argmin(distance, axis=1)] == label)


def test_learned_metric_separates_tracks_better_than_hamming():
    descriptors, label = tracks(300, 6, flips=0.12, seed=1)
    projection = learn_projection(descriptors, label)
    unseen, unseen_label = tracks(300, 6, flips=0.12, seed=1)
    bits = np.unpackbits(unseen, axis=1).astype(np.float64)
    learned = nearest_is_same_track(projection.project(unseen), unseen_label)
    assert learned > 0.9
    assert learned > nearest_is_same_track(bits[:, ::38], unseen_label)  # as many plain bits


def test_noise_bits_get_no_weight():
    descriptors, label = tracks(400, 8, flips=0.1, seed=2)
    matrix = learn_projection(descriptors, label).matrix
    useful, noise = np.split(matrix, 2, axis=1)
    assert np.linalg.norm(noise) < 0.35 * np.linalg.norm(useful)


@pytest.mark.parametrize("size", [32, 48, 64])
def test_projects_descriptors_of_any_length_linearly(size):
    descriptors, label = tracks(80, 5, flips=0.1, seed=3, size=size)
    projection = learn_projection(descriptors, label)
    assert projection.matrix.shape == (10, 8 * size)
    expected = np.unpackbits(descriptors, axis=1) @ projection.matrix.T.astype(np.float64)
    np.testing.assert_allclose(projection.project(descriptors), expected, atol=1e-3)


def test_learning_is_repeatable_to_the_bit():
    descriptors, label = tracks(200, 5, flips=0.1, seed=4)
    first = learn_projection(descriptors, label).matrix
    assert first.tobytes() == learn_projection(descriptors, label).matrix.tobytes()


def test_short_tracks_serve_when_there_are_no_long_ones():
    descriptors, label = tracks(100, 2, flips=0.05, seed=5)
    assert np.all(np.isfinite(learn_projection(descriptors, label).matrix))


def test_too_few_tracks_are_refused():
    descriptors, label = tracks(10, 5, flips=0.05, seed=6)
    with pytest.raises(EstimationError, match="fewer than 50 tracks"):
        learn_projection(descriptors, label)
    with pytest.raises(EstimationError, match="fewer than 50 tracks"):
        learn_projection(descriptors, np.full_like(label, -1))


def test_descriptors_of_another_length_are_refused():
    projection = DescriptorProjection(np.zeros((10, 8 * 48), dtype=np.float32))
    with pytest.raises(EstimationError, match="48 bytes, not 64"):
        projection.project(np.zeros((3, 64), dtype=np.uint8))
