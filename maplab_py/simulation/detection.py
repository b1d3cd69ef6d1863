"""What a tracker finds in the images: detections of world points, joined to tracks that break."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.geometry import se3, so3
from maplab_py.sensors import Camera
from maplab_py.simulation.cameras import field_of_view_radius, pixels_of
from maplab_py.simulation.scenario import MeasurementOptions
from maplab_py.simulation.world import World, is_hidden

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

_FRAMES_AT_ONCE = 64
"""Frames that are projected in one go: bounds the memory to some 50 MB."""
_SWAP_CANDIDATES = 8
"""A track is swapped with the nearest of so many others of its frame."""
_SCORE_NOISE = 0.1
"""A detector's response differs this much between images; a point's own is uniform in [0, 1]."""


@dataclasses.dataclass(frozen=True, eq=False)
class Detections:
    """Detections of one camera in all its images, sorted by image."""

    frame: I64  # (N,) image number
    point: I64  # (N,) row of the world's points, -1 = clutter
    track: I64  # (N,) consecutive numbers, -1 = clutter
    uv_true_px: F64  # (N, 2) without noise; clutter: anywhere
    uv_px: F64  # (N, 2)
    view_G: F64  # (N, 3) unit, from the point to the camera; clutter: zero
    distance_m: F64  # (N,) clutter: 1


def detect(
    camera: Camera,
    T_G_C: F64,
    world: World,
    is_there: NDArray[np.bool_],
    options: MeasurementOptions,
    rng: np.random.Generator,
) -> Detections:
    """Simulate detector and tracker on the images of one camera.

    Args:
        camera: The camera.
        T_G_C: Its pose at every image (F, 7).
        world: Points and what hides them.
        is_there: Which points (L,) can be seen in this session at all.
        options: Limits, probabilities and noise.
        rng: Source of all of it.
    """
    frame, point, uv, view, distance = _visible(camera, T_G_C, world, is_there, options)
    detected = rng.uniform(size=len(frame)) < options.detection_probability
    response = rng.uniform(size=len(world.p_G))
    score = response[point] + rng.normal(0.0, _SCORE_NOISE, len(frame))
    detected &= _is_best(frame, np.where(detected, score, -np.inf), options.max_keypoints)
    frame, point = frame[detected], point[detected]
    uv, view, distance = uv[detected], view[detected], distance[detected]
    track = _tracks(frame, point, options.track_break_probability, rng)
    track = _swap_identities(track, frame, uv, options.identity_swap_share, rng)
    noisy = uv + options.keypoint_sigma_px * rng.standard_normal(uv.shape)
    found = Detections(frame, point, track, uv, noisy, view, distance)
    return _with_clutter(found, len(T_G_C), camera, options.clutter_share, rng)


def _visible(
    camera: Camera,
    T_G_C: F64,
    world: World,
    is_there: NDArray[np.bool_],
    options: MeasurementOptions,
) -> tuple[I64, I64, F64, F64, F64]:
    """Return image, point, pixel, view direction and distance of everything in sight."""
    rows = np.flatnonzero(is_there)
    p_G, normal_G = world.p_G[rows], world.normal_G[rows]
    least_cosine = np.cos(np.deg2rad(options.max_view_angle_deg))
    radius = field_of_view_radius(camera)
    parts = []
    for first in range(0, len(T_G_C), _FRAMES_AT_ONCE):
        poses = T_G_C[first : first + _FRAMES_AT_ONCE]
        ray = poses[:, None, 4:] - p_G[None]
        squares = np.einsum("fli,fli->fl", ray, ray)
        cosine = np.einsum("fli,li->fl", ray, normal_G)
        near = (squares < options.max_distance_m**2) & (squares > options.min_distance_m**2)
        frame, local = np.nonzero(near & (cosine > least_cosine * np.sqrt(squares)))
        q_C_G = so3.inverse(poses[frame, :4])
        p_C = so3.rotate(q_C_G, -ray[frame, local])
        ahead = np.hypot(p_C[:, 0], p_C[:, 1]) < radius * p_C[:, 2]
        frame, local, p_C = frame[ahead], local[ahead], p_C[ahead]
        uv = pixels_of(camera, p_C)
        inside = np.all((uv >= 1.0) & (uv < [camera.width_px - 2, camera.height_px - 2]), axis=1)
        frame, local, uv = frame[inside], local[inside], uv[inside]
        free = ~is_hidden(world.boxes, poses[frame, 4:], p_G[local])
        frame, local, uv = frame[free], local[free], uv[free]
        distance = np.sqrt(squares[frame, local])
        parts.append(
            (first + frame, rows[local], uv, ray[frame, local] / distance[:, None], distance)
        )
    frame, point, uv, view, distance = (
        np.concatenate(columns) for columns in zip(*parts, strict=True)
    )
    return frame, point, uv, view, distance


def _is_best(frame: I64, score: F64, most: int) -> NDArray[np.bool_]:
    """Tell which detections (N,) are among the `most` with the highest score of their image."""
    order = np.lexsort((-score, frame))
    ordered = frame[order]
    begins = np.searchsorted(ordered, ordered, side="left")
    best = np.zeros(len(frame), dtype=np.bool_)
    best[order] = np.arange(len(frame)) - begins < most
    return best & np.isfinite(score)


def _tracks(frame: I64, point: I64, break_probability: float, rng: np.random.Generator) -> I64:
    """Number the tracks: a point seen in consecutive images, unless its track breaks."""
    order = np.lexsort((frame, point))
    breaks = rng.uniform(size=len(frame)) < break_probability
    begins = np.ones(len(frame), dtype=np.bool_)
    begins[1:] = (np.diff(point[order]) != 0) | (np.diff(frame[order]) != 1) | breaks[1:]
    track = np.empty(len(frame), dtype=np.int64)
    track[order] = np.cumsum(begins) - 1
    # numbered by first appearance, as a tracker does
    _, first = np.unique(track, return_index=True)
    rank = np.empty(len(first), dtype=np.int64)
    rank[np.argsort(first, kind="stable")] = np.arange(len(first))
    return rank[track]


def _swap_identities(
    track: I64, frame: I64, uv: F64, share: float, rng: np.random.Generator
) -> I64:
    """Let a share of the tracks jump onto another point near by, each at most once."""
    tracks = int(track.max()) + 1 if len(track) else 0
    # each swap concerns two tracks
    wanted = int(0.5 * share * tracks)
    if wanted == 0:
        return track
    start = np.searchsorted(frame, np.arange(frame.max() + 2))
    one = rng.integers(0, len(track), wanted)
    low, high = start[frame[one]], start[frame[one] + 1]
    others = low[:, None] + np.floor(
        rng.uniform(size=(wanted, _SWAP_CANDIDATES)) * (high - low)[:, None]
    ).astype(np.int64)
    gap = np.linalg.norm(uv[others] - uv[one][:, None], axis=2)
    gap[others == one[:, None]] = np.inf
    other = others[np.arange(wanted), np.argmin(gap, axis=1)]
    pair = np.stack([track[one], track[other]], axis=1)
    _, first, count = np.unique(pair, return_index=True, return_counts=True)
    once = np.zeros(pair.size, dtype=np.bool_)
    once[first[count == 1]] = True
    chosen = np.all(once.reshape(pair.shape), axis=1)
    partner = np.arange(tracks)
    since = np.full(tracks, np.iinfo(np.int64).max)
    for side in (0, 1):
        partner[pair[chosen, side]] = pair[chosen, 1 - side]
        since[pair[chosen, side]] = frame[one[chosen]]
    return np.where(frame >= since[track], partner[track], track)


def _with_clutter(
    found: Detections, frames: int, camera: Camera, share: float, rng: np.random.Generator
) -> Detections:
    """Add keypoints that belong to nothing, as a share of all keypoints, and sort by image."""
    counts = np.bincount(found.frame, minlength=frames)
    extra = np.floor(counts * share / (1.0 - share) + rng.uniform(size=frames)).astype(np.int64)
    extra = extra if share > 0.0 else np.zeros_like(extra)
    total = int(extra.sum())
    size = np.array([camera.width_px - 1, camera.height_px - 1])
    uv = rng.uniform(size=(total, 2)) * size
    none = np.full(total, -1, dtype=np.int64)
    frame = np.concatenate([found.frame, np.repeat(np.arange(frames), extra)])
    order = np.argsort(frame, kind="stable")
    return Detections(
        frame[order],
        np.concatenate([found.point, none])[order],
        np.concatenate([found.track, none])[order],
        np.concatenate([found.uv_true_px, uv])[order],
        np.concatenate([np.clip(found.uv_px, 0.0, size), uv])[order],
        np.concatenate([found.view_G, np.zeros((total, 3))])[order],
        np.concatenate([found.distance_m, np.ones(total)])[order],
    )


def camera_poses(T_G_I: F64, T_I_C: F64) -> F64:
    """Return the poses (F, 7) of a camera on bodies (F, 7)."""
    return se3.compose(T_G_I, T_I_C)
