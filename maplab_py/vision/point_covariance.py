"""Covariance of points from their rays, and the Mahalanobis distance of two points.

Every keypoint contributes information across its ray, with the inverse square of its error at that
distance, and none along the ray.
"""

from typing import NamedTuple

import numpy as np

from maplab_py.array_types import F64, I64, NDArray
from maplab_py.compilation import compiled
from maplab_py.geometry import symmetric

_FARTHEST_M = 100.0
"""Standard deviation of an unknown point."""
_NEAREST_M = 0.01
"""Distance from which on rays fix a point no better; the inverse of their information would overflow."""


class LandmarkPairs(NamedTuple):
    """Landmarks that a query sees (sources) and those of places that were matched with them."""

    gap_M: F64  # (N, 3) source less target [m]
    p_I: F64  # (N, 3) source in the query's body frame [m]
    drift_m: F64  # (N,) standard deviation of what neither landmark nor pose account for
    closure: I64  # (N,) row of `ClosurePoses`
    source: I64  # (N,) row of the landmarks' covariances
    target: I64  # (N,)


class ClosurePoses(NamedTuple):
    """Poses of queries as their closures say, M the mission of the place."""

    R_M_Gq: F64  # (C, 3, 3) takes coordinates in G to M as the closure says
    R_M_G: F64  # (C, 3, 3) the same as the base frames say
    R_M_I: F64  # (C, 3, 3) attitude of the query
    covariance: F64  # (C, 6, 6) of [position in M, angle in I]


def covariance_by_rays(
    to_point: F64, sigma_rad: F64, seen: NDArray[np.bool_], owner: I64, points: int
) -> F64:
    """Return the covariances (points, 3, 3) of points.

    Args:
        to_point: From the camera to the point (O, 3), in the frame of the result [m].
        sigma_rad: Standard deviation (O,) of each ray.
        seen: Rays (O,) that count.
        owner: Point (O,) of each ray.
        points: Number of points.
    """
    information = np.tile(np.eye(3) / _FARTHEST_M**2, (points, 1, 1))
    _add_rays(to_point, sigma_rad, seen, owner, information)
    return symmetric.inverse(information, 1.0 / _FARTHEST_M**2)


@compiled()
def _add_rays(to_point, sigma_rad, seen, owner, information):  # type: ignore[no-untyped-def]
    """Add (I - r r^T) / (sigma d)^2 of rays r d (O, 3) to the owners' information (L, 3, 3)."""
    for ray in range(len(owner)):
        x = to_point[ray]
        square = x[0] * x[0] + x[1] * x[1] + x[2] * x[2]
        if not seen[ray] or not 0.0 < square < np.inf:  # at the camera, at infinity, or no number
            continue
        weight = 1.0 / (sigma_rad[ray] * sigma_rad[ray] * max(square, _NEAREST_M * _NEAREST_M))
        for i in range(3):
            for j in range(3):
                across = (1.0 if i == j else 0.0) - x[i] * x[j] / square
                information[owner[ray], i, j] += weight * across


@compiled()
def squared_sigmas(pairs: LandmarkPairs, covariance: F64, closures: ClosurePoses) -> F64:
    """Return gap^T C^-1 gap (N,), C from both landmarks, the closure's pose and drift.

    Args:
        pairs: Matched landmarks.
        covariance: Of landmarks (L, 3, 3), in G.
        closures: Poses of the queries.
    """
    J, C, result = np.zeros((3, 6)), np.empty((3, 3)), np.empty(len(pairs.gap_M))
    for i in range(3):
        J[i, i] = 1.0
    for row in range(len(pairs.gap_M)):
        c = pairs.closure[row]
        A, B, R, x = closures.R_M_Gq[c], closures.R_M_G[c], closures.R_M_I[c], pairs.p_I[row]
        source, target = covariance[pairs.source[row]], covariance[pairs.target[row]]
        pose, drift = closures.covariance[c], pairs.drift_m[row]
        for i in range(3):  # -R [x]_x: turning the query by w moves the point by R (w x p_I)
            J[i, 3] = R[i, 2] * x[1] - R[i, 1] * x[2]
            J[i, 4] = R[i, 0] * x[2] - R[i, 2] * x[0]
            J[i, 5] = R[i, 1] * x[0] - R[i, 0] * x[1]
        for i in range(3):
            for j in range(3):
                total = drift * drift if i == j else 0.0
                for k in range(3):
                    for m in range(3):
                        total += A[i, k] * source[k, m] * A[j, m]
                        total += B[i, k] * target[k, m] * B[j, m]
                for k in range(6):
                    for m in range(6):
                        total += J[i, k] * pose[k, m] * J[j, m]
                C[i, j] = total
        result[row] = _quadratic(C, pairs.gap_M[row])
    return result


@compiled(forceinline=True)
def _quadratic(C, x):  # type: ignore[no-untyped-def]
    """Return x^T C^-1 x by Cramer's rule, C (3, 3) symmetric."""
    a = C[1, 1] * C[2, 2] - C[1, 2] * C[1, 2]
    b = C[0, 2] * C[1, 2] - C[0, 1] * C[2, 2]
    c = C[0, 1] * C[1, 2] - C[0, 2] * C[1, 1]
    d = C[0, 0] * C[2, 2] - C[0, 2] * C[0, 2]
    e = C[0, 1] * C[0, 2] - C[0, 0] * C[1, 2]
    f = C[0, 0] * C[1, 1] - C[0, 1] * C[0, 1]
    determinant = C[0, 0] * a + C[0, 1] * b + C[0, 2] * c
    y0 = a * x[0] + b * x[1] + c * x[2]
    y1 = b * x[0] + d * x[1] + e * x[2]
    y2 = c * x[0] + e * x[1] + f * x[2]
    return (x[0] * y0 + x[1] * y1 + x[2] * y2) / determinant


def compile_kernels() -> None:
    """Compile covariance and distance on one landmark."""
    row, x, sigma, R = np.zeros(1, dtype=np.int64), np.ones((1, 3)), np.ones(1), np.eye(3)[None]
    covariance = covariance_by_rays(x, sigma, sigma > 0.0, row, 1)
    pairs = LandmarkPairs(x, x, sigma, row, row, row)
    squared_sigmas(pairs, covariance, ClosurePoses(R, R, R, np.eye(6)[None]))
