"""Level of detail: fewer points that still look like all of them."""

from __future__ import annotations

import numpy as np

from maplab_py.array_types import F64, I64, U64

_BITS = 16
"""Levels of the octree: voxels of 1 / 65536 of the cloud's width."""


def spread_rows(p: F64, limit: int) -> I64:
    """Return at most `limit` rows of points (N, 3), spread evenly over the space they fill.

    Points are sorted along a Z-order curve. Of the finest octree level with no more occupied
    voxels than `limit`, the first point of each voxel is taken; the rest is filled up with every
    n-th of the others, so that dense places stay denser. The same input gives the same rows.
    """
    if len(p) <= limit:
        return np.arange(len(p), dtype=np.int64)
    key = _z_order(p)
    order = np.argsort(key, kind="stable")
    key = key[order]
    taken = np.zeros(len(p), dtype=np.bool_)
    for level in range(_BITS, -1, -1):
        voxel = key >> np.uint64(3 * level)
        first = np.append(True, voxel[1:] != voxel[:-1])
        if np.count_nonzero(first) > limit:
            break
        taken = first
    others = np.flatnonzero(~taken)
    missing = limit - int(np.count_nonzero(taken))
    taken[others[(np.arange(missing) * len(others)) // max(missing, 1)]] = True
    return np.sort(order[taken])


def _z_order(p: F64) -> U64:
    """Return the place (N,) of points (N, 3) on a Z-order curve through their bounding cube."""
    low = p.min(axis=0)
    width = max(float((p - low).max()), 1e-12)
    cell = np.minimum((p - low) / width * (1 << _BITS), (1 << _BITS) - 1).astype(np.uint64)
    x, y, z = (_spaced(cell[:, axis]) for axis in range(3))
    return np.asarray(x | y << np.uint64(1) | z << np.uint64(2))


def _spaced(x: U64) -> U64:
    """Put two zero bits between the 16 bits of each number."""
    for shift, mask in (
        (16, 0x0000FF0000FF),
        (8, 0x00F00F00F00F),
        (4, 0x0C30C30C30C3),
        (2, 0x249249249249),
    ):
        x = (x | x << np.uint64(shift)) & np.uint64(mask)
    return x
