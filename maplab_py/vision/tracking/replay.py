"""Keypoints that are tracked already, as those of a map, in place of images."""

import time
from collections.abc import Sequence
from typing import Protocol

import numpy as np

from maplab_py.array_types import F64, I32, I64
from maplab_py.geometry import so3
from maplab_py.sensors import Camera, projection
from maplab_py.vision.tracking import motion, views
from maplab_py.vision.tracking.options import TrackingOptions
from maplab_py.vision.tracking.tracks import CameraTracks, TrackedImages


class TrackedKeypoints(Protocol):
    """Tracked keypoints of one image, as `interop.recordings` has them."""

    @property
    def uv_px(self) -> F64:
        """Keypoints (K, 2)."""

    @property
    def sigma_px(self) -> F64:
        """Standard deviations (K,)."""

    @property
    def scale(self) -> F64:
        """Keypoint sizes (K,)."""

    @property
    def track_id(self) -> I32:
        """Tracks (K,), -1 = on no track."""


class TrackedFrames(Protocol):
    """Tracked keypoints of a rig at one time, as `interop.recordings` has them."""

    @property
    def time_ns(self) -> int:
        """Time of the images."""

    @property
    def frames(self) -> Sequence[TrackedKeypoints | None]:
        """Keypoints by camera, None where the camera has no image."""


def tracked_images_of(
    frames: TrackedFrames,
    previous: TrackedImages | None,
    cameras: tuple[Camera, ...],
    T_I_C: F64,
    R_I0_I1: F64 | None = None,
    options: TrackingOptions | None = None,
) -> TrackedImages:
    """Return tracked keypoints in the form in which a tracker delivers them.

    Keypoints on no track are left out, as are all but the first of a track in an image. No outliers
    are removed: whoever tracked the keypoints has done so.

    Args:
        frames: Tracked keypoints.
        previous: What this function returned for the frames before; None = they are the first.
        T_I_C: Their poses (C, 7) on the IMU.
        R_I0_I1: Turn (3, 3) of the IMU since the previous frames, None = unknown.
    """
    start, options = time.perf_counter(), options or TrackingOptions()
    poses = np.asarray(T_I_C, dtype=np.float64).reshape(-1, 7)
    parts = previous.cameras if previous is not None else (CameraTracks.empty(),)
    ids = np.concatenate([part.track_id for part in parts])
    unique, first = np.unique(ids, return_index=True)
    counts = unique, np.concatenate([part.num_frames for part in parts])[first]
    tracks = tuple(_camera_tracks(frame, counts) for frame in frames.frames)
    motions: list[motion.ImageMotion] = []
    for row, camera in enumerate(cameras):
        if previous is None:
            break
        earlier = previous.cameras[row]
        _, before, now = np.intersect1d(
            earlier.track_id, tracks[row].track_id, assume_unique=True, return_indices=True
        )
        ray_C0, is_ray_C0 = projection.back_project(camera, earlier.uv_px[before])
        ray_C1, is_ray_C1 = projection.back_project(camera, tracks[row].uv_px[now])
        rows = is_ray_C0 & is_ray_C1
        R_C1_C0 = motion.camera_turn(so3.to_matrix(poses[row, :4]), R_I0_I1)
        limits = motion.limits_of(options, views.focal_length_px(camera))
        uv_px = tracks[row].uv_px[now][rows]
        rays = ray_C0[rows], ray_C1[rows]
        motions.append(motion.image_motion(camera, rays, uv_px, R_C1_C0, limits, frames.time_ns))
    disparity_px, is_turn_only = motion.summarise(motions)
    spent_ms = {"tracks": 1e3 * (time.perf_counter() - start)}
    return TrackedImages(frames.time_ns, tracks, disparity_px, is_turn_only, spent_ms)


def _camera_tracks(frame: TrackedKeypoints | None, counts: tuple[I64, I64]) -> CameraTracks:
    if frame is None:
        return CameraTracks.empty()
    ids, first = np.unique(np.asarray(frame.track_id, dtype=np.int64), return_index=True)
    rows = np.sort(first[ids >= 0])
    track_id = np.asarray(frame.track_id, dtype=np.int64)[rows]
    known_ids, known_counts = counts
    num_frames = np.ones(len(rows), dtype=np.int64)
    if len(known_ids):
        place = np.minimum(np.searchsorted(known_ids, track_id), len(known_ids) - 1)
        num_frames += np.where(known_ids[place] == track_id, known_counts[place], 0)
    columns = (frame.uv_px, frame.sigma_px, frame.scale)
    uv_px, sigma_px, scale = (np.asarray(column, dtype=np.float64)[rows] for column in columns)
    return CameraTracks(uv_px, track_id, sigma_px, scale, num_frames)
