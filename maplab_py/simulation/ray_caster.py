"""Ray casting of images and depth of a scene through the true camera model."""

from __future__ import annotations

import dataclasses
from typing import Self

import numpy as np

from maplab_py.array_types import F32, F64, Mask
from maplab_py.geometry import so3
from maplab_py.simulation.ray_kernels import PixelRays, cast_rays
from maplab_py.simulation.scene import Scene
from maplab_py.simulation.shading_kernels import TILE, PaintedBoxes, pack_texels


def painted_boxes(scene: Scene) -> PaintedBoxes:
    """Return a scene as the ray caster reads it; its texels take four times the memory."""
    textures = scene.textures
    layout = np.stack([textures.offset, textures.width, textures.height], axis=2).astype(np.int32)
    texels = np.empty(len(textures.pixels), dtype=np.int32)
    pack_texels(textures.pixels, layout, texels)
    return PaintedBoxes(
        scene.boxes.astype(np.float32),
        scene.surfaces.corner.astype(np.float32),
        texels,
        layout,
        np.float32(textures.texel_m),
    )


@dataclasses.dataclass(frozen=True, eq=False)
class RayCaster:
    """A camera model in a scene."""

    painted: PaintedBoxes
    rays: PixelRays

    @classmethod
    def of(cls, painted: PaintedBoxes, rays: F64, focal_px: float) -> Self:
        """Prepare the rays of a camera.

        Args:
            painted: The scene, see `painted_boxes`.
            rays: Points (H, W, 2) on the plane z = 1, NaN = black.
            focal_px: Focal length, which determines the footprint of a pixel.
        """
        seen = np.isfinite(rays[..., 0])
        x, y = (np.where(seen, rays[..., axis], 0.0).astype(np.float32) for axis in (0, 1))
        directions = np.stack([x, y, np.ones_like(x)], axis=2)
        row_cones = _cones(directions, seen, max(1, x.shape[1]))[:, 0]
        cones = _cones(directions, seen, TILE)
        is_seen = seen.astype(np.float32)
        return cls(painted, PixelRays(x, y, is_seen, row_cones, cones, np.float32(focal_px)))

    def render(self, T_G_C: F64) -> tuple[F32, F32]:
        """Return grey values (H, W) in 0 .. 255 and depths along z (H, W) [m]; 0 without a ray.

        Args:
            T_G_C: Pose (1, 7) of the camera, or (H, 7) at each row.
        """
        grey, depth = np.zeros_like(self.rays.seen), np.zeros_like(self.rays.seen)
        self.add(T_G_C, 1.0, grey, depth)
        return grey, depth

    def add(self, T_G_C: F64, weight: float, grey: F32, depth: F32) -> None:
        """Add weighted grey values to `grey` (H, W), and overwrite `depth` (H, W)."""
        R_G_C = so3.to_matrix(T_G_C[:, :4]).astype(np.float32)
        p_G_C = T_G_C[:, 4:].astype(np.float32)
        cast_rays(self.painted, self.rays, R_G_C, p_G_C, np.float32(weight), grey, depth)


def _cones(rays: F32, seen: Mask, tile: int) -> F32:
    """Return cones (H, tiles, 5) about rays (H, W, 3): axis, cosine and sine of the half angle.

    Args:
        rays: Rays of any length.
        seen: Which of them (H, W) exist; a tile without any gets a cone without an axis.
        tile: Rays of a row that share a cone.
    """
    height, width = seen.shape
    # in double precision: the sine of a narrow cone is lost in single precision
    direction = rays.astype(np.float64)
    direction /= np.linalg.norm(direction, axis=2, keepdims=True)
    cones = np.empty((height, -(-width // tile), 5), dtype=np.float32)
    for number, first in enumerate(range(0, width, tile)):
        part, there = direction[:, first : first + tile], seen[:, first : first + tile]
        axis = np.sum(part * there[..., None], axis=1)
        axis /= np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-6)
        cosine = np.where(there, np.einsum("hwi,hi->hw", part, axis), 1.0).min(axis=1)
        cones[:, number, :3], cones[:, number, 3] = axis, cosine
        cones[:, number, 4] = np.sqrt(np.maximum(1.0 - cosine**2, 0.0))
    return cones
