"""Tracks: a point seen in consecutive images, until the track breaks, jumps or drifts away."""

from __future__ import annotations

import numpy as np

from maplab_py.array_types import F64, I64

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
    once = np.zeros(pair.size, dtype=np.bool_)
    once[first[count == 1]] = True
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
