"""Initial landmarks: tracks triangulated from the drifted poses, as in odometry."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.geometry import se3
from maplab_py.geometry.triangulation import triangulate
from maplab_py.sensors.projection import back_project
from maplab_py.simulation.recording import Recording
from maplab_py.simulation.sensors import Device
from maplab_py.vimap.table import starts_of_counts

_MIN_RAY_ANGLE_RAD = np.deg2rad(0.5)
_MAX_LANDMARK_DISTANCE_M = 60.0


@dataclasses.dataclass(frozen=True, eq=False)
class InitialLandmarks:
    """Landmarks of one session, in the order of their tracks."""

    vertex: I64  # (L,) vertex that stores it: the first that sees it
    p_I: F64  # (L, 3) in that vertex' frame
    point: I64  # (L,) the world point that most of its observations show
    of_keypoint: I64  # (K,) landmark of every keypoint, -1 = none


def initial_landmarks(
    device: Device, recording: Recording, min_track_length: int
) -> InitialLandmarks:
    """Triangulate the tracks with the nominal calibration and the estimated poses."""
    detections, cameras = recording.keypoints, len(device.rig.cameras)
    tracked = np.flatnonzero(detections.track >= 0)
    order = tracked[np.argsort(detections.track[tracked], kind="stable")]
    length = np.bincount(detections.track[tracked])
    start = starts_of_counts(length)
    vertex = detections.frame // cameras
    T_M_C, ray_C = _rays(device, recording)
    ray_M = se3.transform(np.concatenate([T_M_C[:, :4], np.zeros((len(T_M_C), 3))], axis=1), ray_C)
    p_M, ok, angle = triangulate(T_M_C[order, 4:], ray_M[order], start)
    p_of = np.repeat(p_M, length, axis=0)
    offset = p_of - T_M_C[order, 4:]
    behind = np.sum(offset * ray_M[order], axis=1) <= 0.0
    far = np.linalg.norm(offset, axis=1) > _MAX_LANDMARK_DISTANCE_M
    bad = np.bincount(np.repeat(np.arange(len(length)), length), behind | far, len(length)) > 0
    ok &= (length >= min_track_length) & ~bad
    ok &= angle > _MIN_RAY_ANGLE_RAD
    kept = np.flatnonzero(ok)
    row_of_track = np.full(len(length), -1, dtype=np.int64)
    row_of_track[kept] = np.arange(len(kept))
    landmark_of = np.full(len(detections.track), -1, dtype=np.int64)
    landmark_of[tracked] = row_of_track[detections.track[tracked]]
    first = order[start[kept]]
    T_M_I = recording.states.T_M_I[vertex[first]]
    # the median of a track's points is the point that most of it shows
    middle = start[kept] + length[kept] // 2
    by_point = order[np.lexsort((detections.point[order], detections.track[order]))]
    return InitialLandmarks(
        vertex[first],
        se3.transform(se3.inverse(T_M_I), p_M[kept]),
        detections.point[by_point[middle]],
        landmark_of,
    )


def _rays(device: Device, recording: Recording) -> tuple[F64, F64]:
    """Return the nominal camera pose (N, 7) and the measured ray (N, 3) of every keypoint."""
    detections, cameras = recording.keypoints, device.rig.cameras
    camera_row = detections.frame % len(cameras)
    T_M_I = recording.states.T_M_I[detections.frame // len(cameras)]
    rays = np.empty((len(detections.frame), 3))
    for row, camera in enumerate(cameras):
        of_camera = camera_row == row
        rays[of_camera] = back_project(camera, detections.uv_px[of_camera])[0]
    return se3.compose(T_M_I, device.rig.T_B_C[camera_row]), rays
