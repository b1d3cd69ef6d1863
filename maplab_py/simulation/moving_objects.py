"""Moving objects with landmarks, which a static map must reject."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.array_types import F64
from maplab_py.simulation.scenario import WorldOptions
from maplab_py.simulation.surfaces import box_surfaces, scatter

_SIZE_M = np.array([0.6, 0.6, 1.5])
_REACH_M = (1.0, 2.5)


@dataclasses.dataclass(frozen=True, eq=False)
class MovingObject:
    """A box that oscillates; its landmarks are stored at the middle of its path."""

    reach_G: F64  # (3,) from the middle to a turning point [m]
    period_s: float
    phase: float

    def displacement(self, time_s: F64) -> F64:
        """Return the offset (N, 3) [m] of the object from the middle of its path at times (N,)."""
        swing = np.sin(2.0 * np.pi * time_s / self.period_s + self.phase)
        return np.asarray(swing[:, None] * self.reach_G)


def make_moving_objects(
    count: int, landmarks: int, speed_mps: float, bounds: F64, rng: np.random.Generator
) -> tuple[tuple[MovingObject, ...], F64, F64]:
    """Draw objects inside bounds (2, 3).

    Returns:
        The objects; points and normals (count * landmarks, 3), object after object.
    """
    objects, points, normals = [], [], []
    for _ in range(count):
        margin = 0.5 * _SIZE_M[:2] + 0.3
        xy = rng.uniform(bounds[0, :2] + margin, bounds[1, :2] - margin)
        angle = rng.uniform(0.0, 2.0 * np.pi)
        direction = np.array([np.cos(angle), np.sin(angle)])
        # as far as the walls allow in both directions
        room = np.minimum(xy - bounds[0, :2], bounds[1, :2] - xy) - margin
        allowed = float(np.min(room / np.maximum(np.abs(direction), 1e-9)))
        reach = min(rng.uniform(*_REACH_M), max(allowed, 0.0))
        low = np.array([*(xy - 0.5 * _SIZE_M[:2]), bounds[0, 2]])
        surfaces = box_surfaces(low, low + _SIZE_M, inwards=False)
        p, n = scatter(surfaces, WorldOptions(patchiness=0.0), landmarks, rng)
        points.append(p)
        normals.append(n)
        # mean speed of a sinusoid: 4 reach / period
        period = max(4.0 * reach / speed_mps, 1.0)
        phase = rng.uniform(0.0, 2.0 * np.pi)
        objects.append(MovingObject(np.append(reach * direction, 0.0), period, phase))
    return tuple(objects), np.concatenate(points), np.concatenate(normals)
