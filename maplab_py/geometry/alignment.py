"""Least-squares alignment of point sets: rigid, similarity, or yaw and position."""

import numpy as np
from numpy.typing import ArrayLike

from maplab_py.array_types import F64
from maplab_py.errors import EstimationError
from maplab_py.geometry import se3, so3, yaw

_RANK_TOLERANCE = 1e-12
"""Second singular value of the cross covariance, relative to the first, below which points are on a line."""


def umeyama(p_A: ArrayLike, p_B: ArrayLike, *, with_scale: bool = False) -> tuple[F64, float]:
    """Return (T_A_B (7,), scale) that minimise sum |p_A - (scale R_A_B p_B + p_A_B)|^2.

    Source: Umeyama 1991, eq. (34)-(42).

    Args:
        p_A: Points (N, 3) in A.
        p_B: The same points (N, 3) in B.
        with_scale: Estimate the scale (Sim(3)); else it is 1 (SE(3)).

    Raises:
        EstimationError: Fewer than three points, not finite, or all on one line.
    """
    a, b = _checked_points(p_A, p_B, minimum=3)
    mean_a, mean_b = a.mean(axis=0), b.mean(axis=0)
    centred_a, centred_b = a - mean_a, b - mean_b
    variance_b = float(np.mean(np.sum(centred_b**2, axis=1)))
    U, d, Vt = np.linalg.svd(centred_a.T @ centred_b / len(a))
    if d[1] <= _RANK_TOLERANCE * max(d[0], np.finfo(np.float64).tiny):
        raise EstimationError(
            f"cannot align {len(a)} points: they lie on one line, so the rotation is not determined"
        )
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
    R_A_B = U @ np.diag(signs) @ Vt
    scale = float(d @ signs) / variance_b if with_scale else 1.0
    q_A_B = so3.from_matrix(R_A_B)
    return se3.make(q_A_B, mean_a - scale * R_A_B @ mean_b), scale


def align_yaw_position(p_A: ArrayLike, p_B: ArrayLike, weight: ArrayLike | None = None) -> F64:
    """Return T_A_B (7,), a yaw about z and a position, that minimises sum w |p_A - T_A_B p_B|^2.

    Args:
        p_A: Points (N, 3) in A.
        p_B: The same points (N, 3) in B.
        weight: Weights (N,), not negative and not all zero; None = equal ones.

    Raises:
        EstimationError: Fewer than two points, not finite, or no horizontal extent.
    """
    a, b = _checked_points(p_A, p_B, minimum=2)
    w = np.ones(len(a)) if weight is None else np.asarray(weight, dtype=np.float64)
    mean_a, mean_b = (np.sum(w[:, None] * points, axis=0) / np.sum(w) for points in (a, b))
    u, v = (a - mean_a)[:, :2], (b - mean_b)[:, :2]
    # sum w |u - R v|^2 is least where the angle of sum w conj(v) u is undone
    cosine = float(np.sum(w[:, None] * u * v))
    sine = float(np.sum(w * (v[:, 0] * u[:, 1] - v[:, 1] * u[:, 0])))
    root = np.sqrt(w)[:, None]
    extent = float(np.linalg.norm(root * u) * np.linalg.norm(root * v))
    if extent == 0.0 or np.hypot(cosine, sine) <= _RANK_TOLERANCE * extent:
        raise EstimationError(
            f"cannot align {len(a)} points: they have no horizontal extent in common, so the yaw "
            "is not determined"
        )
    angle = float(np.arctan2(sine, cosine))
    return yaw.to_pose(np.append(mean_a - yaw.rotate(angle, mean_b), angle))


def apply_similarity(T_A_B: ArrayLike, scale: float, T_B_C: ArrayLike) -> F64:
    """Return T_A_C (..., 7) of poses whose positions are in the scaled frame B."""
    poses = np.array(T_B_C, dtype=np.float64)
    poses[..., 4:] *= scale
    return se3.compose(T_A_B, poses)


def _checked_points(p_A: ArrayLike, p_B: ArrayLike, *, minimum: int) -> tuple[F64, F64]:
    a, b = np.asarray(p_A, dtype=np.float64), np.asarray(p_B, dtype=np.float64)
    if a.ndim != 2 or a.shape != b.shape or a.shape[1] != 3:
        raise EstimationError(f"cannot align points of shapes {a.shape} and {b.shape}")
    if len(a) < minimum:
        raise EstimationError(f"cannot align {len(a)} points: at least {minimum} are needed")
    if not (np.all(np.isfinite(a)) and np.all(np.isfinite(b))):
        raise EstimationError("cannot align points that are not finite")
    return a, b
