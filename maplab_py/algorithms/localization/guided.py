"""Matches guided by an approximate pose: landmarks in view and keypoints near their projections.

A search for the nearest descriptor in the whole map finds the landmark of a keypoint only if no
other landmark looks more similar. If an approximate pose predicts which landmarks are near which
keypoint, a similar descriptor suffices: a correct pose finds most visible landmarks, a wrong pose
almost none (active search: Sattler 2017).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.localization import guided_kernels as kernels
from maplab_py.algorithms.localization.database import LocalizationMap
from maplab_py.array_types import F64, I8, I64, U64
from maplab_py.geometry import so3
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
    keypoint, landmark = _near_rays(database, T_G_I, origin_I, ray_I, radius_rad)
    if len(keypoint) == 0:
        return keypoint, landmark
    start, rows = database.rows_of
    if database.has_descriptors:
        nearest = _least_differences(database, words, keypoint, landmark)
    else:
        nearest = np.empty(len(keypoint))
        table = database.descriptors.projected
        kernels.least_distances(projected, keypoint, table, start, rows, landmark, nearest)
    similar = nearest <= max_distance
    return keypoint[similar], landmark[similar]


def _least_differences(
    database: LocalizationMap, words: U64 | I8, keypoint: I64, landmark: I64
) -> F64:
    """Return the least difference (N,) of a keypoint to the descriptors of a landmark."""
    from maplab_py.vision.search_kernels import differences_between

    start, rows = database.rows_of
    count = np.diff(start)[landmark]
    row = rows[ragged_rows(start, landmark)]
    distance = np.empty(len(row))
    differences_between(
        words, np.repeat(keypoint, count), database.descriptors.words, row, distance
    )
    return np.asarray(np.minimum.reduceat(distance, np.cumsum(count) - count))


def _near_rays(
    database: LocalizationMap, T_G_I: F64, origin_I: F64, ray_I: F64, radius_rad: F64
) -> tuple[I64, I64]:
    """Return the pairs of keypoints and visible landmarks within the radius, sorted by keypoint."""
    keypoints: list[I64] = []
    landmarks: list[I64] = []
    pose = np.concatenate([so3.to_matrix(T_G_I[:4]), T_G_I[4:, None]], axis=1)
    centres, camera = np.unique(origin_I, axis=0, return_inverse=True)
    camera = camera.reshape(-1)
    for number, centre in enumerate(centres):
        mine = np.flatnonzero(camera == number)
        ray, radius = ray_I[mine], radius_rad[mine]
        rows, toward = _in_view(database, _view(pose, centre, ray, float(radius.max())))
        key, point = _near(ray, radius, toward)
        keypoints.append(mine[key])
        landmarks.append(rows[point])
    keypoint, landmark = np.concatenate(keypoints), np.concatenate(landmarks)
    order = np.lexsort((landmark, keypoint))
    return keypoint[order], landmark[order]


def _in_view(database: LocalizationMap, view: kernels.View) -> tuple[I64, F64]:
    """Return the landmarks (N,) that may be visible, and unit vectors (N, 3) toward them."""
    s = database.sights
    visible = kernels.Landmarks(
        database.p_G, s.direction, s.least_cosine, s.nearest_m / _RANGE_FACTOR,
        s.farthest_m * _RANGE_FACTOR,
    )  # fmt: skip
    rows, toward = np.empty(len(database.p_G), dtype=np.int64), np.empty((len(database.p_G), 3))
    count = kernels.landmarks_in_view(visible, view, rows, toward)
    return rows[:count], toward[:count]


def _near(ray: F64, radius_rad: F64, toward: F64) -> tuple[I64, I64]:
    """Return the pairs of rays (R, 3) and directions (N, 3) within the radius (R,).

    Unit vectors no more than an angle apart differ by no more than that angle along any axis.
    """
    axis = int(np.argmax(np.ptp(ray, axis=0)))
    order = np.argsort(toward[:, axis])
    along, reach = toward[order, axis], radius_rad + _ROUNDING
    first = np.searchsorted(along, ray[:, axis] - reach, side="left")
    last = np.searchsorted(along, ray[:, axis] + reach, side="right")
    key, point = kernels.near_pairs(ray, np.cos(radius_rad), first, last, toward[order])
    return key, order[point]


def _view(pose: F64, centre: F64, ray: F64, radius_rad: float) -> kernels.View:
    """Return the cone around all rays (R, 3)."""
    axis = ray.mean(axis=0)
    axis /= max(float(np.linalg.norm(axis)), 1e-9)
    widest = float(np.arccos(np.clip((ray @ axis).min(), -1.0, 1.0)))
    return kernels.View(pose, centre, axis, float(np.cos(min(widest + radius_rad, np.pi))))
