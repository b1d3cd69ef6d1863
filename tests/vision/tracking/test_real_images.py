"""The tracker on ten seconds of EuRoC MH_01: life of tracks, and agreement with the true motion."""

from functools import cache

import numpy as np
import pytest

from maplab_py.array_types import F64, I64
from maplab_py.geometry import interpolation, se3, so3
from maplab_py.interop.recordings import protocol, reader_choice, stream
from maplab_py.interop.recordings.options import SourceOptions
from maplab_py.interop.trajectories import Trajectory, read_trajectory
from maplab_py.sensors.projection import back_project
from maplab_py.vision.tracking.tracker import FrameTracker
from maplab_py.vision.tracking.tracks import TrackedImages
from tests.support.data import shared_data

FOLDER = "euroc_mh01_10s"
TRUTH = "mav0/state_groundtruth_estimate0/data.csv"


@cache
def truth() -> Trajectory:
    return read_trajectory(shared_data(FOLDER) / TRUTH)


def true_poses(times_ns: I64) -> F64:
    return truth().T_R_B[interpolation.nearest_rows(truth().times_ns, times_ns)]


@cache
def tracked(cameras: str, frames: int) -> tuple[protocol.RecordedSensors, list[TrackedImages]]:
    """Track with the true turn in place of the gyroscope's."""
    options = SourceOptions(rovio_active_camera_indices=cameras)
    recording = reader_choice.open_recording(shared_data(FOLDER), options)
    device = recording.device
    tracker = FrameTracker(device.cameras, device.T_I_C)
    result: list[TrackedImages] = []
    for event in stream.EventStream(recording):
        if not isinstance(event, protocol.FrameSet):
            continue
        R_I0_I1 = None
        if result:
            q = true_poses(np.array([result[-1].time_ns, event.time_ns]))[:, :4]
            R_I0_I1 = so3.to_matrix(so3.multiply(so3.inverse(q[0]), q[1]))
        images = tuple(image.grey() for image in event.images)
        result.append(tracker.track(event.time_ns, images, R_I0_I1))
        if len(result) == frames:
            break
    return device, result


def distance_to_epipolar_lines_px(
    device: protocol.RecordedSensors, images: list[TrackedImages], camera: int, gap: int
) -> F64:
    """Compare keypoints of the same track in images so many apart with the true motion."""
    T_M_C = se3.compose(true_poses(np.array([i.time_ns for i in images])), device.T_I_C[camera])
    model, parts = device.cameras[camera], []
    for k in range(len(images) - gap):
        a, b = images[k].cameras[camera], images[k + gap].cameras[camera]
        _, i, j = np.intersect1d(a.track_id, b.track_id, return_indices=True)
        T_b_a = se3.relative(T_M_C[k + gap], T_M_C[k])
        turned = so3.rotate(T_b_a[:4], back_project(model, a.uv_px[i])[0])
        normal = np.cross(T_b_a[4:], turned)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        off = np.sum(normal * back_project(model, b.uv_px[j])[0], axis=1)
        parts.append(np.abs(off) * model.intrinsics[0])
    return np.concatenate(parts)


def share_on_long_tracks(images: list[TrackedImages], camera: int, frames: int = 10) -> float:
    """Return the share of keypoints on tracks that live at least so many frames."""
    ids = np.concatenate([i.cameras[camera].track_id for i in images])
    return float(np.mean(np.bincount(ids)[ids] >= frames))


def test_tracks_agree_with_the_true_motion() -> None:
    device, images = tracked("0", 60)
    assert np.mean([len(i.cameras[0]) for i in images]) > 240
    near = distance_to_epipolar_lines_px(device, images, 0, 1)
    assert np.median(near) < 0.2
    assert np.percentile(near, 99) < 1.5
    assert np.median(distance_to_epipolar_lines_px(device, images, 0, 10)) < 1.0


def test_both_cameras_see_the_same_points() -> None:
    device, images = tracked("", 30)
    T_C1_C0 = se3.relative(device.T_I_C[1], device.T_I_C[0])
    shares, errors = [], []
    for image in images:
        a, b = image.cameras
        _, i, j = np.intersect1d(a.track_id, b.track_id, return_indices=True)
        turned = so3.rotate(T_C1_C0[:4], back_project(device.cameras[0], a.uv_px[i])[0])
        normal = np.cross(T_C1_C0[4:], turned)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        off = np.sum(normal * back_project(device.cameras[1], b.uv_px[j])[0], axis=1)
        errors.append(np.abs(off) * device.cameras[1].intrinsics[0])
        shares.append(len(i) / len(a))
    assert np.mean(shares) > 0.5
    assert np.median(np.concatenate(errors)) < 0.5


@pytest.mark.slow
def test_tracks_live_as_long_as_those_of_the_peer() -> None:
    """The peer (corners of Shi and Tomasi, epipolar geometry of the images): 86 %."""
    _, images = tracked("0", 200)
    assert share_on_long_tracks(images, 0) >= 0.86
