"""Matches guided by an approximate pose: landmarks in view and keypoints near their projections.

A search for the nearest descriptor in the whole map finds the landmark of a keypoint only if no
other landmark looks more similar. If an approximate pose predicts which landmarks are near which
keypoint, a similar descriptor suffices: a correct pose finds most visible landmarks, a wrong pose
almost none (active search: Sattler 2017).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.localization.database import LocalizationMap
from maplab_py.array_types import F64, I8, I64, U64
from maplab_py.geometry import se3
from maplab_py.vimap.table import ragged_rows

_RANGE_FACTOR = 2.0
"""Tolerance on the distance from which a landmark is expected to be visible."""
_ROUNDING = 1e-9
"""Of coordinates of unit vectors."""


def guided_matches(
    database: LocalizationMap,
    T_G_I: F64,
    *,
    projected: NDArray[np.float32],
    words: U64 | I8,
    origin_I: F64,
    ray_I: F64,
    radius_rad: F64,
    max_distance: float,
) -> tuple[I64, I64]:
    """Return keypoints and landmarks of matches near a pose, sorted by keypoint.

    Args:
        database: The map.
        T_G_I: Approximate pose (7,) of the query.
        projected: Projected descriptors (N, dimensions) of its keypoints.
        words: Descriptors (N, W) as the map compares them; empty rows for summary maps.
        origin_I: Camera centres (N, 3) of the keypoints in the body frame [m].
        ray_I: Unit rays (N, 3) of the keypoints in the body frame.
        radius_rad: Angle (N,) around each ray in which landmarks are searched.
        max_distance: Largest difference of descriptors, or squared distance of projected ones.
    """
    landmarks = np.flatnonzero(_in_range(database, T_G_I[4:]))
    p_I = se3.transform(se3.inverse(T_G_I), database.p_G[landmarks])
    keypoint, near = _near_rays(origin_I, ray_I, radius_rad, p_I)
    landmark = landmarks[near]
    if len(keypoint) == 0:
        return keypoint, landmark
    start, rows = database.rows_of
    count = np.diff(start)[landmark]
    row = rows[ragged_rows(start, landmark)]
    owner = np.repeat(keypoint, count)
    if database.has_descriptors:
        from maplab_py.vision.search_kernels import differences_between

        distance = np.empty(len(row))
        differences_between(words, owner, database.descriptors.words, row, distance)
    else:
        offset = projected[owner] - database.descriptors.projected[row]
        distance = np.einsum("nd,nd->n", offset, offset).astype(np.float64)
    nearest = np.minimum.reduceat(distance, np.cumsum(count) - count)
    similar = nearest <= max_distance
    return keypoint[similar], landmark[similar]


def _in_range(database: LocalizationMap, p_G_I: F64) -> NDArray[np.bool_]:
    """Return which landmarks (L,) may be visible from a position, given where they were observed."""
    s, (p_G, direction) = database.sights, database.coordinates
    x, y, z = p_G_I[0] - p_G[0], p_G_I[1] - p_G[1], p_G_I[2] - p_G[2]
    distance = np.sqrt(x * x + y * y + z * z)
    inside = (distance < _RANGE_FACTOR * s.farthest_m) & (distance * _RANGE_FACTOR > s.nearest_m)
    along = direction[0] * x + direction[1] * y + direction[2] * z
    return np.asarray(inside & (along > s.least_cosine * np.maximum(distance, 1e-9)))


def _near_rays(origin_I: F64, ray_I: F64, radius_rad: F64, p_I: F64) -> tuple[I64, I64]:
    """Return the pairs of rays and points within the radius, sorted by ray."""
    keypoints, points = [], []
    centres, camera = np.unique(origin_I, axis=0, return_inverse=True)
    camera = camera.reshape(-1)
    for number, centre in enumerate(centres):
        mine = np.flatnonzero(camera == number)
        toward = p_I - centre
        toward /= np.maximum(np.linalg.norm(toward, axis=1), 1e-9)[:, None]
        in_view = np.flatnonzero(_in_cone(ray_I[mine], float(radius_rad[mine].max()), toward))
        ray, point = _candidates(ray_I[mine], radius_rad[mine], toward[in_view])
        # written out: BLAS threads do not pay off for an inner dimension of 3
        (a, b, c), (x, y, z) = ray_I[mine[ray]].T, toward[in_view[point]].T
        near = a * x + b * y + c * z > np.cos(radius_rad[mine])[ray]
        ray, point = ray[near], point[near]
        order = np.lexsort((point, ray))
        ray, point = ray[order], point[order]
        keypoints.append(mine[ray])
        points.append(in_view[point])
    keypoint, point = np.concatenate(keypoints), np.concatenate(points)
    order = np.argsort(keypoint, kind="stable")
    return keypoint[order], point[order]


def _candidates(ray: F64, radius_rad: F64, toward: F64) -> tuple[I64, I64]:
    """Return the pairs of rays (R, 3) and directions (N, 3) that are near in two coordinates.

    Unit vectors no more than an angle apart differ by no more than that angle along any axis.
    """
    first_axis, second_axis = np.argsort(-np.ptp(ray, axis=0), kind="stable")[:2]
    order = np.argsort(toward[:, first_axis], kind="stable")
    along, across = toward[order, first_axis], toward[order, second_axis]
    reach, place = radius_rad + _ROUNDING, ray[:, first_axis]
    first = np.searchsorted(along, place - reach, side="left")
    count = np.searchsorted(along, place + reach, side="right") - first
    end = np.cumsum(count)
    row = np.arange(end[-1]) - np.repeat(end - count - first, count)
    of_ray = np.repeat(np.arange(len(ray)), count)
    offset = across[row] - np.repeat(ray[:, second_axis], count)
    near = np.flatnonzero(np.abs(offset) <= np.repeat(reach, count))
    return of_ray[near], order[row[near]]


def _in_cone(ray: F64, radius_rad: float, toward: F64) -> NDArray[np.bool_]:
    """Return which directions (N, 3) lie inside or near the cone around all rays (R, 3)."""
    axis = ray.mean(axis=0)
    axis /= max(float(np.linalg.norm(axis)), 1e-9)
    widest = float(np.arccos(np.clip((ray @ axis).min(), -1.0, 1.0)))
    return np.asarray(toward @ axis > np.cos(min(widest + radius_rad, np.pi)))
