"""How much a landmark promises for localisation: seen often, looking alike, in many missions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maplab_py.vimap import VIMap
from maplab_py.vimap.queries import observer_counts
from maplab_py.vimap.table import ragged_rows

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

_OBSERVATIONS_AT_ONCE = 40_000
_BITS_OF_THRESHOLD = 384
_TOP_PERCENTILE = 95.0
_MATCH_CHANCE = 0.3
"""Of a stable descriptor, that another one of its landmark is matched with it."""


def landmark_scores(vi_map: VIMap, landmarks: I64, *, threshold_bits: float) -> F64:
    """Return a score (N,) in [0, 1] for each landmark.

    It is the product of the number of observing vertices, the stability of the descriptors and
    the number of observing missions, as part of the 95th percentile; what lies above counts 1.

    Args:
        vi_map: The map.
        landmarks: Landmark rows (N,).
        threshold_bits: Mean distance of descriptors from their majority, in bits of 384, up to
            which they count as stable.
    """
    deviation = descriptor_deviations(vi_map, landmarks) * _BITS_OF_THRESHOLD
    stability = np.minimum(1.0, threshold_bits / np.maximum(deviation, 1e-9))
    raw = observer_counts(vi_map)[landmarks] * stability * mission_counts(vi_map)[landmarks]
    top = float(np.percentile(raw, _TOP_PERCENTILE)) if len(raw) else 0.0
    return np.asarray(np.clip(raw / max(top, 1e-9), 0.0, 1.0))


def landmark_weights(vi_map: VIMap, landmarks: I64, *, threshold_bits: float) -> F64:
    """Return the chance (N,) in (0, 1] that a landmark is matched when it is seen again.

    Every vertex that observed it has left a descriptor that may be near enough: with a chance of
    p each, n of them leave 1 - (1 - p)^n.
    """
    deviation = descriptor_deviations(vi_map, landmarks) * _BITS_OF_THRESHOLD
    stability = np.minimum(1.0, threshold_bits / np.maximum(deviation, 1e-9))
    seen = np.maximum(observer_counts(vi_map)[landmarks], 1)
    return np.asarray(1.0 - (1.0 - _MATCH_CHANCE * stability) ** seen)


def mission_counts(vi_map: VIMap) -> I64:
    """Return how many missions observe each landmark (L,)."""
    missions = max(len(vi_map.missions), 1)
    rows = vi_map.observations
    landmark = vi_map.keypoints.landmark[rows].astype(np.int64)
    mission = vi_map.vertices.mission[vi_map.keypoint_vertex[rows]]
    seen = np.unique(landmark * missions + mission)
    return np.bincount(seen // missions, minlength=len(vi_map.landmarks))


def descriptor_deviations(vi_map: VIMap, landmarks: I64) -> F64:
    """Return the mean part of bits (N,) in which descriptors differ from their landmark's majority.

    Zero for landmarks with fewer than two observations or without descriptors.
    """
    deviation = np.zeros(len(landmarks))
    count = np.diff(vi_map.observation_start)[landmarks]
    size = int(vi_map.keypoints.descriptor.shape[1])
    if size == 0 or len(landmarks) == 0:
        return deviation
    chunk = np.cumsum(count) // _OBSERVATIONS_AT_ONCE
    starts = np.flatnonzero(np.diff(chunk, prepend=-1))
    for begin, end in zip(starts, np.append(starts[1:], len(landmarks)), strict=True):
        mine = np.arange(begin, end)
        mine = mine[count[mine] >= 2]
        if len(mine) == 0:
            continue
        rows = vi_map.observations[ragged_rows(vi_map.observation_start, landmarks[mine])]
        bits = np.unpackbits(vi_map.keypoints.descriptor[rows], axis=1)
        first = np.cumsum(count[mine]) - count[mine]
        ones = np.add.reduceat(bits, first, axis=0, dtype=np.int32)
        minority = np.minimum(ones, count[mine][:, None] - ones).sum(axis=1)
        deviation[mine] = minority / (count[mine] * 8 * size)
    return deviation
