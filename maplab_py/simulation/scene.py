"""The scene that is rendered: the boxes of a world with painted sides."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator
from typing import Self

import numpy as np

from maplab_py.array_types import F32, F64, I64, U8, Mask, NDArray
from maplab_py.simulation.detection import Detections
from maplab_py.simulation.scenario import AppearanceOptions, ImageOptions
from maplab_py.simulation.shading_kernels import LEVELS
from maplab_py.simulation.surfaces import Surfaces, box_surfaces

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
    surfaces = Surfaces.concatenate(sides)
    return Scene(every, surfaces, make_textures(surfaces, options, rng))


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
    return _join(_paintings(surfaces, is_bare, texel_m, rng), is_bare, texel_m)


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
    return _join(images, textures.is_bare, textures.texel_m)


def _paintings(
    surfaces: Surfaces, is_bare: Mask, texel_m: float, rng: np.random.Generator
) -> Iterator[U8]:
    """Paint one surface after the other."""
    sizes_m = (np.linalg.norm(side, axis=1) for side in (surfaces.side_u, surfaces.side_v))
    for u_m, v_m, bare in zip(*sizes_m, is_bare, strict=True):
        density = _BARE_SHAPES_PER_M2 if bare else _SHAPES_PER_M2
        yield _paint(float(u_m), float(v_m), texel_m, density, rng)


def _join(images: Iterable[U8], is_bare: Mask, texel_m: float) -> Textures:
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


def _paint(
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


# Model of binary descriptors: signs of correlated activations that vary with view and session.
#
# A point has a latent vector z, which varies with view direction, distance and session. Bit i is the
# sign of w_i . z + noise. Bits with an activation near zero therefore flip first, near views have
# similar descriptors, and bits that compare similar image regions flip together, as in BRISK or FREAK.
# Some observations are much noisier than others (blur, borders, a shifted keypoint). With the
# defaults, distances of equal and of different points match maps that maplab recorded with BRISK:
# medians of 51 and 178 bits out of 384.

_REFERENCE_DISTANCE_M = 3.0
_DETECTIONS_AT_ONCE = 1 << 14
"""Number of descriptors per batch; bounds the memory to about 100 MB."""


@dataclasses.dataclass(frozen=True, eq=False)
class Appearance:
    """Appearance of all points of a world. Activations have unit variance over points."""

    options: AppearanceOptions
    weights: F32  # (latent, bits)
    threshold: F32  # (bits,) of the activations: some bits are mostly set, others mostly clear
    look: I64  # (L,) row of the following for every point of the world
    latent: F32  # (K, latent)
    gradient: F32  # (K, 4, latent) by view direction (3) and doubling of the distance


@dataclasses.dataclass(frozen=True, eq=False)
class SessionAppearance:
    """Appearance and presence of points in a session."""

    world: Appearance
    change: F32  # (K, latent)
    is_there: NDArray[np.bool_]  # (L,)


def make_appearance(options: AppearanceOptions, look: I64, rng: np.random.Generator) -> Appearance:
    """Draw the appearance of the points; points of equal `look` (L,) have the same appearance."""
    points = int(look.max(initial=-1)) + 1
    bits, size = 8 * options.descriptor_bytes, options.latent_dimensions
    weights = rng.standard_normal((size, bits), dtype=np.float32)
    weights /= np.linalg.norm(weights, axis=0)
    threshold = options.bit_bias * rng.standard_normal(bits, dtype=np.float32)
    latent = rng.standard_normal((points, size), dtype=np.float32)
    gradient = rng.standard_normal((points, 4, size), dtype=np.float32)
    gradient[:, :3] *= options.viewpoint_change
    gradient[:, 3] *= options.scale_change
    return Appearance(options, weights, threshold, look, latent, gradient)


def make_session_appearance(world: Appearance, rng: np.random.Generator) -> SessionAppearance:
    """Draw the changed appearance and the missing points of a session."""
    change = rng.standard_normal(world.latent.shape, dtype=np.float32)
    change *= world.options.session_change
    is_there = rng.uniform(size=len(world.look)) >= world.options.vanish_share
    return SessionAppearance(world, change, is_there)


def describe(
    session: SessionAppearance, detections: Detections, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Return the descriptors (N, bytes) of detections."""
    size = session.world.options.descriptor_bytes
    descriptors = np.empty((len(detections.frame), size), dtype=np.uint8)
    for first in range(0, len(detections.frame), _DETECTIONS_AT_ONCE):
        rows = slice(first, first + _DETECTIONS_AT_ONCE)
        descriptors[rows] = _describe(session, detections, rows, rng)
    return descriptors


def _describe(
    session: SessionAppearance, detections: Detections, rows: slice, rng: np.random.Generator
) -> NDArray[np.uint8]:
    world = session.world
    point = detections.point[rows]
    view = np.concatenate(
        [
            detections.view_G[rows],
            np.log2(detections.distance_m[rows, None] / _REFERENCE_DISTANCE_M),
        ],
        axis=1,
    ).astype(np.float32)
    # clutter has point -1: its latent vector is drawn separately
    latent = rng.standard_normal((len(point), world.latent.shape[1]), dtype=np.float32)
    of_point = point >= 0
    known = world.look[point[of_point]]
    latent[of_point] = world.latent[known] + session.change[known]
    latent[of_point] += np.einsum("nk,nkj->nj", view[of_point], world.gradient[known])
    activation = latent @ world.weights
    noise = rng.standard_normal(activation.shape, dtype=np.float32)
    spread = rng.standard_normal((len(point), 1), dtype=np.float32)
    noise *= world.options.bit_noise * np.exp(world.options.bit_noise_spread * spread)
    return np.packbits(activation + noise > world.threshold, axis=1)
