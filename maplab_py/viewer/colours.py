"""Colours for dark and light backgrounds: (..., 3) of uint8."""

import colorsys

import numpy as np
from numpy.typing import ArrayLike

from maplab_py.array_types import F64, U8


def from_hex(*codes: str) -> U8:
    """Return colours (N, 3) of codes such as "#4c8dd6"."""
    return np.array([list(bytes.fromhex(code[1:])) for code in codes], dtype=np.uint8)


def to_hex(colour: ArrayLike) -> str:
    """Return the code of one colour (3,)."""
    return "#" + bytes(np.asarray(colour, dtype=np.uint8).tolist()).hex()


MISSIONS = from_hex(
    "#4c8dd6", "#e2813a", "#3fa372", "#b665c4", "#d2576b", "#2fa9b3", "#a98b2d", "#7a79e0",
    "#8d9b3c", "#c9709b",
)  # fmt: skip
"""One each for the first missions; no two neighbours are alike to a colour-blind eye."""

SEQUENTIAL = from_hex("#3f4fa3", "#2f7fb8", "#2fa58f", "#7dbf57", "#e3c544")
"""Little to much."""

HEAT = from_hex("#6a7fb5", "#b0739c", "#e0705a", "#f0b23c")
"""Harmless to alarming."""

TRUST = from_hex("#d2455a", "#dba23c", "#3fa372")
"""Not trusted (0) to trusted (1)."""

QUALITY = from_hex("#8a93a0", "#d2455a", "#3fa372")
"""By `LandmarkQuality`: unknown, bad, good."""

REFERENCE = from_hex("#8a93a0")[0]
HIDDEN = from_hex("#c3c8d0")[0]
TRUTH = from_hex("#c9a227")[0]
MATCHED = from_hex("#e0559a")[0]
PICKED = from_hex("#ffb000")[0]
SECOND_PICK = from_hex("#ff5d8f")[0]
AXES = from_hex("#d2455a", "#3fa372", "#4c8dd6")


def mission_colours(count: int, salt: int = 1) -> U8:
    """Return one colour (count, 3) per mission; beyond the palette by steps of the golden angle."""
    rows = np.arange(count) + (salt - 1)
    colours = MISSIONS[rows % len(MISSIONS)].copy()
    for place in np.flatnonzero(rows >= len(MISSIONS)).tolist():
        hue = (0.6180339887498949 * rows[place]) % 1.0
        rgb = colorsys.hls_to_rgb(hue, 0.55, 0.5)
        colours[place] = np.round(255.0 * np.array(rgb)).astype(np.uint8)
    return colours


def ramp(values: ArrayLike, stops: U8) -> U8:
    """Return colours (..., 3) of values (...,) in [0, 1] on a ramp of equidistant stops (n, 3).

    Values outside are clipped; NaN has the first colour.
    """
    x = np.clip(np.nan_to_num(np.asarray(values, dtype=np.float64), nan=0.0), 0.0, 1.0)
    place = x * (len(stops) - 1)
    low = np.minimum(place.astype(np.int64), len(stops) - 2)
    part = (place - low)[..., None]
    mixed = (1.0 - part) * stops[low] + part * stops[low + 1]
    return np.asarray(np.round(mixed), dtype=np.uint8)


def mixed(first: ArrayLike, second: ArrayLike, part: float) -> U8:
    """Return `part` of the second and the rest of the first colour."""
    a, b = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    return np.asarray(np.round((1.0 - part) * a + part * b), dtype=np.uint8)


def normalised(values: F64, period: float = 0.0, offset: float = 0.0) -> tuple[F64, float, float]:
    """Return values (N,) as parts of their usual range, and that range.

    The range leaves out the outermost hundredth on both sides, so that a few outliers do not
    flatten the picture. With a period values repeat from the offset on.
    """
    if period > 0.0:
        return np.mod(values - offset, period) / period, offset, offset + period
    finite = values[np.isfinite(values)]
    if not len(finite):
        return np.zeros_like(values), 0.0, 0.0
    low, high = (float(x) for x in np.percentile(finite, [1.0, 99.0]))
    return (values - low) / max(high - low, 1e-12), low, high


def hex_codes(colours: U8) -> tuple[str, ...]:
    """Return the codes of colours (N, 3)."""
    return tuple(to_hex(colour) for colour in colours)


def linear_light(colours: U8) -> F64:
    """Return the linear light (..., 3), 0 to 1, of colours in sRGB (IEC 61966-2-1)."""
    s = colours / 255.0
    return np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)
