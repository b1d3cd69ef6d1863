"""How well a point is known by the rays that cross in it, and whether two such points are one.

Every keypoint weighs the point's position across its ray by the inverse square of what its error
covers at that distance; along a ray nothing is known.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maplab_py.compilation import compiled

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

_FARTHEST_M = 100.0
"""Standard deviation of a point of which nothing is known."""


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
    return np.asarray(np.linalg.inv(information))


@compiled()
def _add_rays(to_point, sigma_rad, seen, owner, information):  # type: ignore[no-untyped-def]
    """Add (I - r r^T) / (sigma d)^2 of rays r d (O, 3) to the owners' information (L, 3, 3)."""
    for ray in range(len(owner)):
        x = to_point[ray]
        square = x[0] * x[0] + x[1] * x[1] + x[2] * x[2]
        if not seen[ray] or square == 0.0:
            continue
        weight = 1.0 / (sigma_rad[ray] * sigma_rad[ray] * square)
        for i in range(3):
            for j in range(3):
                across = (1.0 if i == j else 0.0) - x[i] * x[j] / square
                information[owner[ray], i, j] += weight * across


@compiled()
def squared_sigmas(  # type: ignore[no-untyped-def]
    gap, p_I, drift, closure, source, target, covariance, R_M_Gq, R_M_G, R_M_I, pose
):
    """Return gap^T C^-1 gap (N,), C from both landmarks, the closure's pose and drift.

    Args:
        gap: Source less target (N, 3), in M.
        p_I: Source (N, 3) as the query sees it.
        drift: Standard deviation (N,) of the rest.
        closure: Row (N,) of the last four.
        source: Row (N,) of covariances.
        target: Row (N,) of covariances.
        covariance: Of landmarks (L, 3, 3), in G.
        R_M_Gq: Rotation (C, 3, 3) that takes G to M as the closure says.
        R_M_G: The same as the base frames say.
        R_M_I: Attitude (C, 3, 3) of the query.
        pose: Covariance (C, 6, 6) of [position in M, angle in I].
    """
    J, C, result = np.zeros((3, 6)), np.empty((3, 3)), np.empty(len(gap))
    for i in range(3):
        J[i, i] = 1.0
    for row in range(len(gap)):
        c = closure[row]
        A, B, R, x = R_M_Gq[c], R_M_G[c], R_M_I[c], p_I[row]
        for i in range(3):  # -R [x]_x: turning the query by w moves the point by R (w x p_I)
            J[i, 3] = R[i, 2] * x[1] - R[i, 1] * x[2]
            J[i, 4] = R[i, 0] * x[2] - R[i, 2] * x[0]
            J[i, 5] = R[i, 1] * x[0] - R[i, 0] * x[1]
        for i in range(3):
            for j in range(3):
                total = drift[row] * drift[row] if i == j else 0.0
                for k in range(3):
                    for m in range(3):
                        total += A[i, k] * covariance[source[row], k, m] * A[j, m]
                        total += B[i, k] * covariance[target[row], k, m] * B[j, m]
                for k in range(6):
                    for m in range(6):
                        total += J[i, k] * pose[c, k, m] * J[j, m]
                C[i, j] = total
        result[row] = _quadratic(C, gap[row])
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
