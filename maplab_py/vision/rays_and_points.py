"""Points near rays: candidates for matches when the pose is known."""

from typing import NamedTuple

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.compilation import compiled


class Rays(NamedTuple):
    """Rays of several problems; problem p has rows start[p] .. start[p + 1] - 1."""

    start: I64  # (P + 1,)
    origin: F64  # (R, 3)
    direction: F64  # (R, 3) unit vectors
    radius_rad: F64  # (R,) below a right angle


def points_near_rays(rays: Rays, point_start: I64, point: F64) -> tuple[I64, I64]:
    """Return rows of rays and points (N,) of one problem whose directions differ by the radius at most.

    Args:
        point_start: Offsets (P + 1,) of each problem's points.
        point: Points (M, 3) in the frame of the rays.
    """
    cosine = np.cos(rays.radius_rad)
    count = np.zeros(len(rays.origin), dtype=np.int64)
    empty = np.zeros(0, dtype=np.int64)
    _search(rays, cosine, point_start, point, count, empty)
    pairs = np.empty(int(count.sum()), dtype=np.int64)
    _search(rays, cosine, point_start, point, count, pairs)
    return np.repeat(np.arange(len(count)), count), pairs


@compiled()
def _search(rays, cosine, point_start, point, count, pairs):  # type: ignore[no-untyped-def]
    """Count the points of each ray if `pairs` is empty, else fill in their rows."""
    fills, filled = len(pairs) > 0, 0
    for problem in range(len(rays.start) - 1):
        for ray in range(rays.start[problem], rays.start[problem + 1]):
            x, d, inside = rays.origin[ray], rays.direction[ray], 0
            for row in range(point_start[problem], point_start[problem + 1]):
                a, b, c = point[row, 0] - x[0], point[row, 1] - x[1], point[row, 2] - x[2]
                along = a * d[0] + b * d[1] + c * d[2]
                limit = cosine[ray] * cosine[ray] * (a * a + b * b + c * c)
                if along > 0.0 and along * along >= limit:
                    if fills:
                        pairs[filled + inside] = row
                    inside += 1
            if not fills:
                count[ray] = inside
            filled += inside


def compile_kernels() -> None:
    """Compile the search on one ray."""
    start, x = np.array([0, 1]), np.ones((1, 3))
    points_near_rays(Rays(start, np.zeros((1, 3)), x / np.sqrt(3.0), np.ones(1)), start, x)
