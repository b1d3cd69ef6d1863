"""Keypoints stay on their points: alignment with the first image, corners in fractions of a pixel."""

import cv2
import numpy as np
import pytest

from maplab_py.array_types import F64, U8
from maplab_py.geometry import se3
from maplab_py.vision.features.detection import GridDetector, refined
from maplab_py.vision.tracking.options import TrackingOptions
from maplab_py.vision.tracking.tracker import FrameTracker, align, patches
from tests.vision.features.test_detection import mosaic
from tests.vision.tracking.rendered import mono, pixels_at, points_at, pose, turn

OPTIONS = TrackingOptions(detector_max_feature_count=120, detector_nms_radius=10.0)


def smooth() -> U8:
    return np.asarray(cv2.GaussianBlur(mosaic(), (0, 0), 1.0), dtype=np.uint8)


def corners(image: U8, border: int = 50) -> F64:
    """Return corners (N, 2) away from the border."""
    usable = np.zeros(image.shape, dtype=np.uint8)
    usable[border:-border, border:-border] = 255
    return refined(image, GridDetector(OPTIONS, usable).detect(image, np.zeros((0, 2))))


CENTRES = corners(smooth())


def test_keypoints_do_not_drift() -> None:
    rig = mono()
    poses = [pose(x=0.02 * k, y=0.012 * k, yaw=0.004 * k, roll=0.01 * k) for k in range(40)]
    tracker, before = FrameTracker(rig.cameras, rig.T_I_C, OPTIONS), None
    first: dict[int, F64] = {}
    errors_px = []
    for number, T_G_I in enumerate(poses):
        known = None if before is None else turn(before, T_G_I)
        tracks = tracker.track(number, rig.images(T_G_I), known).cameras[0]
        before, T_G_C = T_G_I, se3.compose(T_G_I, rig.T_I_C[0])
        points = points_at(T_G_C, tracks.uv_px)
        for track_id, point in zip(tracks.track_id.tolist(), points, strict=True):
            first.setdefault(track_id, point)
        old = tracks.num_frames >= 20
        if old.any():
            expected = np.stack([first[i] for i in tracks.track_id[old].tolist()])
            errors_px.append(np.linalg.norm(pixels_at(T_G_C, expected) - tracks.uv_px[old], axis=1))
    errors = np.concatenate(errors_px)
    assert len(errors) > 400
    assert np.median(errors) < 0.15  # 0.5 by Lucas-Kanade from image to image
    assert np.percentile(errors, 80) < 0.4


@pytest.mark.parametrize("gain", [1.0, 0.6])
def test_the_affine_warp_of_an_image_is_recovered(gain: float) -> None:
    image = smooth()
    warp = np.array([[1.12, 0.08], [-0.05, 0.93]])
    middle = np.array([180.0, 120.0])
    M = np.column_stack([warp, middle - warp @ middle])
    later = gain * cv2.warpAffine(image, M, image.shape[::-1], borderMode=cv2.BORDER_REFLECT) + 7.0
    later = np.round(later).astype(np.uint8)
    expected = CENTRES @ warp.T + M[:, 2]
    start = expected + np.random.default_rng(2).uniform(-0.4, 0.4, CENTRES.shape)
    warps = np.tile(np.eye(2), (len(CENTRES), 1, 1))
    uv, patch = start, patches(image, CENTRES)
    for _ in range(4):  # the change of a warp from image to image is bounded
        aligned = align(later, uv, patch, warps)
        uv, warps = aligned.uv, aligned.warp
    error_px = np.linalg.norm(uv - expected, axis=1)
    assert np.median(error_px) < 0.06
    assert np.mean(error_px < 0.2) >= 0.75
    assert np.array_equal(aligned.patch[error_px < 0.2], patch[error_px < 0.2])
    assert np.median(np.abs(warps - warp), axis=0).max() < 0.05


def test_what_an_image_does_not_show_stays_and_begins_again() -> None:
    image, other = smooth(), np.ascontiguousarray(smooth()[::-1, ::-1])
    warps = np.tile(np.eye(2), (len(CENTRES), 1, 1))
    aligned = align(other, CENTRES, patches(image, CENTRES), warps)
    began = np.any(aligned.patch != patches(image, CENTRES), axis=(1, 2))
    assert began.mean() > 0.7
    assert np.array_equal(aligned.uv[began], CENTRES[began])
    assert np.array_equal(aligned.patch[began], patches(other, CENTRES)[began])
    assert np.array_equal(aligned.warp[began], warps[began])


def test_a_large_change_of_scale_begins_again() -> None:
    image = smooth()
    later = cv2.resize(image, None, fx=2.0, fy=2.0, interpolation=cv2.INTER_LINEAR)
    centres = CENTRES[[0, 1, 4, 5]]
    uv = 2.0 * centres + 0.5
    warps = np.tile(2.0 * np.eye(2), (len(uv), 1, 1))
    aligned = align(later, uv, patches(image, centres), warps)
    assert np.linalg.norm(aligned.uv - uv, axis=1).max() < 0.3
    assert np.array_equal(aligned.warp, np.tile(np.eye(2), (len(uv), 1, 1)))


@pytest.mark.parametrize("grey", [0, 255])
def test_without_contrast_keypoints_stay(grey: int) -> None:
    flat = np.full((240, 360), grey, dtype=np.uint8)
    warps = np.tile(np.eye(2), (len(CENTRES), 1, 1))
    aligned = align(flat, CENTRES, patches(smooth(), CENTRES), warps)
    assert np.array_equal(aligned.uv, CENTRES)
    assert np.isfinite(aligned.patch).all()


def test_keypoints_at_the_border_and_none() -> None:
    image = smooth()
    uv = np.array([[0.0, 0.0], [359.0, 239.0], [3.5, 120.0], [180.0, 236.5]])
    aligned = align(image, uv, patches(image, uv), np.tile(np.eye(2), (4, 1, 1)))
    assert np.array_equal(aligned.uv, uv)
    nothing = align(image, uv[:0], patches(image, uv[:0]), np.zeros((0, 2, 2)))
    assert nothing.uv.shape == (0, 2)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.3, 0.7), (0.5, 0.5)])
def test_corners_are_found_in_fractions_of_a_pixel(shift: tuple[float, float]) -> None:
    """A square painted at eight times the resolution; blur moves its corners inwards."""
    fine = np.full((8 * 80, 8 * 80), 60, dtype=np.uint8)
    low, high = np.array([24.0, 28.0]) + shift, np.array([52.0, 50.0]) + shift
    a, b = np.round(8 * low).astype(int), np.round(8 * high).astype(int)
    fine[a[1] : b[1], a[0] : b[0]] = 190
    image = cv2.GaussianBlur(cv2.resize(fine, (80, 80), interpolation=cv2.INTER_AREA), (0, 0), 0.8)
    # the centre of pixel 0 is at 0
    tips = np.array([[x, y] for x in (low[0], high[0]) for y in (low[1], high[1])]) - 0.5
    inwards = np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])
    corner = refined(image, np.round(tips) + 2 * inwards)
    offset = (corner - tips) * inwards
    assert offset.min() > -0.25
    assert offset.max() < 0.5
    # from wherever the segment test puts them
    for start in (np.round(tips) + inwards, np.round(tips)):
        assert np.abs(refined(image, start) - corner).max() < 0.05


def test_corners_at_the_border_stay_near_it() -> None:
    image = smooth()
    uv = np.array([[1.0, 2.0], [358.0, 238.0]])
    assert np.linalg.norm(refined(image, uv) - uv, axis=1).max() <= 2.0
    assert refined(image, uv[:0]).shape == (0, 2)


def test_places_that_are_no_numbers_or_outside_read_nothing_outside_the_image() -> None:
    image = np.full((48, 64), 7, dtype=np.uint8)
    nowhere = np.array([[np.nan, np.nan], [1e9, -1e9], [np.inf, -np.inf]])
    np.testing.assert_array_equal(patches(image, nowhere), 7.0)
    aligned = align(image, nowhere, patches(image, nowhere), np.tile(np.eye(2), (3, 1, 1)))
    np.testing.assert_array_equal(aligned.warp, np.tile(np.eye(2), (3, 1, 1)))
