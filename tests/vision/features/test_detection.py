"""Detection: strong corners, spread over the grid, where they may be."""

import cv2
import numpy as np
import pytest

from maplab_py.array_types import U8
from maplab_py.vision.features.detection import GridDetector, strengths
from maplab_py.vision.features.options import FeatureOptions

NONE = np.zeros((0, 2))


def mosaic(seed: int = 0, contrast: float = 1.0) -> U8:
    """Return an image (240, 360) of overlapping rectangles."""
    rng = np.random.default_rng(seed)
    image = np.full((240, 360), 128.0)
    for _ in range(400):
        u, v = rng.integers(0, [360, 240])
        width, height = rng.integers(8, 40, 2)
        image[v : v + height, u : u + width] = rng.uniform(0.0, 255.0)
    image = 128.0 + contrast * (image - 128.0)
    return cv2.GaussianBlur(image, (0, 0), 0.7).astype(np.uint8)


def usable(image: U8, margin: int = 20) -> U8:
    mask = np.zeros_like(image)
    mask[margin:-margin, margin:-margin] = 255
    return mask


def detect(image: U8, options: FeatureOptions, mask: U8 | None = None, tracked=NONE):
    return GridDetector(options, usable(image) if mask is None else mask).detect(image, tracked)


@pytest.mark.parametrize("kind", ["fast", "agast"])
def test_corners_of_a_square(kind: str) -> None:
    image = np.full((120, 160), 60, dtype=np.uint8)
    image[40:80, 50:110] = 200
    image = cv2.GaussianBlur(image, (0, 0), 0.8)
    uv = detect(image, FeatureOptions(detector_type=kind, detector_nms_radius=8.0))
    corners = np.array([[50, 40], [109, 40], [50, 79], [109, 79]])
    nearest = np.linalg.norm(uv[:, None] - corners[None], axis=2)
    assert len(uv) == 4
    assert nearest.min(axis=1).max() <= 2.0
    assert nearest.min(axis=0).max() <= 2.0


def test_keypoints_keep_apart_from_each_other_and_from_tracks() -> None:
    image, tracked = mosaic(), np.array([[100.0, 100.0], [200.4, 99.7]])
    uv = detect(image, FeatureOptions(detector_nms_radius=17.0), tracked=tracked)
    every = np.concatenate([tracked, uv])
    distance = np.linalg.norm(every[:, None] - every[None], axis=2)
    np.fill_diagonal(distance, np.inf)
    assert len(uv) > 30
    assert distance.min() > 16.5  # tracks are counted at whole pixels


def test_limit_of_an_image_counts_tracks() -> None:
    image, options = mosaic(), FeatureOptions(detector_max_feature_count=40)
    assert len(detect(image, options)) == 40
    tracked = np.array([[100.0, 100.0], [200.0, 100.0], [150.0, 120.0]])
    assert len(detect(image, options, tracked=tracked)) == 37
    full = np.random.default_rng(0).uniform(30, 200, (40, 2))
    assert len(detect(image, options, tracked=full)) == 0


def test_no_cell_has_more_than_its_share() -> None:
    image = mosaic(contrast=0.3)
    image[:120, :90] = mosaic(seed=1)[:120, :90]  # the strongest corners of all
    options = FeatureOptions(
        detector_max_feature_count=40,
        gridded_detector_cell_num_features_scaler=1.0,
        detector_nms_radius=8.0,
    )
    uv = detect(image, options, usable(image, 4))
    cell = (uv[:, 1] // 120).astype(int) * 4 + (uv[:, 0] // 90).astype(int)
    assert np.bincount(cell, minlength=8).tolist() == [5] * 8


def test_strongest_corners_come_first() -> None:
    image = mosaic()
    uv = detect(image, FeatureOptions(detector_max_feature_count=60))
    strength = strengths(image, uv.astype(np.int64))
    assert np.all(np.diff(strength) <= 0.0)
    assert strength[-1] > 4.0


def test_strength_agrees_with_opencv() -> None:
    image = cv2.GaussianBlur(mosaic(), (0, 0), 2.0)
    uv = detect(image, FeatureOptions(detector_threshold=5)).astype(np.int64)
    expected = cv2.cornerMinEigenVal(image, 7, ksize=3, borderType=cv2.BORDER_DEFAULT)
    ratio = strengths(image, uv) / expected[uv[:, 1], uv[:, 0]]
    # the same window of 7 x 7; Sobel smooths across the derivative, central differences do not
    assert len(uv) > 20
    assert np.std(ratio) / np.mean(ratio) < 0.05


def test_a_faint_cell_gets_keypoints_by_a_lower_threshold() -> None:
    image = mosaic()
    image[:120, :90] = mosaic(contrast=0.2)[:120, :90]
    uv = detect(image, FeatureOptions(detector_threshold=54, detector_nms_radius=8.0))
    faint = (uv[:, 0] < 85) & (uv[:, 1] < 115)
    assert np.count_nonzero(faint) >= 3
    strict = cv2.FastFeatureDetector_create(54).detect(image[:110, :80])
    assert len(strict) == 0


def test_masks_and_borders_are_respected() -> None:
    image, mask = mosaic(), np.zeros((240, 360), dtype=np.uint8)
    mask[50:150, 100:300] = 255
    uv = detect(image, FeatureOptions(), mask)
    assert len(uv) > 20
    assert uv.min(axis=0).tolist() >= [100, 50]
    assert (uv[:, 0] < 300).all()
    assert (uv[:, 1] < 150).all()


@pytest.mark.parametrize("grey", [0, 128, 255])
def test_an_image_without_contrast_has_none(grey: int) -> None:
    image = np.full((240, 360), grey, dtype=np.uint8)
    assert detect(image, FeatureOptions()).shape == (0, 2)


def test_noise_of_a_dark_image_is_no_corner() -> None:
    noise = np.random.default_rng(0).normal(5.0, 1.5, (240, 360))
    image = np.clip(np.round(noise), 0, 255).astype(np.uint8)
    assert len(detect(image, FeatureOptions())) == 0
