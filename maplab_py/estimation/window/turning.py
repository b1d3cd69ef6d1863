"""Pure rotation, distinguished from slow motion by parallax over a longer time and by zero velocity."""

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.estimation.window.cameras import BackProjection, CameraPoses
from maplab_py.estimation.window.frame import Motion, WindowFrame
from maplab_py.estimation.window.options import WindowOptions
from maplab_py.estimation.window.tracks import Tracks

_PARALLAX_TIME_NS = 350_000_000
_MIN_PARALLAX_TRACKS = 10
_LEAST_PARALLAX_DEG = 0.25
"""Median parallax over that time that only motion explains; EuRoC's cameras: 2 px."""
_NEAR_M = 2.0
"""Distance of points whose parallax by the cameras' way around the IMU is a turn's, too."""


def shows_parallax(
    frame: WindowFrame,
    times_ns: I64,
    tracks: Tracks,
    T_M_I: F64,
    T_I_C: F64,
    back_projection: BackProjection,
) -> bool:
    """Return whether a new frame shows parallax to a frame of half a second before.

    From one image to the next, slow motion cannot be told from turning only.

    Args:
        frame: The new frame, whose observations are not among the tracks yet.
        times_ns: Times (F,) of the frames before it.
        T_M_I: Poses (F + 1, 7) of the frames and, as predicted, of the new one.
        T_I_C: Poses (C, 7) of the cameras on the IMU.
        back_projection: Of the cameras.
    """
    old = np.flatnonzero(times_ns <= frame.time_ns - _PARALLAX_TIME_NS)
    if not len(old):
        return False
    row = int(old[-1])
    seen = tracks.observations.take(tracks.observations.frame == row)
    rays, valid = back_projection.rays(frame.camera, frame.uv_px)
    # one number for a track in a camera, which has one observation in a frame
    cameras = int(max(frame.camera.max(initial=0), seen.camera.max(initial=0))) + 1
    before = tracks.id[seen.row] * cameras + seen.camera
    now = frame.track_id.astype(np.int64) * cameras + frame.camera
    now[~valid] = -1
    _, i, j = np.intersect1d(before, now, return_indices=True)
    if len(i) < _MIN_PARALLAX_TRACKS:
        return False
    poses, newest = CameraPoses.of(T_M_I, T_I_C), np.full(len(j), -1)
    first = poses.rays(seen.frame[i], seen.camera[i], seen.ray_C[i])
    angle = np.linalg.norm(first - poses.rays(newest, frame.camera[j], rays[j]), axis=1)
    # a turn moves cameras that are not at the IMU
    lever = poses.p_M_C[[row, -1]] - T_M_I[[row, -1], None, 4:]
    by_turn = float(np.linalg.norm(lever[1] - lever[0], axis=1).max()) / _NEAR_M
    return bool(np.median(angle) >= np.radians(_LEAST_PARALLAX_DEG) + by_turn)


def is_on_the_spot(
    frame: WindowFrame, motion: F64, covariance: F64, options: WindowOptions
) -> tuple[bool, bool]:
    """Return whether a frame turns on the spot, and whether that is sure: at a speed well known to be zero.

    Args:
        frame: The frame, with the samples that lead to it.
        motion: Its predicted motion (9,) [v, b_g, b_a].
        covariance: Of the state before it (15, 15), order [p, theta, v, b_g, b_a].
    """
    v_M, gyro_bias = motion[:3], motion[3:6]
    speed_mps = float(np.linalg.norm(v_M))
    if frame.motion is not Motion.TURNING or speed_mps > options.turning_max_mps:
        return False, False
    rate = np.mean(frame.accel_gyro[:, 3:], axis=0) - gyro_bias
    covariance = covariance[6:9, 6:9]
    if not np.isfinite(covariance).all():
        return True, False
    variance = np.linalg.eigvalsh(covariance)
    if variance[0] <= 0.0 or variance[-1] > options.turning_max_sigma_mps**2:
        return True, False
    distance = float(v_M @ np.linalg.solve(covariance, v_M))
    is_fast = float(np.linalg.norm(rate)) >= options.turning_min_radps
    return True, distance <= options.gate_chi2 and is_fast
