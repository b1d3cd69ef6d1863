"""BRISK descriptors of given keypoints."""

import cv2
import numpy as np

from maplab_py.vision.descriptors import differences, pack_words
from maplab_py.vision.features.description import DESCRIPTOR_BYTES, describe
from tests.vision.features.test_detection import mosaic


def keypoints(count: int = 60) -> np.ndarray:
    return np.random.default_rng(1).uniform([40, 40], [320, 200], (count, 2))


def distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    rows = np.arange(len(a))
    return differences(pack_words(a), rows, pack_words(b), rows)


def test_descriptors_recognise_keypoints_in_a_turned_image() -> None:
    image = cv2.GaussianBlur(mosaic(), (0, 0), 1.5)
    uv = keypoints()
    M = cv2.getRotationMatrix2D((180, 120), 8.0, 1.0)
    turned = cv2.warpAffine(image, M, (360, 240))
    uv_turned = uv @ M[:, :2].T + M[:, 2]
    size = np.full(len(uv), 12.0)
    first, _ = describe(image, uv, size)
    second, _ = describe(turned, uv_turned, size)
    same = distances(first, second)
    others = distances(first, np.roll(second, 1, axis=0))
    assert first.shape == (60, DESCRIPTOR_BYTES)
    assert np.median(same) < 0.4 * np.median(others)


def test_keypoints_near_the_border_have_no_descriptor() -> None:
    image = mosaic()
    uv = np.array([[100.0, 100.0], [3.0, 100.0], [200.0, 120.0], [350.0, 238.0], [100.0, 100.0]])
    descriptors, is_described = describe(image, uv, np.full(5, 12.0))
    assert is_described.tolist() == [True, False, True, False, True]
    assert not descriptors[~is_described].any()
    assert np.array_equal(descriptors[0], descriptors[4])
    alone, _ = describe(image, uv[2:3], np.full(1, 12.0))
    assert np.array_equal(descriptors[2], alone[0])


def test_keypoints_twenty_pixels_inside_are_described_at_the_default_size() -> None:
    image = mosaic()
    uv = np.array([[20.0, 20.0], [339.0, 20.0], [20.0, 219.0], [339.0, 219.0]])
    assert describe(image, uv, np.full(4, 12.0))[1].all()


def test_no_keypoints() -> None:
    descriptors, is_described = describe(mosaic(), np.zeros((0, 2)), np.zeros(0))
    assert descriptors.shape == (0, 64)
    assert is_described.shape == (0,)


def test_sizes_are_respected_for_each_keypoint() -> None:
    image, uv = cv2.GaussianBlur(mosaic(), (0, 0), 1.5), keypoints(2)
    small, _ = describe(image, uv, np.array([12.0, 12.0]))
    mixed, _ = describe(image, uv, np.array([12.0, 24.0]))
    assert np.array_equal(small[0], mixed[0])
    assert not np.array_equal(small[1], mixed[1])
