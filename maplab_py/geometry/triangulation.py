"""Linear triangulation of many points at once, and the angles between their rays.

Rays of one point are consecutive rows; `start` (L + 1) holds the offsets, as everywhere.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from maplab_py.array_types import F64
from maplab_py.geometry import symmetric

_MIN_RELATIVE_EIGENVALUE = 1e-12
"""Two rays 2e-6 rad apart have this ratio of the smallest eigenvalue to the number of rays."""
_PAIRS_AT_ONCE = 1 << 21
"""Number of ray pairs per batch; bounds the memory to about 50 MB."""


def triangulate(
    origins: ArrayLike, directions: ArrayLike, start: ArrayLike
) -> tuple[F64, NDArray[np.bool_], F64]:
    """Return the points nearest to their rays, whether they are determined, and the ray angles.

    A point minimises the sum of its squared distances to the lines of its rays, which is what
    remains of maplab's linear N-view system [I -d_i] [p; depth_i] = o_i after eliminating depths.
    A determined point may still lie behind a camera or far away: see `algorithms/landmarks`.

    Args:
        origins: Ray origins (O, 3).
        directions: Ray directions (O, 3) of any length but zero.
        start: Offsets (L + 1): rays of point l are rows start[l] .. start[l + 1] - 1.

    Returns:
        Points (L, 3), zero where not determined; ok (L,): at least two rays that are not parallel;
        largest angle between any two rays (L,) [rad].
    """
    o, d = np.asarray(origins, dtype=np.float64), np.asarray(directions, dtype=np.float64)
    start = np.asarray(start, dtype=np.int64)
    counts = np.diff(start)
    d = _unit(d)
    centre = _sum_groups(o, start) / np.maximum(counts, 1)[:, None]
    relative = o - np.repeat(centre, counts, axis=0)
    # sum (I - d d^T) p = sum (I - d d^T) o, about the mean origin so that nothing cancels
    outer = _sum_groups((d[:, :, None] * d[:, None, :]).reshape(-1, 9), start).reshape(-1, 3, 3)
    A = counts[:, None, None] * np.eye(3) - outer
    b = _sum_groups(relative - d * np.sum(d * relative, axis=1, keepdims=True), start)
    value, axis = symmetric.eigen(A)
    ok = (counts >= 2) & (value[:, 0] > _MIN_RELATIVE_EIGENVALUE * counts)
    along = np.einsum("lji,lj->li", axis, b) / np.where(ok[:, None], value, 1.0)
    points = np.einsum("lij,lj->li", axis, along) + centre
    ok &= np.all(np.isfinite(points), axis=1)
    points[~ok] = 0.0
    return points, ok, largest_ray_angle(d, start)


def largest_ray_angle(directions: ArrayLike, start: ArrayLike) -> F64:
    """Return the largest angle (L,) [rad] between any two rays of a group, 0 for fewer than two.

    Exact: groups with equally many rays are compared all pairs at a time, so that the only loop
    is over distinct group sizes; the cost is the sum of the squared group sizes.

    Args:
        directions: Ray directions (O, 3) of any length but zero.
        start: Offsets (L + 1) of the groups.
    """
    d = np.asarray(directions, dtype=np.float64)
    start = np.asarray(start, dtype=np.int64)
    d = _unit(d)
    counts = np.diff(start)
    angles = np.zeros(len(counts))
    if len(counts) == 0:
        return angles
    order = np.argsort(counts, kind="stable")
    sizes, first = np.unique(counts[order], return_index=True)
    for size, groups in zip(sizes.tolist(), np.split(order, first[1:]), strict=True):
        if size < 2:
            continue
        step = max(1, _PAIRS_AT_ONCE // (size * size))
        for begin in range(0, len(groups), step):
            part = groups[begin : begin + step]
            rays = d[start[part][:, None] + np.arange(size)]
            angles[part] = _widest_pair(rays)
    return angles


def _unit(directions: F64) -> F64:
    """Return directions (O, 3) of length one; those of 1e160 m too, whose squares overflow."""
    scaled = directions / np.abs(directions).max(axis=1, keepdims=True, initial=0.0)
    return np.asarray(scaled / np.linalg.norm(scaled, axis=1, keepdims=True))


def _widest_pair(rays: F64) -> F64:
    """Return the largest angle (m,) within groups of unit rays (m, n, 3)."""
    groups, size = rays.shape[:2]
    # from the first ray on, so that the differences of nearly parallel rays keep their digits
    offsets = rays - rays[:, :1]
    products = offsets @ offsets.transpose(0, 2, 1)
    squares = np.diagonal(products, axis1=1, axis2=2)
    chords = squares[:, :, None] + squares[:, None, :] - 2.0 * products
    first, second = np.divmod(np.argmax(chords.reshape(groups, -1), axis=1), size)
    rows = np.arange(groups)
    a, b = rays[rows, first], rays[rows, second]
    # exact near 0 and pi, where acos is not (Kahan)
    chord, sum_ = np.linalg.norm(a - b, axis=1), np.linalg.norm(a + b, axis=1)
    return np.asarray(2.0 * np.arctan2(chord, sum_))


def _sum_groups(values: F64, start: NDArray[np.int64]) -> F64:
    """Sum rows (O, k) by group to (L, k); empty groups give zero."""
    sums = np.zeros((len(start) - 1, values.shape[1]))
    filled = np.flatnonzero(np.diff(start) > 0)
    if len(filled):
        sums[filled] = np.add.reduceat(values, start[:-1][filled], axis=0)
    return sums
