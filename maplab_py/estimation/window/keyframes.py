"""Selection of keyframes."""

import numpy as np

from maplab_py.array_types import F64
from maplab_py.estimation.window.cameras import CameraPoses
from maplab_py.estimation.window.options import WindowOptions
from maplab_py.estimation.window.tracks import Tracks


def needs_keyframe(
    tracks: Tracks, T_M_I: F64, T_I_C: F64, keyframe: int, options: WindowOptions
) -> bool:
    """Return whether the newest frame has parallax to the last keyframe, or few of its tracks.

    Parallax is the median angle between the rays of the same tracks in M, so that turning gives none.

    Args:
        T_M_I: Poses (F, 7) of the frames.
        T_I_C: Poses (C, 7) of the cameras on the IMU.
        keyframe: Row of the last keyframe.
    """
    newest = len(T_M_I) - 1
    before, now = tracks.is_seen_by(keyframe), tracks.is_seen_by(newest)
    common = before & now
    if np.count_nonzero(common) < options.keyframe_tracked_share * np.count_nonzero(before):
        return True
    if not common.any():
        return False
    poses = CameraPoses.of(T_M_I, T_I_C)
    rays = [_rays(tracks, frame, poses)[common] for frame in (keyframe, newest)]
    chord = np.linalg.norm(rays[0] - rays[1], axis=1)
    parallax_deg = np.degrees(2.0 * np.arcsin(np.minimum(0.5 * chord, 1.0)))
    return float(np.median(parallax_deg)) > options.keyframe_parallax_deg


def _rays(tracks: Tracks, frame: int, poses: CameraPoses) -> F64:
    """Return the ray (T, 3) in M of every track that a frame sees, by its first camera."""
    seen = tracks.observations
    rows = np.flatnonzero(seen.frame == frame)[::-1]
    rays = np.zeros((len(tracks), 3))
    rays[seen.row[rows]] = poses.rays(seen.frame[rows], seen.camera[rows], seen.ray_C[rows])
    return rays
