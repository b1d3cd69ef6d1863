"""Matches guided by an approximate pose: landmarks in view and keypoints near their projections.

A search for the nearest descriptor in the whole map finds the landmark of a keypoint only if no
other landmark looks more similar. If an approximate pose predicts which landmarks are near which
keypoint, a similar descriptor suffices: a correct pose finds most visible landmarks, a wrong pose
almost none (active search: Sattler 2017).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from maplab_py.algorithms.localization.database import LocalizationMap
from maplab_py.array_types import F64, I8, I64, U64, NDArray
from maplab_py.compilation import compiled
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
        least_distances(projected, keypoint, table, start, rows, landmark, nearest)
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


def _in_view(database: LocalizationMap, view: View) -> tuple[I64, F64]:
    """Return the landmarks (N,) that may be visible, and unit vectors (N, 3) toward them."""
    s = database.sights
    visible = Landmarks(
        database.p_G, s.direction, s.least_cosine, s.nearest_m / _RANGE_FACTOR,
        s.farthest_m * _RANGE_FACTOR,
    )  # fmt: skip
    rows, toward = np.empty(len(database.p_G), dtype=np.int64), np.empty((len(database.p_G), 3))
    count = landmarks_in_view(visible, view, rows, toward)
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
    key, point = near_pairs(ray, np.cos(radius_rad), first, last, toward[order])
    return key, order[point]


def _view(pose: F64, centre: F64, ray: F64, radius_rad: float) -> View:
    """Return the cone around all rays (R, 3)."""
    axis = ray.mean(axis=0)
    axis /= max(float(np.linalg.norm(axis)), 1e-9)
    widest = float(np.arccos(np.clip((ray @ axis).min(), -1.0, 1.0)))
    return View(pose, centre, axis, float(np.cos(min(widest + radius_rad, np.pi))))


class Landmarks(NamedTuple):
    """L landmarks, and from where each may be visible."""

    p_G: F64  # (L, 3)
    direction: F64  # (L, 3) unit, in G, toward those who observed it
    least_cosine: F64  # (L,) of the angle to that direction
    nearest_m: F64  # (L,) distance
    farthest_m: F64  # (L,)


class View(NamedTuple):
    """A cone around all rays of a camera."""

    T_G_I: F64  # (3, 4) [R_G_I p_G_I]
    centre_I: F64  # (3,)
    axis_I: F64  # (3,) unit
    cosine: float  # of half its opening


@compiled()
def landmarks_in_view(landmarks, view, rows, toward):  # type: ignore[no-untyped-def]
    """Find landmarks that may be visible and lie in the cone; return how many.

    Args:
        view: Pose of the body and cone.
        rows: Output (L,): rows of these landmarks, ascending.
        toward: Output (L, 3): unit vectors toward them, in the body frame.
    """
    T, centre, axis = view.T_G_I, view.centre_I, view.axis_I
    count = 0
    for k in range(len(landmarks.p_G)):
        x = T[0, 3] - landmarks.p_G[k, 0]
        y = T[1, 3] - landmarks.p_G[k, 1]
        z = T[2, 3] - landmarks.p_G[k, 2]
        distance = np.sqrt(x * x + y * y + z * z)
        if distance >= landmarks.farthest_m[k] or distance <= landmarks.nearest_m[k]:
            continue
        d = landmarks.direction[k]
        if d[0] * x + d[1] * y + d[2] * z <= landmarks.least_cosine[k] * max(distance, 1e-9):
            continue
        a = -(T[0, 0] * x + T[1, 0] * y + T[2, 0] * z) - centre[0]
        b = -(T[0, 1] * x + T[1, 1] * y + T[2, 1] * z) - centre[1]
        c = -(T[0, 2] * x + T[1, 2] * y + T[2, 2] * z) - centre[2]
        length = max(np.sqrt(a * a + b * b + c * c), 1e-9)
        a, b, c = a / length, b / length, c / length
        if axis[0] * a + axis[1] * b + axis[2] * c <= view.cosine:
            continue
        toward[count, 0], toward[count, 1], toward[count, 2] = a, b, c
        rows[count] = k
        count += 1
    return count


@compiled()
def points_near(ray, cosine, first, last, toward, pairs):  # type: ignore[no-untyped-def]
    """Count pairs of rays and directions that are near each other; fill in as many as fit.

    Args:
        ray: Unit rays (R, 3).
        cosine: Cosine (R,) of the largest angle.
        first: First direction (R,) that may be near.
        last: One after the last of them (R,).
        toward: Unit vectors (N, 3).
        pairs: Output (P, 2): ray and direction, sorted by ray.
    """
    count = 0
    for r in range(len(ray)):
        a, b, c, limit = ray[r, 0], ray[r, 1], ray[r, 2], cosine[r]
        for k in range(first[r], last[r]):
            if a * toward[k, 0] + b * toward[k, 1] + c * toward[k, 2] > limit:
                if count < len(pairs):
                    pairs[count, 0], pairs[count, 1] = r, k
                count += 1
    return count


def near_pairs(ray: F64, cosine: F64, first: I64, last: I64, toward: F64) -> tuple[I64, I64]:
    """Return the pairs of `points_near`, all of them."""
    pairs = np.empty((4 * len(ray) + 64, 2), dtype=np.int64)
    count = points_near(ray, cosine, first, last, toward, pairs)
    if count > len(pairs):
        pairs = np.empty((count, 2), dtype=np.int64)
        points_near(ray, cosine, first, last, toward, pairs)
    return pairs[:count, 0], pairs[:count, 1]


@compiled()
def least_distances(projected, keypoint, table, start, rows, landmark, distance):  # type: ignore[no-untyped-def]
    """Fill in the least squared distance (N,) of a keypoint to a landmark's projected descriptors."""
    for n in range(len(keypoint)):
        nearest = np.float32(np.inf)
        for k in range(start[landmark[n]], start[landmark[n] + 1]):
            total = np.float32(0.0)
            for d in range(table.shape[1]):
                step = projected[keypoint[n], d] - table[rows[k], d]
                total += step * step
            nearest = min(nearest, total)
        distance[n] = nearest


def compile_kernels() -> None:
    """Compile the search on one ray."""
    unit, origin = np.ones(1), np.zeros((1, 3))
    landmarks = Landmarks(
        np.array([[0.0, 0.0, 2.0]]), np.array([[0.0, 0.0, -1.0]]), 0.0 * unit, unit, 3.0 * unit
    )
    forward = np.array([0.0, 0.0, 1.0])
    view = View(np.eye(3, 4), origin[0], forward, 0.5)
    rows, toward = np.zeros(1, dtype=np.int64), np.zeros((1, 3))
    landmarks_in_view(landmarks, view, rows, toward)
    near_pairs(toward, 0.5 * unit, rows, rows + 1, toward)
    table = np.zeros((1, 10), dtype=np.float32)
    least_distances(table, rows, table, np.array([0, 1]), rows, rows, unit)
