"""Textures of a world's surfaces, as image pyramids in one flat array."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.simulation.surfaces import Surfaces

F32 = NDArray[np.float32]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]

LEVELS = 5
"""Each level halves the resolution of the one before."""
_SHAPES_PER_M2 = 40.0
_SHAPE_SIZES_M = (0.015, 0.3)
_MOST_PIXELS = 40_000_000


@dataclasses.dataclass(frozen=True, eq=False)
class Textures:
    """Grey images of S surfaces in `LEVELS` resolutions; a row of pixels lies along side_u."""

    pixels: U8  # (N,) all images one after the other
    offset: I64  # (S, LEVELS) of the first pixel
    width: I64  # (S, LEVELS)
    height: I64  # (S, LEVELS)
    texel_m: float  # of the finest level

    def sample(self, surface: I64, u_m: F32, v_m: F32, footprint_m: F32) -> F32:
        """Return grey values (N,) at places on surfaces (N,), blurred as their footprint asks.

        Bilinear in the plane, linear between the two levels whose texels enclose the footprint.
        """
        texel = np.float32(self.texel_m)
        level = np.clip(np.log2(np.maximum(footprint_m / texel, 1.0)), 0.0, LEVELS - 1.001)
        fine = level.astype(np.int64)
        share = level - fine.astype(np.float32)
        below = self._bilinear(surface, fine, u_m, v_m)
        return np.asarray(below + share * (self._bilinear(surface, fine + 1, u_m, v_m) - below))

    def _bilinear(self, surface: I64, level: I64, u_m: F32, v_m: F32) -> F32:
        image = LEVELS * surface + level
        scale = (np.float32(1.0 / self.texel_m) * np.float32(0.5) ** np.arange(LEVELS)).astype(
            np.float32
        )[level]
        right, bottom = self.width.ravel()[image] - 1, self.height.ravel()[image] - 1
        x = np.clip(u_m * scale - np.float32(0.5), 0, right.astype(np.float32))
        y = np.clip(v_m * scale - np.float32(0.5), 0, bottom.astype(np.float32))
        column, row = x.astype(np.int64), y.astype(np.int64)
        fx, fy = x - column.astype(np.float32), y - row.astype(np.float32)
        to_right = column < right
        first = self.offset.ravel()[image] + row * (right + 1) + column
        upper = self._between(first, to_right, fx)
        first += np.where(row < bottom, right + 1, 0)
        return np.asarray(upper + fy * (self._between(first, to_right, fx) - upper))

    def _between(self, first: I64, to_right: NDArray[np.bool_], share: F32) -> F32:
        left = self.pixels.take(first).astype(np.float32)
        right = self.pixels.take(first + to_right).astype(np.float32)
        return np.asarray(left + share * (right - left))


def make_textures(surfaces: Surfaces, texel_m: float, rng: np.random.Generator) -> Textures:
    """Paint surfaces with overlapping shapes of many sizes: corners and edges at every distance.

    Where all of them together would need more than 40 million pixels, texels are made larger.
    """
    area = float(np.maximum(surfaces.area, texel_m**2).sum())
    texel_m = max(texel_m, np.sqrt(area / _MOST_PIXELS))
    images, offset = [], 0
    starts = np.zeros((len(surfaces.normal), LEVELS), dtype=np.int64)
    widths, heights = np.zeros_like(starts), np.zeros_like(starts)
    for row, (side_u, side_v) in enumerate(zip(surfaces.side_u, surfaces.side_v, strict=True)):
        size_m = float(np.linalg.norm(side_u)), float(np.linalg.norm(side_v))
        for level, image in enumerate(_pyramid(_painted(*size_m, texel_m, rng))):
            starts[row, level] = offset
            heights[row, level], widths[row, level] = image.shape
            offset += image.size
            images.append(image.ravel())
    return Textures(np.concatenate(images), starts, widths, heights, texel_m)


def _painted(u_m: float, v_m: float, texel_m: float, rng: np.random.Generator) -> U8:
    """Return a grey image of a surface (v, u)."""
    import cv2

    width, height = (max(1, round(side / texel_m)) for side in (u_m, v_m))
    image = np.full((height, width), int(rng.integers(90, 170)), dtype=np.uint8)
    count = int(_SHAPES_PER_M2 * u_m * v_m)
    low, high = np.log(_SHAPE_SIZES_M)
    # the large ones first, so that small ones stay visible on top of them
    sizes = np.sort(np.exp(rng.uniform(low, high, count)))[::-1] / texel_m
    centres = rng.uniform(0.0, 1.0, (count, 2)) * (width, height)
    angles = np.sort(rng.uniform(0.0, 2.0 * np.pi, (count, 4)), axis=1)
    greys = rng.integers(15, 240, count)
    corners = sizes[:, None, None] * np.stack([np.cos(angles), np.sin(angles)], axis=2)
    polygons = np.round((centres[:, None] + corners) * 8.0).astype(np.int32)
    for polygon, grey in zip(polygons, greys.tolist(), strict=True):
        cv2.fillPoly(image, [polygon], grey, lineType=cv2.LINE_AA, shift=3)
    return image


def _pyramid(image: U8) -> list[U8]:
    """Return the image and its means over 2 x 2, 4 x 4, ... pixels."""
    import cv2

    levels = [image]
    for _ in range(LEVELS - 1):
        height, width = levels[-1].shape
        size = (max(1, (width + 1) // 2), max(1, (height + 1) // 2))
        levels.append(np.asarray(cv2.resize(levels[-1], size, interpolation=cv2.INTER_AREA)))
    return levels
