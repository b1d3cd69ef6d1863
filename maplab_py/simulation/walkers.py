"""People who walk through a rendered session: textured boxes in front of the cameras."""

import dataclasses
import math
from typing import Self

import numpy as np

from maplab_py.array_types import F64
from maplab_py.geometry import so3
from maplab_py.simulation.scenario import SessionImages
from maplab_py.simulation.shading_kernels import PaintedBoxes
from maplab_py.simulation.spline import PoseSpline

_SIZE_M = np.array([0.5, 0.5, 1.75])
_AHEAD_M = (1.1, 1.9)
"""Distance in front of the body at which a person crosses its path."""
_SPEED_MPS = (0.3, 1.0)
_CROSSING_S = 2.5
_HIDDEN_M = 1e3
"""Below the floor, where nobody is seen."""


@dataclasses.dataclass(frozen=True, eq=False)
class Walkers:
    """W people. Each crosses the view at constant velocity again and again, every time elsewhere."""

    boxes: F64  # (W, 2, 3) at the origin, on the floor
    start_s: F64  # (W,) of the first crossing
    end_s: float  # after which nobody is seen
    place_G: F64  # (W, C, 2) in the middle of each crossing
    velocity_G: F64  # (W, C, 2) [m/s]

    @classmethod
    def of(
        cls, options: SessionImages, spline: PoseSpline, floor_m: float, rng: np.random.Generator
    ) -> Self:
        """Draw the crossings of a session, from the true motion of the body."""
        count = options.walkers
        low, high = options.walkers_from_s, options.walkers_until_s or spline.duration_s
        start_s = low + _CROSSING_S * np.arange(count) / max(count, 1)
        crossings = math.ceil(max(high - low, 0.0) / _CROSSING_S)
        middle_s = start_s[:, None] + _CROSSING_S * (np.arange(crossings) + 0.5)
        T_G_I = spline.evaluate(np.clip(middle_s.ravel(), 0.0, spline.duration_s)).T_G_I
        shape = count, crossings, 2
        ahead = so3.rotate(T_G_I[:, :4], np.array([1.0, 0.0, 0.0]))[:, :2].reshape(shape)
        ahead /= np.linalg.norm(ahead, axis=2, keepdims=True)
        sideways = np.stack([-ahead[..., 1], ahead[..., 0]], axis=2)
        place = T_G_I[:, 4:6].reshape(shape) + rng.uniform(*_AHEAD_M, (*shape[:2], 1)) * ahead
        speed = rng.uniform(*_SPEED_MPS, (*shape[:2], 1)) * rng.choice([-1.0, 1.0], (*shape[:2], 1))
        box = np.array([[*(-0.5 * _SIZE_M[:2]), 0.0], [*(0.5 * _SIZE_M[:2]), _SIZE_M[2]]])
        box[:, 2] += floor_m
        return cls(np.tile(box, (count, 1, 1)), start_s, high, place, speed * sideways)

    def offset(self, time_s: float) -> F64:
        """Return the offsets (W, 3) [m] of the boxes at a time [s]."""
        offset = np.tile([0.0, 0.0, -_HIDDEN_M], (len(self.boxes), 1))
        number, since_s = np.divmod(time_s - self.start_s, _CROSSING_S)
        is_seen = (number >= 0) & (number < self.place_G.shape[1]) & (time_s < self.end_s)
        row = np.flatnonzero(is_seen)
        crossing = number[row].astype(np.int64)
        walked = (since_s[row, None] - 0.5 * _CROSSING_S) * self.velocity_G[row, crossing]
        offset[row, :2], offset[row, 2] = self.place_G[row, crossing] + walked, 0.0
        return offset

    def moved(self, painted: PaintedBoxes, time_s: float) -> PaintedBoxes:
        """Return a scene, whose last boxes are these, as it is at a time [s]."""
        offset = self.offset(time_s).astype(np.float32)
        boxes, corner = painted.boxes.copy(), painted.corner.copy()
        boxes[-len(offset) :] += offset[:, None]
        corner[-6 * len(offset) :] += np.repeat(offset, 6, axis=0)
        return painted._replace(boxes=boxes, corner=corner)
