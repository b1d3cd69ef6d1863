"""Tracks that several cameras of a rig see, on rendered images."""

import dataclasses

import cv2
import numpy as np

from maplab_py.array_types import F64
from maplab_py.geometry import se3
from maplab_py.vision.features.options import FeatureOptions
from maplab_py.vision.tracking.tracker import FrameTracker
from maplab_py.vision.tracking.tracks import TrackedImages
from maplab_py.vision.tracking.views import CameraView, leaders, seen_by, usable_alone
from tests.vision.tracking.rendered import (
    HEIGHT,
    WIDTH,
    Rig,
    back_to_back,
    pixels_at,
    points_at,
    pose,
    stereo,
)
from tests.vision.tracking.test_tracker import OPTIONS, common, run


def views_of(rig: Rig) -> tuple[CameraView, ...]:
    return tuple(
        CameraView.of(camera, row, rig.T_I_C[row], FeatureOptions())
        for row, camera in enumerate(rig.cameras)
    )


def stereo_errors_px(rig: Rig, T_G_I: F64, images: TrackedImages) -> F64:
    """Return how far shared keypoints of camera 1 are from where camera 0 sees their points."""
    T_G_C = se3.compose(T_G_I, rig.T_I_C)
    a, b = common(*images.cameras)
    return np.linalg.norm(pixels_at(T_G_C[1], points_at(T_G_C[0], a)) - b, axis=1)


def test_a_point_has_the_same_id_in_both_cameras() -> None:
    rig, poses = stereo(), [pose(x=0.02 * k, y=0.01 * k, yaw=0.01 * k) for k in range(4)]
    tracked = run(rig, poses)
    for T_G_I, images in zip(poses, tracked, strict=True):
        errors = stereo_errors_px(rig, T_G_I, images)
        assert len(errors) > 0.6 * len(images.cameras[0])
        assert np.median(errors) < 0.15
        assert np.mean(errors < 1.0) > 0.93
        assert all(len(c) == len(np.unique(c.track_id)) for c in images.cameras)
    assert set(tracked[-1].stage_ms) == {"prepare", "flow", "outliers", "detect", "stereo"}


def test_near_points_are_matched() -> None:
    """A box 0.8 m away, 2.6 m in front of a wall: disparities of 8 and of 34 px."""
    rig, T_G_I = stereo(), pose(x=1.4, y=0.8)
    (images,) = run(rig, [T_G_I])
    T_G_C = se3.compose(T_G_I, rig.T_I_C)
    a, b = common(*images.cameras)
    disparity = np.linalg.norm(a - b, axis=1)
    errors = stereo_errors_px(rig, T_G_I, images)
    assert np.count_nonzero(disparity > 25.0) >= 8
    assert np.mean(errors < 1.5) > 0.85
    depth = np.linalg.norm(points_at(T_G_C[0], a) - T_G_C[0, 4:], axis=1)
    assert depth.min() < 0.95


def test_the_second_camera_follows_keypoints_only_where_the_first_does_not_look() -> None:
    rig = stereo()
    tracked = run(rig, [pose(y=0.02 * k) for k in range(3)])
    first, second = views_of(rig)
    alone = usable_alone(second, first)
    for images in tracked:
        tracks = images.cameras[1]
        is_new = (tracks.num_frames == 1) & ~np.isin(tracks.track_id, images.cameras[0].track_id)
        whole = np.round(tracks.uv_px[is_new]).astype(int)
        assert (alone[whole[:, 1], whole[:, 0]] > 0).all()
    assert leaders((first, second)) == [0, 0]
    assert 0.85 < np.mean(seen_by(second, first)) < 1.0


def test_cameras_that_see_different_things_track_for_themselves() -> None:
    rig = back_to_back()
    tracked = run(rig, [pose(y=0.02 * k) for k in range(3)])
    assert leaders(views_of(rig)) == [0, 1]
    for images in tracked:
        ids = [camera.track_id for camera in images.cameras]
        assert not np.intersect1d(*ids).size
        assert min(len(i) for i in ids) > 60
    ends = (images.cameras[1] for images in (tracked[0], tracked[-1]))
    assert len(common(*ends)[0]) > 40


def test_a_black_camera_leaves_the_other_alone() -> None:
    rig = stereo()
    tracker = FrameTracker(rig.cameras, rig.T_I_C, OPTIONS)
    left, right = rig.images(pose())
    both = tracker.track(0, (left, right))
    dark = tracker.track(1, (left, np.zeros_like(right)), np.eye(3))
    again = tracker.track(2, (left, right), np.eye(3))
    assert len(dark.cameras[1]) == 0
    assert len(common(both.cameras[0], dark.cameras[0])[0]) > 0.9 * len(both.cameras[0])
    assert len(common(*again.cameras)[0]) > 0.8 * len(common(*both.cameras)[0])


def test_points_off_their_epipolar_line_are_not_matched() -> None:
    """The second image is shifted down: what is found lies 4 px off."""
    rig = stereo()
    left, right = rig.images(pose())
    shifted = np.roll(right, 4, axis=0)
    tracker = FrameTracker(rig.cameras, rig.T_I_C, OPTIONS)
    images = tracker.track(0, (left, shifted))
    aligned = FrameTracker(rig.cameras, rig.T_I_C, OPTIONS).track(0, (left, right))
    assert len(common(*images.cameras)[0]) < 0.1 * len(common(*aligned.cameras)[0])


def test_cameras_of_different_sizes() -> None:
    """Half the size means a level less: points are sought on those that both images have."""
    rig, T_G_I = stereo(), pose()
    first, second = rig.cameras
    half = dataclasses.replace(
        second, intrinsics=second.intrinsics / 2.0, width_px=WIDTH // 2, height_px=HEIGHT // 2
    )
    left, right = rig.images(T_G_I)
    small = np.asarray(cv2.resize(right, (WIDTH // 2, HEIGHT // 2)), dtype=np.uint8)
    for cameras, images in (((first, half), (left, small)), ((half, first), (small, left))):
        tracker = FrameTracker(cameras, rig.T_I_C, OPTIONS)
        tracker.track(0, images)
        tracked = tracker.track(1, images, np.eye(3))
        assert np.count_nonzero(tracked.cameras[0].num_frames == 2) > 20
