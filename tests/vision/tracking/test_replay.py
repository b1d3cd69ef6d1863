"""Keypoints that are tracked already, in the form of the tracker."""

import dataclasses

import numpy as np
import pytest

from maplab_py.array_types import F64, I32
from maplab_py.interop.recordings.map_replay import MapRecording
from maplab_py.interop.recordings.protocol import TrackedFrame, TrackedFrameSet
from maplab_py.storage.native import load_map
from maplab_py.vision.tracking.replay import tracked_images_of
from tests.support.data import shared_data
from tests.vision.tracking.rendered import Rig, mono, pose, turn
from tests.vision.tracking.test_tracker import run


def frame(uv_px: F64, track_id: I32) -> TrackedFrame:
    count = len(track_id)
    return TrackedFrame(
        camera=0,
        stamp_ns=0,
        uv_px=uv_px,
        sigma_px=np.linspace(0.5, 1.5, count),
        scale=np.linspace(10.0, 20.0, count),
        track_id=track_id,
        descriptor=np.zeros((count, 48), dtype=np.uint8),
        descriptor_size=np.full(count, 48, dtype=np.int32),
    )


def test_keypoints_on_no_track_and_repeated_tracks_are_left_out() -> None:
    rig = mono()
    uv = np.arange(10.0).reshape(5, 2) + 100.0
    ids = np.array([7, -1, 3, 7, 12], dtype=np.int32)
    images = tracked_images_of(TrackedFrameSet(5, (frame(uv, ids),)), None, rig.cameras, rig.T_I_C)
    tracks = images.cameras[0]
    assert images.time_ns == 5
    assert tracks.track_id.tolist() == [7, 3, 12]
    np.testing.assert_array_equal(tracks.uv_px, uv[[0, 2, 4]])
    np.testing.assert_array_equal(tracks.sigma_px, [0.5, 1.0, 1.5])
    np.testing.assert_array_equal(tracks.scale, [10.0, 15.0, 20.0])
    assert tracks.num_frames.tolist() == [1, 1, 1]
    assert np.isnan(images.disparity_px)
    assert not images.is_turn_only


def test_frames_are_counted_over_all_cameras() -> None:
    rig = Rig(mono().cameras * 2, np.tile(mono().T_I_C, (2, 1)))
    uv = np.array([[100.0, 100.0], [150.0, 90.0]])
    ids = np.array([1, 2], dtype=np.int32)
    first = TrackedFrameSet(0, (frame(uv, ids), None))
    second = TrackedFrameSet(1, (frame(uv[1:], ids[1:]), frame(uv, ids)))
    third = TrackedFrameSet(2, (None, frame(uv, ids)))
    images = None
    for frames in (first, second, third):
        images = tracked_images_of(frames, images, rig.cameras, rig.T_I_C, np.eye(3))
    assert images is not None
    assert len(images.cameras[0]) == 0
    assert images.cameras[1].num_frames.tolist() == [3, 3]
    assert images.disparity_px == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("step_m", [0.0, 0.04])
def test_motion_agrees_with_the_tracker(step_m: float) -> None:
    rig = Rig(mono().cameras, mono().T_I_C * np.array([1, 1, 1, 1, 0, 0, 0]))
    poses = [pose(y=step_m * k, yaw=0.03 * k) for k in range(3)]
    previous = None
    for k, images in enumerate(run(rig, poses)):
        columns = images.cameras[0]
        frames = TrackedFrameSet(k, (frame(columns.uv_px, columns.track_id.astype(np.int32)),))
        R = turn(poses[k - 1], poses[k]) if k else None
        replayed = tracked_images_of(frames, previous, rig.cameras, rig.T_I_C, R)
        np.testing.assert_array_equal(replayed.cameras[0].num_frames, columns.num_frames)
        np.testing.assert_array_equal(replayed.cameras[0].track_id, columns.track_id)
        assert replayed.is_turn_only == images.is_turn_only == (k > 0 and step_m == 0.0)
        if k:
            assert replayed.disparity_px == pytest.approx(images.disparity_px, rel=0.02)
        previous = replayed


def test_a_recorded_mission() -> None:
    vi_map = load_map(shared_data("maplab_maps/tango_handheld"))[0]
    recording = MapRecording(vi_map, 0)
    device, previous, disparity = recording.device, None, []
    sets = (item for item in recording.items() if isinstance(item, TrackedFrameSet))
    for frames, _ in zip(sets, range(40), strict=False):
        images = tracked_images_of(frames, previous, device.cameras, device.T_I_C)
        keypoints = frames.frames[0]
        assert keypoints is not None
        assert len(images.cameras[0]) == len(np.unique(keypoints.track_id[keypoints.track_id >= 0]))
        disparity.append(images.disparity_px)
        previous = dataclasses.replace(images)
    assert previous is not None
    assert previous.cameras[0].num_frames.max() > 10
    assert np.isfinite(disparity[1:]).all()
    assert 0.1 < np.median(disparity[1:]) < 30.0
