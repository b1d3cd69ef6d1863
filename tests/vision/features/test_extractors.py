"""Features of OpenCV on recorded images: how many agree between neighbours."""

import itertools

import cv2
import numpy as np
import pytest

from maplab_py.vision.features.extension import ExtractedFeatures
from maplab_py.vision.features.extractors import KINDS, extract
from tests.support.data import shared_data

MIN_INLIERS = {"sift": 200, "brisk": 140}
K = np.array([[458.654, 0.0, 367.215], [0.0, 457.296, 248.375], [0.0, 0.0, 1.0]])
DISTORTION = np.array([-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05])


def undistorted(uv_px: np.ndarray) -> np.ndarray:
    return cv2.undistortPoints(uv_px[:, None], K, DISTORTION, P=K)[:, 0]


def inliers(a: ExtractedFeatures, b: ExtractedFeatures, name: str) -> int:
    """Return the matches (ratio 0.8) that a fundamental matrix of OpenCV explains within 3 pixels."""
    is_sift = name == "sift"
    norm, kind = (cv2.NORM_L2, np.float32) if is_sift else (cv2.NORM_HAMMING, np.uint8)
    matcher = cv2.BFMatcher(norm)
    pairs = matcher.knnMatch(a.descriptors.astype(kind), b.descriptors.astype(kind), k=2)
    good = [best for best, second in pairs if best.distance < 0.8 * second.distance]
    if len(good) < 8:
        return 0
    uv_a = undistorted(a.keypoints_px[[match.queryIdx for match in good]])
    uv_b = undistorted(b.keypoints_px[[match.trainIdx for match in good]])
    _, mask = cv2.findFundamentalMat(uv_a, uv_b, cv2.FM_RANSAC, 3.0, 0.999)
    return 0 if mask is None else int(mask.sum())


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(MIN_INLIERS))
def test_neighbouring_recorded_images_agree(name: str) -> None:
    files = sorted(shared_data("euroc_v101_keyframes/mav0/cam0/data").glob("*.jpg"))
    images = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in files]
    features = [extract(name, image, 1000) for image in images]
    assert max(len(part.scores) for part in features) == 1000
    counts = [inliers(a, b, name) for a, b in itertools.pairwise(features)]
    assert np.median(counts) >= MIN_INLIERS[name]


@pytest.mark.parametrize("name", sorted(KINDS.keys() - {"xfeat"}))
def test_an_image_without_contrast_has_no_features(name: str) -> None:
    features = extract(name, np.full((240, 320), 90, dtype=np.uint8), 100)
    assert features.keypoints_px.shape == (0, 2)
    assert features.descriptors.shape == (0, KINDS[name].size)
    assert len(features.scores) == 0


def test_the_strongest_features_come_first_and_turn_with_the_image() -> None:
    rng = np.random.default_rng(0)
    image = cv2.GaussianBlur(rng.integers(0, 255, (200, 300)).astype(np.uint8), (0, 0), 2.0)
    image = cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX)
    features = extract("sift", image, 80)
    assert np.all(np.diff(features.scores) <= 0.0)
    few = extract("sift", image, 20)
    assert set(map(tuple, few.keypoints_px)) <= set(map(tuple, features.keypoints_px))
    # keypoints of the image turned by half a turn are where they were, whole pixels at centres
    turned = extract("sift", image[::-1, ::-1], 80)
    back = np.array([299.0, 199.0]) - turned.keypoints_px
    gap = np.linalg.norm(features.keypoints_px[:, None] - back[None], axis=2).min(axis=1)
    assert np.median(gap) < 0.1
