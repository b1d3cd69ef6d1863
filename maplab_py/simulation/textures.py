"""Textures of a world's surfaces, as image pyramids in one flat array."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator

import numpy as np

from maplab_py.array_types import I64, U8, Mask
from maplab_py.simulation.scenario import ImageOptions
from maplab_py.simulation.shading_kernels import LEVELS
from maplab_py.simulation.surfaces import Surfaces

_SHAPES_PER_M2 = 40.0
_BARE_SHAPES_PER_M2 = 0.4
_SHAPE_SIZES_M = (0.015, 0.3)
_MOST_PIXELS = 40_000_000
_PATCH_M = 0.5
"""Side of the squares that are repainted."""


@dataclasses.dataclass(frozen=True, eq=False)
class Textures:
    """Grey images of S surfaces in `LEVELS` resolutions; a row of pixels lies along side_u."""

    pixels: U8  # (N,) all images one after the other
    offset: I64  # (S, LEVELS) of the first pixel
    width: I64  # (S, LEVELS)
    height: I64  # (S, LEVELS)
    texel_m: float  # of the finest level
    is_bare: Mask  # (S,) surfaces with hardly any shapes


def make_textures(surfaces: Surfaces, options: ImageOptions, rng: np.random.Generator) -> Textures:
    """Paint surfaces with overlapping shapes of many sizes: corners and edges at every distance.

    A share of the surfaces stays bare: a hundredth of the shapes. Where all textures together would
    need more than 40 million pixels, texels are made larger.
    """
    area = float(np.maximum(surfaces.area, options.texel_m**2).sum())
    texel_m = max(options.texel_m, np.sqrt(area / _MOST_PIXELS))
    is_bare = np.zeros(len(surfaces.area), dtype=np.bool_)
    if options.bare_share > 0.0:
        is_bare = rng.uniform(size=len(is_bare)) < options.bare_share
    return _joined(_paintings(surfaces, is_bare, texel_m, rng), is_bare, texel_m)


def repainted(
    textures: Textures, surfaces: Surfaces, share: float, rng: np.random.Generator
) -> Textures:
    """Return textures of which squares of half a metre are replaced: `share` of them, at random."""
    others = _paintings(surfaces, textures.is_bare, textures.texel_m, rng)
    side = max(1, round(_PATCH_M / textures.texel_m))
    images = []
    for row, other in enumerate(others):
        height, width = other.shape
        begin = textures.offset[row, 0]
        image = textures.pixels[begin : begin + other.size].reshape(height, width)
        squares = rng.uniform(size=(-(-height // side), -(-width // side))) < share
        is_new = squares.repeat(side, axis=0)[:height].repeat(side, axis=1)[:, :width]
        images.append(np.where(is_new, other, image))
    return _joined(images, textures.is_bare, textures.texel_m)


def _paintings(
    surfaces: Surfaces, is_bare: Mask, texel_m: float, rng: np.random.Generator
) -> Iterator[U8]:
    """Paint one surface after the other."""
    sizes_m = (np.linalg.norm(side, axis=1) for side in (surfaces.side_u, surfaces.side_v))
    for u_m, v_m, bare in zip(*sizes_m, is_bare, strict=True):
        density = _BARE_SHAPES_PER_M2 if bare else _SHAPES_PER_M2
        yield _painted(float(u_m), float(v_m), texel_m, density, rng)


def _joined(images: Iterable[U8], is_bare: Mask, texel_m: float) -> Textures:
    """Return the finest images (v, u) of the surfaces with their pyramids as textures."""
    pixels, offset = [], 0
    starts = np.zeros((len(is_bare), LEVELS), dtype=np.int64)
    widths, heights = np.zeros_like(starts), np.zeros_like(starts)
    for row, finest in enumerate(images):
        for level, image in enumerate(_pyramid(finest)):
            starts[row, level] = offset
            heights[row, level], widths[row, level] = image.shape
            offset += image.size
            pixels.append(image.ravel())
    return Textures(np.concatenate(pixels), starts, widths, heights, texel_m, is_bare)


def _painted(
    u_m: float, v_m: float, texel_m: float, shapes_per_m2: float, rng: np.random.Generator
) -> U8:
    """Return a grey image of a surface (v, u)."""
    import cv2

    width, height = (max(1, round(side / texel_m)) for side in (u_m, v_m))
    image = np.full((height, width), int(rng.integers(90, 170)), dtype=np.uint8)
    count = int(shapes_per_m2 * u_m * v_m)
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
