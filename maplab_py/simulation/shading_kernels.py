"""Compiled shading: what grey value is painted where a ray meets a surface.

Pixels side by side mostly see the same surface at the same level of its pyramid: shading handles
such runs, in which corner, axes and texture are constants. Each step is a loop that becomes SIMD
instructions; intermediate values lie in one scratch array at constant offsets, so that the compiler
sees that they do not overlap.

Source: the choice of the pyramid level is that of Williams (1983).
"""

from typing import NamedTuple

import numpy as np

from maplab_py.array_types import F32, I32
from maplab_py.compilation import compiled

LEVELS = 5
"""Resolutions of a texture; each level halves that of the one before."""
TILE = 128
"""Pixels of a row that are cast together: their scratch fits into the first-level cache."""
DX, DY, DZ, IX, IY, IZ, DISTANCE, _U, _V, _SHARE, X, _Y, _FINE_X, _FINE_Y = range(
    0, 14 * TILE, TILE
)
"""Offsets in the scratch of real numbers: ray and its inverse, distance, place on the surface [m],
share of the coarser level, fractions of texels."""
SURFACE, _LEVEL, _INDEX, _FINE_TEXELS, _TEXELS = range(0, 5 * TILE, TILE)
"""Offsets in the scratch of whole numbers."""
ZERO, HALF, UNITY, _TWO = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(2.0)
_LEAST_SLANT = np.float32(0.05)
"""Cosine below which a surface that is seen at a grazing angle is not filtered any more."""
_LARGEST_RATIO = np.float32(2.0 ** (LEVELS - 1.001))
_LOG2 = (
    np.polynomial.Chebyshev.interpolate(np.log2, 6, domain=[1.0, 2.0])
    .convert(kind=np.polynomial.Polynomial)
    .coef.astype(np.float32)
)
_L0, _L1, _L2, _L3, _L4, _L5, _L6 = _LOG2
"""Coefficients of log2 on [1, 2]; the error is below 1e-5."""
FAST = {"fastmath": {"contract", "nsz", "arcp"}}


class PaintedBoxes(NamedTuple):
    """Boxes and what is painted on their sides; box 0 is the space that is seen from inside."""

    boxes: F32  # (B, 2, 3)
    corner: F32  # (6 B, 3) of the sides
    texels: I32  # (N,) each with its neighbours to the right, below, and both, in one word
    layout: I32  # (6 B, LEVELS, 3) first texel, width, height
    texel_m: np.float32  # of the finest level


@compiled()
def pack_texels(pixels, layout, texels):  # type: ignore[no-untyped-def]
    """Put the 2 x 2 neighbourhood of each pixel, repeated at the border, into one word.

    A bilinear value then needs one read in place of four.
    """
    for surface in range(len(layout)):
        for level in range(LEVELS):
            first, width, height = layout[surface, level]
            for row in range(height):
                below = width if row + 1 < height else 0
                for column in range(width):
                    here = first + row * width + column
                    right = 1 if column + 1 < width else 0
                    texels[here] = np.int32(
                        np.uint32(pixels[here])
                        | np.uint32(pixels[here + right]) << 8
                        | np.uint32(pixels[here + below]) << 16
                        | np.uint32(pixels[here + below + right]) << 24
                    )


@compiled(**FAST)
def shade(scene, focal_px, eye, count, real, whole):  # type: ignore[no-untyped-def]
    """Fill in the grey values (in place of the texel fractions) run by run."""
    per_texel = UNITY / (focal_px * scene.texel_m)
    begin = 0
    while begin < count:
        surface = whole[SURFACE + begin]
        end = _end_of_run(whole[SURFACE:], begin, count)
        # slices: numba cannot see that begin + j is an index that needs no wrapping
        _locate(
            scene.corner[surface], surface, per_texel, eye, end - begin, real[begin:], whole[begin:]
        )
        while begin < end:
            level = whole[_LEVEL + begin]
            until = _end_of_run(whole[_LEVEL:], begin, end)
            layout = scene.layout[surface, level : level + 2]
            scale = UNITY / (scene.texel_m * np.float32(1 << level))
            _read(scene.texels, layout, scale, until - begin, real[begin:], whole[begin:])
            begin = until
    for j in range(count):
        fine = _bilinear(whole[_FINE_TEXELS + j], real[_FINE_X + j], real[_FINE_Y + j])
        coarse = _bilinear(whole[_TEXELS + j], real[X + j], real[_Y + j])
        real[X + j] = fine + real[_SHARE + j] * (coarse - fine)


@compiled()
def _end_of_run(values, begin, end):  # type: ignore[no-untyped-def]
    """Return where the run of equal values that starts at `begin` ends."""
    until = begin + 1
    while until < end and values[until] == values[begin]:
        until += 1
    return until


@compiled(**FAST)
def _locate(corner, surface, per_texel, eye, count, real, whole):  # type: ignore[no-untyped-def]
    """Fill in places on a surface [m], the level of its pyramid, and the share of the next level."""
    axis = surface % 6 // 2
    u, v = (axis + 1) % 3, (axis + 2) % 3
    from_u, from_v = eye[u] - corner[u], eye[v] - corner[v]
    for j in range(count):
        distance = real[DISTANCE + j]
        dx, dy, dz = real[DX + j], real[DY + j], real[DZ + j]
        du = dy if axis == 0 else (dz if axis == 1 else dx)
        dv = dz if axis == 0 else (dx if axis == 1 else dy)
        normal = abs(dx if axis == 0 else (dy if axis == 1 else dz))
        real[_U + j], real[_V + j] = from_u + distance * du, from_v + distance * dv
        square = dx * dx + dy * dy + dz * dz
        slant = normal / np.sqrt(square)
        slant = _LEAST_SLANT if slant < _LEAST_SLANT else slant
        # texels that a pixel covers, between 1 and the size of the coarsest texel
        ratio = distance * per_texel * np.sqrt(square / slant)
        ratio = UNITY if ratio < UNITY else ratio
        real[_SHARE + j] = _LARGEST_RATIO if ratio > _LARGEST_RATIO else ratio
    for j in range(count):
        ratio, level = real[_SHARE + j], np.int32(0)
        for _ in range(LEVELS - 2):
            halve = ratio >= _TWO
            ratio = HALF * ratio if halve else ratio
            level = np.int32(level + 1) if halve else level
        whole[_LEVEL + j] = level
        share = _L4 + ratio * (_L5 + ratio * _L6)
        real[_SHARE + j] = _L0 + ratio * (_L1 + ratio * (_L2 + ratio * (_L3 + ratio * share)))


@compiled(**FAST)
def _read(texels, layout, scale, count, real, whole):  # type: ignore[no-untyped-def]
    """Fill in the texels at places on two levels of a pyramid, and the fractions between them."""
    _place(layout[0], scale, count, real, whole)
    for j in range(count):
        whole[_FINE_TEXELS + j] = texels[np.uint32(whole[_INDEX + j])]
        real[_FINE_X + j], real[_FINE_Y + j] = real[X + j], real[_Y + j]
    _place(layout[1], HALF * scale, count, real, whole)
    for j in range(count):
        whole[_TEXELS + j] = texels[np.uint32(whole[_INDEX + j])]


@compiled(**FAST)
def _place(layout, scale, count, real, whole):  # type: ignore[no-untyped-def]
    """Fill in the index of the texels at places on one level, and the fractions between them."""
    first, width = layout[0], layout[1]
    right, bottom = np.float32(width - 1), np.float32(layout[2] - 1)
    for j in range(count):
        x, y = real[_U + j] * scale - HALF, real[_V + j] * scale - HALF
        # this way round what is no number becomes zero, too
        x, y = (x if x > ZERO else ZERO), (y if y > ZERO else ZERO)
        x, y = (right if x > right else x), (bottom if y > bottom else y)
        column, row = np.int32(x), np.int32(y)
        real[X + j], real[_Y + j] = x - np.float32(column), y - np.float32(row)
        whole[_INDEX + j] = np.int32(first + row * width + column)


@compiled(forceinline=True, **FAST)
def _bilinear(texel, x, y):  # type: ignore[no-untyped-def]
    """Return the grey value between the four pixels of a packed texel."""
    left, right = np.float32(np.int32(texel & 255)), np.float32(np.int32((texel >> 8) & 255))
    upper = left + x * (right - left)
    left, right = (
        np.float32(np.int32((texel >> 16) & 255)),
        np.float32(np.int32((texel >> 24) & 255)),
    )
    lower = left + x * (right - left)
    return upper + y * (lower - upper)
