"""The tracker on rendered and warped images of known motion."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest

from maplab_py.array_types import F64, U8
from maplab_py.errors import FlagError, MapError
from maplab_py.geometry import se3
from maplab_py.vision.tracking.options import TrackingOptions
from maplab_py.vision.tracking.tracker import FrameTracker
from maplab_py.vision.tracking.tracks import CameraTracks, TrackedImages
from tests.vision.features.test_detection import mosaic
from tests.vision.tracking.rendered import (
    HEIGHT,
    WIDTH,
    Rig,
    image_at,
    mono,
    pixels_at,
    points_at,
    pose,
    turn,
)

OPTIONS = TrackingOptions(detector_max_feature_count=120, detector_nms_radius=10.0)


def run(rig: Rig, poses: list[F64], options: TrackingOptions = OPTIONS) -> list[TrackedImages]:
    tracker = FrameTracker(rig.cameras, rig.T_I_C, options)
    tracked, previous = [], None
    for number, T_G_I in enumerate(poses):
        R_I0_I1 = None if previous is None else turn(previous, T_G_I)
        tracked.append(tracker.track(number * 50_000_000, rig.images(T_G_I), R_I0_I1))
        previous = T_G_I
    return tracked


def common(a: CameraTracks, b: CameraTracks) -> tuple[F64, F64]:
    _, i, j = np.intersect1d(a.track_id, b.track_id, return_indices=True)
    return a.uv_px[i], b.uv_px[j]


def errors_px(rig: Rig, poses: list[F64], tracked: list[TrackedImages]) -> F64:
    """Return how far tracks from the first to the last image are from where their points are."""
    first, last = (se3.compose(T, rig.T_I_C[0]) for T in (poses[0], poses[-1]))
    a, b = common(tracked[0].cameras[0], tracked[-1].cameras[0])
    return np.linalg.norm(pixels_at(last, points_at(first, a)) - b, axis=1)


def test_a_translation() -> None:
    poses = [pose(x=0.02 * k, y=0.03 * k) for k in range(6)]
    tracked = run(mono(), poses)
    errors = errors_px(mono(), poses, tracked)
    assert len(errors) > 0.6 * len(tracked[0].cameras[0])
    assert np.median(errors) < 0.15
    assert np.percentile(errors, 90) < 0.6
    assert not any(images.is_turn_only for images in tracked[1:])
    assert tracked[1].disparity_px > 1.0
    expected = np.linalg.norm(np.subtract(*common(*(t.cameras[0] for t in tracked[:2]))), axis=1)
    assert tracked[1].disparity_px == pytest.approx(np.median(expected), rel=0.05)
    assert np.isnan(tracked[0].disparity_px)


def test_a_turn_on_the_spot() -> None:
    rig = Rig(mono().cameras, se3.make(mono().T_I_C[:, :4], np.zeros((1, 3))))
    poses = [pose(yaw=0.05 * k, roll=0.03 * k) for k in range(4)]
    tracked = run(rig, poses)
    for images in tracked[1:]:
        assert images.is_turn_only
        assert images.disparity_px < 0.2
    assert np.median(errors_px(rig, poses, tracked)) < 0.15


def test_the_gyroscope_finds_what_a_fast_turn_has_moved_far() -> None:
    poses = [pose(), pose(yaw=0.5, roll=0.3)]  # a hundred pixels and more
    rig = mono()
    (_, known) = run(rig, poses)
    tracker = FrameTracker(rig.cameras, rig.T_I_C, OPTIONS)
    first = tracker.track(0, rig.images(poses[0]))
    unknown = tracker.track(1, rig.images(poses[1]))
    errors = errors_px(rig, poses, [first, known])
    assert len(errors) >= 25
    assert np.mean(errors < 1.0) > 0.9
    assert len(common(first.cameras[0], unknown.cameras[0])[0]) < 0.4 * len(errors)


def test_what_moves_by_itself_is_an_outlier() -> None:
    rig, poses = mono(), [pose(), pose(y=0.04)]
    images = [rig.images(T)[0].copy() for T in poses]
    patch = mosaic(4)[:80, :100]
    images[0][80:160, 140:240] = patch
    images[1][86:166, 140:240] = patch  # across the epipolar lines
    tracker = FrameTracker(rig.cameras, rig.T_I_C, OPTIONS)
    first = tracker.track(0, (images[0],)).cameras[0]
    second = tracker.track(1, (images[1],), np.eye(3)).cameras[0]
    u, v = first.uv_px.T
    on_patch = (u > 150) & (u < 230) & (v > 90) & (v < 150)
    left = np.isin(first.track_id, second.track_id)
    assert np.count_nonzero(on_patch) >= 8
    assert not left[on_patch].any()
    outside = (u < 130) | (u > 250) | (v < 70) | (v > 170)
    assert left[outside].mean() > 0.7


def test_tracks_are_numbered_and_counted() -> None:
    tracked = run(mono(), [pose(y=0.02 * k) for k in range(5)])
    every = np.concatenate([images.cameras[0].track_id for images in tracked])
    seen = np.zeros(every.max() + 1, dtype=np.int64)
    for images in tracked:
        tracks = images.cameras[0]
        assert len(np.unique(tracks.track_id)) == len(tracks)
        seen[tracks.track_id] += 1
        assert np.array_equal(tracks.num_frames, seen[tracks.track_id])
        assert (tracks.sigma_px == OPTIONS.keypoint_sigma_px).all()
        assert (tracks.scale == OPTIONS.descriptor_size_px).all()
        assert len(tracks) <= 120
    assert set(tracked[-1].stage_ms) == {"prepare", "flow", "outliers", "detect"}


def test_reset_forgets_tracks_but_no_ids() -> None:
    rig, tracker = mono(), FrameTracker(mono().cameras, mono().T_I_C, OPTIONS)
    first = tracker.track(0, rig.images(pose()))
    tracker.reset()
    second = tracker.track(1, rig.images(pose()), np.eye(3))
    assert not np.intersect1d(first.cameras[0].track_id, second.cameras[0].track_id).size
    assert (second.cameras[0].num_frames == 1).all()
    assert np.isnan(second.disparity_px)
    assert not second.is_turn_only
    assert np.array_equal(first.cameras[0].uv_px, second.cameras[0].uv_px)


def test_black_images_end_all_tracks() -> None:
    rig, tracker = mono(), FrameTracker(mono().cameras, mono().T_I_C, OPTIONS)
    black = (np.zeros((HEIGHT, WIDTH), dtype=np.uint8),)
    assert len(tracker.track(0, black).cameras[0]) == 0
    seen = tracker.track(1, rig.images(pose()), np.eye(3))
    dark = tracker.track(2, black, np.eye(3))
    again = tracker.track(3, rig.images(pose()), np.eye(3))
    assert len(seen.cameras[0]) > 80
    assert len(dark.cameras[0]) == 0
    assert np.isnan(dark.disparity_px)
    assert not dark.is_turn_only
    assert len(again.cameras[0]) == len(seen.cameras[0])
    assert again.cameras[0].track_id.min() > seen.cameras[0].track_id.max()


def test_a_mask_keeps_tracks_out(tmp_path: Path) -> None:
    mask = np.full((HEIGHT, WIDTH), 255, dtype=np.uint8)
    mask[:, 200:] = 0
    assert cv2.imwrite(str(tmp_path / "mask.png"), mask)
    options = dataclasses.replace(OPTIONS, image_mask_path=str(tmp_path / "mask.png"))
    for images in run(mono(), [pose(yaw=-0.05 * k) for k in range(3)], options):
        assert len(images.cameras[0]) > 30
        assert images.cameras[0].uv_px[:, 0].max() < 200.5


def test_a_resized_image_gives_recorded_pixels() -> None:
    poses = [pose(y=0.02 * k) for k in range(3)]
    options = dataclasses.replace(OPTIONS, image_resize_factor=0.6)
    tracked = run(mono(), poses, options)
    errors = errors_px(mono(), poses, tracked)
    assert len(errors) > 30
    assert np.median(errors) < 0.3
    assert tracked[0].cameras[0].uv_px[:, 0].max() > 300.0


def test_equalised_contrast_finds_keypoints_in_the_dark() -> None:
    image = (mono().images(pose())[0] // 12).astype(np.uint8)
    counts = []
    for options in (OPTIONS, dataclasses.replace(OPTIONS, apply_clahe=True)):
        tracker = FrameTracker(mono().cameras, mono().T_I_C, options)
        counts.append(len(tracker.track(0, (image,)).cameras[0]))
    assert counts[1] > 1.3 * counts[0]


def test_threads_and_repetition_do_not_matter() -> None:
    poses, before, runs = (
        [pose(y=0.03 * k, yaw=0.02 * k) for k in range(4)],
        cv2.getNumThreads(),
        [],
    )
    try:
        for threads in (1, 2, 2):
            cv2.setNumThreads(threads)
            tracked = run(mono(), poses)
            columns = [images.cameras[0] for images in tracked]
            runs.append(b"".join(c.uv_px.tobytes() + c.track_id.tobytes() for c in columns))
    finally:
        cv2.setNumThreads(before)
    assert len(set(runs)) == 1


def test_wrong_input_is_refused() -> None:
    rig = mono()
    tracker = FrameTracker(rig.cameras, rig.T_I_C)
    image: U8 = image_at(pose())
    with pytest.raises(MapError, match="2 images of 1 cameras"):
        tracker.track(0, (image, image))
    with pytest.raises(MapError, match=r"camera 0: an image of 376 x 100 pixels"):
        tracker.track(0, (image[:100],))
    with pytest.raises(FlagError, match="--feature_tracking_patch_size_px=8: wants an odd number"):
        FrameTracker(rig.cameras, rig.T_I_C, TrackingOptions(patch_size_px=8))
    with pytest.raises(FlagError, match="--feature_tracker_two_pt_ransac_threshold=2"):
        FrameTracker(rig.cameras, rig.T_I_C, TrackingOptions(two_pt_ransac_threshold=2.0))
    with pytest.raises(FlagError, match="freak"):
        FrameTracker(rig.cameras, rig.T_I_C, TrackingOptions(descriptor_type="freak"))
