"""Simulated detector and tracker: detections of world points, joined to tracks that break."""

import dataclasses
from collections.abc import Callable

import numpy as np

from maplab_py.array_types import F64, I64, NDArray, Rows, mask_of
from maplab_py.geometry import so3
from maplab_py.sensors import Camera
from maplab_py.simulation.cameras import field_of_view_radius, pixels_of
from maplab_py.simulation.scenario import MeasurementOptions
from maplab_py.simulation.world import World

_FRAMES_AT_ONCE = 64
"""Number of frames per batch of projections; bounds the memory to about 50 MB."""
_SCORE_NOISE = 0.1
"""Variation of a detector's response between images; the response of a point is uniform in [0, 1]."""


_BORDER_PX, _BORDER_SIGMAS = 1.0, 5.0
"""Margin at the image border for measurement noise."""
_READOUT_ROUNDS = 4
"""Iterations for the readout time of the row of a point; each gains 2 digits."""
_SIZE_SPREAD = 0.7
_OCTAVE_DISTANCE_M = 6.0


@dataclasses.dataclass(frozen=True, eq=False)
class CameraPoses:
    """Camera poses at its images, stamped in the middle of their readout."""

    time_s: F64  # (F,)
    T_G_C: F64  # (F, 7)
    line_delay_s: float = 0.0  # between two rows
    at_time: Callable[[F64], F64] | None = None  # poses (N, 7) at any times (N,)


class Detections(Rows):
    """Detections of one camera in all its images, sorted by image."""

    frame: I64  # (N,) image number
    point: I64  # (N,) row of the world's points, -1 = clutter
    track: I64  # (N,) consecutive numbers, -1 = clutter
    uv_true_px: F64  # (N, 2) without noise; clutter: anywhere
    uv_px: F64  # (N, 2)
    view_G: F64  # (N, 3) unit, from the point to the camera; clutter: zero
    distance_m: F64  # (N,) clutter: 1
    octave: I64  # (N,) of the image pyramid in which it was detected


def detect(
    camera: Camera,
    poses: CameraPoses,
    world: World,
    is_there: NDArray[np.bool_],
    options: MeasurementOptions,
    rng: np.random.Generator,
) -> Detections:
    """Simulate detector and tracker on the images of one camera.

    Args:
        poses: Where it is, and when.
        world: Points and what hides them.
        is_there: Mask (L,) of the points that exist in this session.
    """
    frame, point, uv, view, distance = _visible(camera, poses, world, is_there, options)
    detected = rng.uniform(size=len(frame)) < options.detection_probability
    response = rng.uniform(size=len(world.p_G))
    score = response[point] + rng.normal(0.0, _SCORE_NOISE, len(frame))
    detected &= _is_best(frame, np.where(detected, score, -np.inf), options.max_keypoints)
    frame, point = frame[detected], point[detected]
    uv, view, distance = uv[detected], view[detected], distance[detected]
    track = number_tracks(frame, point, options.track_break_probability, rng)
    track = swap_identities(track, frame, uv, options.identity_swap_share, rng)
    octave = _octaves(point, distance, len(world.p_G), options.octaves, rng)
    sigma = sigma_of_octave(options, octave)
    noisy = uv + sigma[:, None] * rng.standard_normal(uv.shape)
    if options.track_drift_share > 0.0:
        noisy += drifts(track, frame, options.track_drift_share, options.track_drift_px, rng)
    detections = Detections(frame, point, track, uv, noisy, view, distance, octave)
    return _with_clutter(detections, len(poses.time_s), camera, options.clutter_share, rng)


def sigma_of_octave(options: MeasurementOptions, octave: I64) -> F64:
    """Return the standard deviations (N,) [px]: half an octave up, 1.4 times the error."""
    return np.asarray(options.keypoint_sigma_px * np.sqrt(2.0) ** octave)


def _octaves(point: I64, distance: F64, points: int, octaves: int, rng: np.random.Generator) -> I64:
    """Return the octave (N,) in which a point is detected: the nearer and larger, the higher."""
    if octaves == 1:
        return np.zeros(len(point), dtype=np.int64)
    size = rng.normal(0.0, _SIZE_SPREAD, points)
    level = size[point] + np.log2(_OCTAVE_DISTANCE_M / distance)
    return np.asarray(np.clip(np.round(level), 0, octaves - 1), dtype=np.int64)


def _visible(
    camera: Camera,
    poses: CameraPoses,
    world: World,
    is_there: NDArray[np.bool_],
    options: MeasurementOptions,
) -> tuple[I64, I64, F64, F64, F64]:
    """Return image, point, pixel, view direction and distance of everything in sight."""
    margin = _BORDER_PX + _BORDER_SIGMAS * float(
        sigma_of_octave(options, np.array(options.octaves - 1))
    )
    groups = [np.flatnonzero(is_there & (world.moving < 0))]
    groups += [np.flatnonzero(is_there & (world.moving == m)) for m in range(len(world.objects))]
    parts = []
    for number, rows in enumerate(groups):
        mover = world.objects[number - 1] if number else None
        for first in range(0, len(poses.time_s), _FRAMES_AT_ONCE):
            frames = slice(first, first + _FRAMES_AT_ONCE)
            low, high = _reach(poses.T_G_C[frames, 4:], options.max_distance_m)
            near = rows
            if mover is None:
                near = rows[np.all((world.p_G[rows] > low) & (world.p_G[rows] < high), axis=1)]
            p_G = world.p_G[near][None]
            if mover is not None:
                p_G = p_G + mover.displacement(poses.time_s[frames])[:, None]
            seen = _seen(camera, poses, frames, p_G, world.normal_G[near], options)
            frame, local, uv, view, distance = seen
            inside = np.all(
                (uv >= margin) & (uv < [camera.width_px - margin, camera.height_px - margin]),
                axis=1,
            )
            eye = poses.T_G_C[first + frame, 4:]
            place = p_G[np.minimum(frame, len(p_G) - 1), local]
            free = np.flatnonzero(inside)
            between = np.all((world.boxes[:, 1] > low) & (world.boxes[:, 0] < high), axis=1)
            free = free[~is_hidden(world.boxes[between], eye[free], place[free])]
            parts.append(
                (first + frame[free], near[local[free]], uv[free], view[free], distance[free])
            )
    frame, point, uv, view, distance = (
        np.concatenate(columns) for columns in zip(*parts, strict=True)
    )
    order = np.lexsort((point, frame))
    return frame[order], point[order], uv[order], view[order], distance[order]


def _reach(eyes: F64, distance_m: float) -> tuple[F64, F64]:
    """Return the lower and upper corner of the box that lines of sight from eyes (F, 3) stay in."""
    return eyes.min(axis=0) - distance_m, eyes.max(axis=0) + distance_m


def _seen(
    camera: Camera,
    poses: CameraPoses,
    frames: slice,
    p_G: F64,
    normal_G: F64,
    options: MeasurementOptions,
) -> tuple[I64, I64, F64, F64, F64]:
    """Project points (1 or F, L, 3) into images without occlusion."""
    T_G_C = poses.T_G_C[frames]
    least_cosine = np.cos(np.deg2rad(options.max_view_angle_deg))
    ray = T_G_C[:, None, 4:] - p_G
    squares = np.einsum("fli,fli->fl", ray, ray)
    cosine = np.einsum("fli,li->fl", ray, normal_G)
    near = (squares < options.max_distance_m**2) & (squares > options.min_distance_m**2)
    frame, local = np.nonzero(near & (cosine > least_cosine * np.sqrt(squares)))
    p_C = so3.rotate(so3.inverse(T_G_C[frame, :4]), -ray[frame, local])
    ahead = np.hypot(p_C[:, 0], p_C[:, 1]) < field_of_view_radius(camera) * p_C[:, 2]
    frame, local, p_C = frame[ahead], local[ahead], p_C[ahead]
    uv = pixels_of(camera, p_C)
    if poses.line_delay_s != 0.0:
        place = p_G[np.minimum(frame, len(p_G) - 1), local]
        uv = _rolling(camera, poses, poses.time_s[frames][frame], place, uv)
    distance = np.sqrt(squares[frame, local])
    return frame, local, uv, ray[frame, local] / distance[:, None], distance


def _rolling(camera: Camera, poses: CameraPoses, time_s: F64, p_G: F64, uv: F64) -> F64:
    """Return pixels (N, 2) of points (N, 3) whose rows are read out one after the other."""
    at_time = poses.at_time
    if at_time is None:
        return uv
    for _ in range(_READOUT_ROUNDS):
        row = np.clip(uv[:, 1], 0.0, camera.height_px)
        T_G_C = at_time(time_s + poses.line_delay_s * (row - 0.5 * camera.height_px))
        uv = pixels_of(camera, so3.rotate(so3.inverse(T_G_C[:, :4]), p_G - T_G_C[:, 4:]))
    return uv


def _is_best(frame: I64, score: F64, most: int) -> NDArray[np.bool_]:
    """Return which detections (N,) are among the `most` with the highest score in their image."""
    order = np.lexsort((-score, frame))
    ordered = frame[order]
    begins = np.searchsorted(ordered, ordered, side="left")
    best = np.zeros(len(frame), dtype=np.bool_)
    best[order] = np.arange(len(frame)) - begins < most
    return best & np.isfinite(score)


def _with_clutter(
    detections: Detections, frames: int, camera: Camera, share: float, rng: np.random.Generator
) -> Detections:
    """Add clutter keypoints as a share of all keypoints and sort by image."""
    counts = np.bincount(detections.frame, minlength=frames)
    extra = np.floor(counts * share / (1.0 - share) + rng.uniform(size=frames)).astype(np.int64)
    extra = extra if share > 0.0 else np.zeros_like(extra)
    total = int(extra.sum())
    size = np.array([camera.width_px - 1, camera.height_px - 1])
    uv = rng.uniform(size=(total, 2)) * size
    none, frame = np.full(total, -1, dtype=np.int64), np.repeat(np.arange(frames), extra)
    distance, octave = np.ones(total), np.zeros(total, dtype=np.int64)
    clutter = Detections(frame, none, none, uv, uv, np.zeros((total, 3)), distance, octave)
    real = dataclasses.replace(detections, uv_px=np.clip(detections.uv_px, 0.0, size))
    every = Detections.concatenate([real, clutter])
    return every.take(np.argsort(every.frame, kind="stable"))


_SWAP_CANDIDATES = 8
"""A track is swapped with the nearest of so many others of its frame."""


def number_tracks(
    frame: I64, point: I64, break_probability: float, rng: np.random.Generator
) -> I64:
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


def swap_identities(track: I64, frame: I64, uv: F64, share: float, rng: np.random.Generator) -> I64:
    """Let a share of the tracks jump onto another point near by, each at most once."""
    tracks = int(track.max()) + 1 if len(track) else 0
    # each swap concerns two tracks
    wanted = int(0.5 * share * tracks)
    if wanted == 0:
        return track
    start = np.searchsorted(frame, np.arange(frame.max() + 2))
    track_a = rng.integers(0, len(track), wanted)
    low, high = start[frame[track_a]], start[frame[track_a] + 1]
    others = low[:, None] + np.floor(
        rng.uniform(size=(wanted, _SWAP_CANDIDATES)) * (high - low)[:, None]
    ).astype(np.int64)
    gap = np.linalg.norm(uv[others] - uv[track_a][:, None], axis=2)
    gap[others == track_a[:, None]] = np.inf
    other = others[np.arange(wanted), np.argmin(gap, axis=1)]
    pair = np.stack([track[track_a], track[other]], axis=1)
    _, first, count = np.unique(pair, return_index=True, return_counts=True)
    once = mask_of(pair.size, first[count == 1])
    chosen = np.all(once.reshape(pair.shape), axis=1)
    partner = np.arange(tracks)
    since = np.full(tracks, np.iinfo(np.int64).max)
    for side in (0, 1):
        partner[pair[chosen, side]] = pair[chosen, 1 - side]
        since[pair[chosen, side]] = frame[track_a[chosen]]
    return np.where(frame >= since[track], partner[track], track)


def drifts(track: I64, frame: I64, share: float, step_px: float, rng: np.random.Generator) -> F64:
    """Return by how much [px] (N, 2) detections slide off their points.

    A share of the tracks does so by a random walk with steps of `step_px` in each direction.
    """
    tracks = int(track.max(initial=-1)) + 1
    is_drifting = rng.uniform(size=tracks) < share
    steps = step_px * rng.standard_normal((len(track), 2)) * is_drifting[track, None]
    order = np.lexsort((frame, track))
    walk = np.cumsum(steps[order], axis=0)
    ordered = track[order]
    begin = np.searchsorted(ordered, ordered, side="left")
    result = np.empty_like(walk)
    result[order] = walk - walk[begin]
    return result


def is_hidden(boxes: F64, eye: F64, point: F64) -> NDArray[np.bool_]:
    """Return which lines of sight from eyes (N, 3) to points (N, 3) cross a box of (B, 2, 3).

    The slab test of Kay and Kajiya (1986), one box at a time.
    """
    hidden = np.zeros(len(eye), dtype=np.bool_)
    direction = point - eye
    direction = np.where(np.abs(direction) < 1e-12, 1e-12, direction)
    inverse = 1.0 / direction
    for low, high in boxes:
        a, b = (low - eye) * inverse, (high - eye) * inverse
        enters = np.minimum(a, b).max(axis=1)
        leaves = np.maximum(a, b).min(axis=1)
        hidden |= (enters < leaves) & (leaves > 0.0) & (enters < 1.0 - 1e-9)
    return hidden
