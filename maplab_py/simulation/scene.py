"""The scene that is rendered: the boxes of a world with painted sides."""

from __future__ import annotations

import dataclasses
from typing import Self

import numpy as np

from maplab_py.array_types import F64
from maplab_py.simulation.scenario import ImageOptions
from maplab_py.simulation.surfaces import Surfaces, box_surfaces, join
from maplab_py.simulation.textures import Textures, make_textures, repainted

_THINNEST_M = 5e-4
"""Half the thickness of the thinnest wall that single precision does not look through."""


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """Boxes with painted sides. Box 0 is the space that is seen from inside.

    Side s of box b is surface 6 b + s, in the order of `box_surfaces`.
    """

    boxes: F64  # (B, 2, 3)
    surfaces: Surfaces  # (6 B)
    textures: Textures

    def repainted(self, share: float, rng: np.random.Generator) -> Self:
        """Return the scene with patches painted differently, `share` of its area."""
        if share == 0.0:
            return self
        return dataclasses.replace(
            self, textures=repainted(self.textures, self.surfaces, share, rng)
        )


def make_scene(bounds: F64, boxes: F64, options: ImageOptions, rng: np.random.Generator) -> Scene:
    """Paint the sides of a space (2, 3) and of the boxes (B, 2, 3) in it."""
    middle, half = boxes.mean(axis=1), 0.5 * np.diff(boxes, axis=1)[:, 0]
    half = np.maximum(half, _THINNEST_M)
    every = np.concatenate([bounds[None], np.stack([middle - half, middle + half], axis=1)])
    sides = [box_surfaces(b[0], b[1], inwards=row == 0) for row, b in enumerate(every)]
    surfaces = join(sides)
    return Scene(every, surfaces, make_textures(surfaces, options, rng))
