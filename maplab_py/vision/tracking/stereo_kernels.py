"""Compiled kernels of stereo: where a point is sought, and whether two rays meet in front of the cameras."""

import numpy as np

from maplab_py.compilation import compiled

_NEIGHBOURS = 3
"""A point of unknown distance is sought at the median inverse distance of so many neighbours."""
MIN_DISTANCE_M, FAR_M = 0.05, 1000.0


@compiled()
def expect_distances(uv, distance_m, default_m, expected_m):  # type: ignore[no-untyped-def]
    """Fill in the distances (K,) at which points are sought: known ones, else those of neighbours.

    Args:
        uv: Keypoints (K, 2).
        distance_m: Known distances (K,), NaN = unknown.
        default_m: Distance while there are too few neighbours.
        expected_m: Filled in.
    """
    known = np.flatnonzero(np.isfinite(distance_m))
    square, inverse = np.empty(_NEIGHBOURS), np.empty(_NEIGHBOURS)
    for k in range(len(uv)):
        expected_m[k] = distance_m[k]
        if np.isfinite(distance_m[k]):
            continue
        if len(known) < _NEIGHBOURS:
            expected_m[k] = default_m
            continue
        square[:] = np.inf
        for other in known:
            du, dv = uv[other, 0] - uv[k, 0], uv[other, 1] - uv[k, 1]
            place, here = _NEIGHBOURS, du * du + dv * dv
            while place > 0 and here < square[place - 1]:
                place -= 1
                if place + 1 < _NEIGHBOURS:
                    square[place + 1], inverse[place + 1] = square[place], inverse[place]
            if place < _NEIGHBOURS:
                square[place], inverse[place] = here, 1.0 / distance_m[other]
        expected_m[k] = 1.0 / np.median(inverse)


@compiled()
def check_matches(a, b, p, gate, is_match, distance_m):  # type: ignore[no-untyped-def]
    """Reject matches off their epipolar plane or behind a camera; fill in the distances of the others.

    Where the rays are nearly parallel, noise decides on which side they meet: these points are far away.

    Args:
        a: Unit rays (K, 3) from the origin.
        b: Unit rays (K, 3) from p.
        p: (3,).
        gate: Largest distance of b to the plane of a and p.
        is_match: (K,), changed.
        distance_m: Filled in (K,), along a; NaN where there is no match.
    """
    for k in range(len(a)):
        x, y, z = a[k]
        # normals of the planes of p and a, p and b, a and b
        na = (p[1] * z - p[2] * y, p[2] * x - p[0] * z, p[0] * y - p[1] * x)
        u, v, w = b[k]
        nb = (p[1] * w - p[2] * v, p[2] * u - p[0] * w, p[0] * v - p[1] * u)
        n = (y * w - z * v, z * u - x * w, x * v - y * u)
        length = np.sqrt(na[0] * na[0] + na[1] * na[1] + na[2] * na[2])
        off = (na[0] * u + na[1] * v + na[2] * w) / (length if length > 1e-9 else 1.0)
        square = max(n[0] * n[0] + n[1] * n[1] + n[2] * n[2], 1e-18)
        along_a = (nb[0] * n[0] + nb[1] * n[1] + nb[2] * n[2]) / square
        along_b = (na[0] * n[0] + na[1] * n[1] + na[2] * n[2]) / square
        is_ahead = along_a > 0.0 and along_b > 0.0
        is_far = np.sqrt((x - u) ** 2 + (y - v) ** 2 + (z - w) ** 2) <= gate
        is_match[k] &= abs(off) <= gate
        is_match[k] &= is_far or (is_ahead and along_a >= MIN_DISTANCE_M)
        distance_m[k] = np.nan
        if is_match[k]:
            distance_m[k] = min(max(along_a, MIN_DISTANCE_M), FAR_M) if is_ahead else FAR_M
