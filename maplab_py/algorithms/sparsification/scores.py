"""Scores of landmarks for localisation: observation count, descriptor stability, missions."""

from __future__ import annotations

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.distinct import distinct
from maplab_py.vimap import VIMap
from maplab_py.vimap.queries import observer_counts
from maplab_py.vimap.table import ragged_rows, starts_of_counts

_OBSERVATIONS_AT_ONCE = 40_000
_BITS_OF_THRESHOLD = 384
_TOP_PERCENTILE = 95.0
_MATCH_CHANCE = 0.3
"""Probability that a stable descriptor is matched with another descriptor of its landmark."""


def landmark_scores(vi_map: VIMap, landmarks: I64, *, threshold_bits: float) -> F64:
    """Return a score (N,) in [0, 1] for each landmark.

    It is the product of the number of observing vertices, the stability of the descriptors and
    the number of observing missions, each relative to its 95th percentile and at most 1.

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
    """Return the probability (N,) in (0, 1] that a landmark is matched when it is observed again.

    With n descriptors, each of which matches with probability p, it is 1 - (1 - p)^n.
    """
    deviation = descriptor_deviations(vi_map, landmarks) * _BITS_OF_THRESHOLD
    stability = np.minimum(1.0, threshold_bits / np.maximum(deviation, 1e-9))
    seen = np.maximum(observer_counts(vi_map)[landmarks], 1)
    return np.asarray(1.0 - (1.0 - _MATCH_CHANCE * stability) ** seen)


def mission_counts(vi_map: VIMap) -> I64:
    """Return the number of missions (L,) that observe each landmark."""
    missions = max(len(vi_map.missions), 1)
    rows = vi_map.observations
    landmark = vi_map.keypoints.landmark[rows].astype(np.int64)
    mission = vi_map.vertices.mission[vi_map.keypoint_vertex[rows]]
    seen = distinct(landmark * missions + mission)
    return np.bincount(seen // missions, minlength=len(vi_map.landmarks))


def descriptor_deviations(vi_map: VIMap, landmarks: I64) -> F64:
    """Return the mean fraction of bits (N,) in which descriptors differ from their majority.

    Zero for landmarks with fewer than two binary descriptors.
    """
    deviation = np.zeros(len(landmarks))
    sizes = vi_map.binary_descriptor_size
    size = int(sizes.max(initial=0))
    if size == 0 or len(landmarks) == 0:
        return deviation
    observations = vi_map.observations[sizes[vi_map.observations] > 0]
    observed = vi_map.keypoints.landmark[observations]
    start = starts_of_counts(np.bincount(observed, minlength=len(vi_map.landmarks)))
    count = np.diff(start)[landmarks]
    chunk = np.cumsum(count) // _OBSERVATIONS_AT_ONCE
    starts = np.flatnonzero(np.diff(chunk, prepend=-1))
    for begin, end in zip(starts, np.append(starts[1:], len(landmarks)), strict=True):
        mine = np.arange(begin, end)
        mine = mine[count[mine] >= 2]
        if len(mine) == 0:
            continue
        rows = observations[ragged_rows(start, landmarks[mine])]
        bits = np.unpackbits(vi_map.keypoints.descriptor[rows, :size], axis=1)
        first = np.cumsum(count[mine]) - count[mine]
        ones = np.add.reduceat(bits, first, axis=0, dtype=np.int32)
        minority = np.minimum(ones, count[mine][:, None] - ones).sum(axis=1)
        deviation[mine] = minority / (count[mine] * 8 * size)
    return deviation
