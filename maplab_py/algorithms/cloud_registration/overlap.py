"""Whether two registered clouds show the same surfaces: overlap, and points in space seen to be free.

The rays of a cloud pass through free space up to its points. A point of the other cloud that lies in
front of all neighbouring ones contradicts them; one behind them is hidden and says nothing.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.algorithms.cloud_registration.registration import PreparedCloud, correspondences
from maplab_py.array_types import F64, I64
from maplab_py.geometry import se3

_BIN_RAD = np.deg2rad(3.0)
"""Size of the bins of directions."""
_ROWS, _COLUMNS = round(np.pi / _BIN_RAD), round(2.0 * np.pi / _BIN_RAD)
_SURFACE_RANGE = 0.02
"""Points agree with a surface within this part of their range, and at least within ..."""
_SURFACE_M = 0.1
_NEAREST_M = 0.8
"""... if the surface has a point at this distance."""
_FREE_RANGE, _FREE_M = 0.05, 0.3
"""Points contradict if they are nearer than all around by this part of their range, and by this."""


@dataclasses.dataclass(frozen=True)
class Overlap:
    """Agreement of two clouds at a pose."""

    overlap: float  # share of the points on surfaces of the other cloud, of the cloud with less
    conflict: float  # share of the points in free space of the other, of the cloud with more
    compared: int  # points of the cloud with less overlap
    agreeing: int  # of these


def compare_clouds(target: PreparedCloud, source: PreparedCloud, T_T_S: F64) -> Overlap:
    """Return how far clouds agree at a pose (7,) of the source in the target."""
    ends = (
        _directed_overlap(target, source, T_T_S),
        _directed_overlap(source, target, se3.inverse(T_T_S)),
    )
    less = min(ends, key=lambda end: end[1] / end[0])
    conflict = max(end[2] / max(end[1] + end[2], 1) for end in ends)
    return Overlap(less[1] / less[0], conflict, less[0], less[1])


def _directed_overlap(
    seen: PreparedCloud, points: PreparedCloud, T_S_P: F64
) -> tuple[int, int, int]:
    """Return how many points there are, lie on seen surfaces, and lie in space seen to be free."""
    p, nearest, near = correspondences(seen, points, T_S_P, _NEAREST_M)
    range_m = np.linalg.norm(p, axis=1)
    distance = np.abs(np.einsum("ni,ni->n", seen.normal_S[nearest], p - seen.p_S[nearest]))
    on_surface = near & (distance <= np.maximum(_SURFACE_M, _SURFACE_RANGE * range_m))
    free_m = _free_ranges(seen.p_S)[_bins(p)]
    in_front = range_m + np.maximum(_FREE_M, _FREE_RANGE * range_m) < free_m
    return len(p), int(np.count_nonzero(on_surface)), int(np.count_nonzero(in_front & ~on_surface))


def _bins(p: F64) -> I64:
    """Return the bins (N,) of the directions to points (N, 3)."""
    elevation = np.arctan2(p[:, 2], np.hypot(p[:, 0], p[:, 1])) + 0.5 * np.pi
    azimuth = np.arctan2(p[:, 1], p[:, 0]) + np.pi
    row = np.minimum((elevation / _BIN_RAD).astype(np.int64), _ROWS - 1)
    column = np.minimum((azimuth / _BIN_RAD).astype(np.int64), _COLUMNS - 1)
    return np.asarray(row * _COLUMNS + column)


def _free_ranges(p: F64) -> F64:
    """Return up to which range (bins,) all points in and around a bin leave space free; 0 = unknown.

    A bin counts only if it and the bins on both sides of it along its row have points.
    """
    nearest = np.full(_ROWS * _COLUMNS, np.inf)
    np.minimum.at(nearest, _bins(p), np.linalg.norm(p, axis=1))
    image = nearest.reshape(_ROWS, _COLUMNS)
    has_points = np.isfinite(image)
    sides = [np.roll(image, shift, axis=1) for shift in (-1, 1)]
    known = has_points & np.isfinite(sides[0]) & np.isfinite(sides[1])
    free = np.minimum(image, np.minimum(*sides))
    padded = np.pad(free, ((1, 1), (0, 0)), constant_values=np.inf)
    free = np.minimum(free, np.minimum(padded[:-2], padded[2:]))
    return np.where(known, free, 0.0).reshape(-1)
