"""Tracks of one camera in the image of another that sees the same."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.array_types import F64, U8, Mask
from maplab_py.vision.tracking.flow import FlowOptions, follow
from maplab_py.vision.tracking.live_tracks import LiveTracks
from maplab_py.vision.tracking.views import CameraView

_MIN_DISTANCE_M, _FAR_M = 0.05, 1000.0
_NEIGHBOURS = 3
"""A point of unknown distance is sought at the median inverse distance of so many neighbours."""
_RETRY_FRAMES = 4
"""Interval in which a point of unknown distance is sought again."""


@dataclasses.dataclass(frozen=True)
class StereoOptions:
    """Limits of stereo."""

    flow: FlowOptions
    gate_px: float  # distance to the epipolar line
    distance_m: float  # where the points are sought while no distance is known


@dataclasses.dataclass(frozen=True, eq=False)
class StereoMatches:
    """Observations of K tracks by another camera."""

    uv: F64  # (K, 2) of its prepared image
    ray: F64  # (K, 3)
    is_matched: Mask  # (K,)
    distance_m: F64  # (K,) from the first camera, NaN where it is not known


def match(
    first: CameraView,
    second: CameraView,
    images: tuple[U8, U8],
    tracks: LiveTracks,
    options: StereoOptions,
) -> StereoMatches:
    """Find the tracks of a camera in the image that another took at the same time.

    Points are sought where they would be at their last known distance, else at the distance of
    their neighbours in the image, else at the default distance. A match must be tracked back to where
    it came from, lie on its epipolar line, and in front of both cameras.
    """
    R_A_B, p_A_B = first.R_I_C.T @ second.R_I_C, first.R_I_C.T @ (second.p_I_C - first.p_I_C)
    expected_m = _expected_distances(tracks, options.distance_m)
    guess, visible = second.pixels((expected_m[:, None] * tracks.ray - p_A_B) @ R_A_B)
    is_due = np.isfinite(tracks.distance_m) | (tracks.num_frames % _RETRY_FRAMES == 1)
    rows = np.flatnonzero(is_due & visible & second.is_usable(guess))
    uv_second, is_match = follow(*images, tracks.uv[rows], guess[rows], options.flow)
    ray_second, exists = second.rays(uv_second)
    off, distance, is_ahead = _triangulated(tracks.ray[rows], ray_second @ R_A_B.T, p_A_B)
    gate = options.gate_px / second.focal_px
    is_match &= exists & second.is_usable(uv_second) & (np.abs(off) <= gate)
    # where the rays are nearly parallel, noise decides on which side they meet
    chord = np.linalg.norm(tracks.ray[rows] - ray_second @ R_A_B.T, axis=1)
    is_far = chord <= gate
    is_match &= is_far | (is_ahead & (distance >= _MIN_DISTANCE_M))
    distance = np.where(is_ahead, np.clip(distance, _MIN_DISTANCE_M, _FAR_M), _FAR_M)

    count = len(tracks)
    uv, ray = np.zeros((count, 2)), np.zeros((count, 3))
    is_matched, distance_m = np.zeros(count, dtype=np.bool_), np.full(count, np.nan)
    uv[rows], ray[rows], is_matched[rows] = uv_second, ray_second, is_match
    distance_m[rows] = np.where(is_match, distance, np.nan)
    return StereoMatches(uv, ray, is_matched, distance_m)


def _expected_distances(tracks: LiveTracks, default_m: float) -> F64:
    """Return the distances (K,) at which tracks are sought."""
    known = np.isfinite(tracks.distance_m)
    if np.count_nonzero(known) < _NEIGHBOURS:
        return np.where(known, tracks.distance_m, default_m)
    rows = np.flatnonzero(~known)
    offset = tracks.uv[rows, None] - tracks.uv[known][None]
    squares = np.sum(offset * offset, axis=2)
    nearest = np.argsort(squares, axis=1, kind="stable")[:, :_NEIGHBOURS]
    expected = tracks.distance_m.copy()
    expected[rows] = 1.0 / np.median(1.0 / tracks.distance_m[known][nearest], axis=1)
    return expected


def _triangulated(a: F64, b: F64, p: F64) -> tuple[F64, F64, Mask]:
    """Intersect rays a (K, 3) from the origin with rays b (K, 3) from p (3,).

    Returns:
        Distances (K,) of b to the plane of a and p, distances along a, and whether the point is in
        front of both.
    """
    normal = np.cross(p, a)
    length = np.linalg.norm(normal, axis=1)
    is_beside = length > 1e-9
    off = np.sum(normal * b, axis=1) / np.where(is_beside, length, 1.0)
    axis = np.cross(a, b)
    square = np.maximum(np.sum(axis * axis, axis=1), 1e-18)
    along_a = np.sum(np.cross(p, b) * axis, axis=1) / square
    along_b = np.sum(np.cross(p, a) * axis, axis=1) / square
    return off, along_a, (along_a > 0.0) & (along_b > 0.0)
