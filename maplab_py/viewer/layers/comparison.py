"""Another map, or another state of the map, beside the map: one camera looks at both."""

import dataclasses
from typing import Any

import numpy as np

from maplab_py.array_types import F64, U8
from maplab_py.viewer import colours
from maplab_py.viewer.drawing import (
    BAD_QUALITY,
    MAX_POINTS,
    NO_POSITION,
    Drawing,
    make_points,
    make_segments,
    omission_notes,
    spread_rows,
)
from maplab_py.viewer.layers.landmarks import landmarks, point_size
from maplab_py.viewer.layers.paths import trajectories
from maplab_py.viewer.scene import WHOLE_MAP, Layer, Part
from maplab_py.vimap import LandmarkQuality, VIMap, to_hex_list

_GAP = 0.15
"""Between both, as a part of the room that they take across."""


def swiped(drawing: Drawing, other: VIMap) -> list[Layer]:
    """Return paths and landmarks of another map where they are; `page.js` shows them left of a line alone."""
    state = drawing.of_state(other)
    return [
        Layer(
            f"swiped_{layer.name}", f"{layer.title}, left", _joined(layer), layer.total,
            legend=layer.legend, notes=layer.notes,
        )
        for layer in (trajectories(state), landmarks(state)[0])
    ]  # fmt: skip


def _joined(layer: Layer) -> dict[str, Part]:
    """Return the parts of all missions, which the map need not have, as one."""
    parts: list[Any] = list(layer.parts.values())
    return {WHOLE_MAP: type(parts[0]).concatenate(parts)} if parts else {}


def beside(drawing: Drawing, other: VIMap, names: tuple[str, str]) -> list[Layer]:
    """Return the paths and landmarks of another map in the colours of their missions, and names.

    Args:
        names: What the map and the other one are called.
    """
    shift = shift_beside(drawing, other)
    colour = mission_colours_of(drawing, other)
    return [
        reference_paths(other, shift, colour, 3.0),
        reference_landmarks(drawing, other, shift, colour, is_visible=True),
        _names(drawing, other.T_G_I[:, 4:] + shift, names),
    ]


def reference_paths(other: VIMap, shift: F64, colour: U8, width_px: float) -> Layer:
    """Return the paths of the other map; see `reference_landmarks`."""
    p, mission = other.T_G_I[:, 4:] + shift, other.vertices.mission
    start = np.flatnonzero(mission[1:] == mission[:-1])
    each = colour if colour.ndim == 1 else colour[mission[start]]
    lines = {WHOLE_MAP: make_segments(p[start], p[start + 1], each, start, width_px)}
    return Layer("reference_trajectories", "Reference paths", lines, len(other.missions))


def reference_landmarks(
    drawing: Drawing, other: VIMap, shift: F64, colour: U8, *, is_visible: bool
) -> Layer:
    """Return the landmarks of the other map that are not of bad quality.

    Args:
        shift: What takes positions of it (3,) from G to the scene.
        colour: One colour (3,), or one (M, 3) for each mission of the other map.
        is_visible: Show them at first.
    """
    p_L = other.p_G + shift
    is_good = other.landmarks.quality != LandmarkQuality.BAD
    good = np.flatnonzero(np.isfinite(p_L).all(axis=1) & is_good)
    rows = good[spread_rows(p_L[good], drawing.options.max_points)]
    each = colour if colour.ndim == 1 else colour[other.vertices.mission[other.landmarks.vertex]]
    cloud = make_points(
        p_L[rows], each if each.ndim == 1 else each[rows], rows, point_size(drawing)
    )
    title, points = "Reference landmarks", {WHOLE_MAP: cloud}
    bad = int(np.count_nonzero(~is_good))
    losses = (
        (bad, BAD_QUALITY),
        (len(p_L) - bad - len(good), NO_POSITION),
        (len(good) - len(rows), MAX_POINTS),
    )
    notes = omission_notes(title, len(rows), *losses)
    return Layer("reference_landmarks", title, points, len(p_L), is_visible=is_visible, notes=notes)


def shift_beside(drawing: Drawing, other: VIMap) -> F64:
    """Return what takes positions of the other map (3,) from G to beside the map in the scene.

    Both lie along their longer side. A map without a mission of ours is centred on the map first.
    """
    outline = drawing.extent.outline
    p = other.T_G_I[:, 4:] - drawing.origin_G
    p = p[np.isfinite(p).all(axis=1)]
    shift = -drawing.origin_G.astype(np.float64)
    if not len(p):
        return shift
    if not set(to_hex_list(other.missions.id)) & set(drawing.mission_ids):
        centring = drawing.extent.centre - 0.5 * (p.min(axis=0) + p.max(axis=0))
        shift, p = shift + centring, p + centring
    both = np.concatenate([outline, p])
    across = int(np.argmin(np.ptp(both[:, :2], axis=0)))
    gap = max(_GAP * float(np.ptp(outline[:, across])), 0.1 * drawing.extent.radius_m)
    # landmarks around its path need as much room as those around the path of the map
    path = drawing.p_vertices[:, across]
    margin = float(np.nanmin(path) - outline[:, across].min())
    shift[across] += outline[:, across].min() - gap - margin - p[:, across].max()
    return shift


def mission_colours_of(drawing: Drawing, other: VIMap) -> U8:
    """Return a colour (M, 3) for each mission of the other map; that of the map if it has it."""
    known = {mission: row for row, mission in enumerate(drawing.mission_ids)}
    ids = to_hex_list(other.missions.id)
    new = [mission for mission in ids if mission not in known]
    every = colours.mission_colours(len(known) + len(new), drawing.options.color_salt)
    rows = known | {mission: len(known) + number for number, mission in enumerate(new)}
    return every[[rows[mission] for mission in ids]]


def _names(drawing: Drawing, p_other: F64, names: tuple[str, str]) -> Layer:
    """Return both names above the paths."""
    middles = [
        0.5 * (np.nanmin(p, axis=0) + np.nanmax(p, axis=0)) for p in (drawing.p_vertices, p_other)
    ]
    top = np.array([0.0, 0.0, 0.45 * drawing.extent.radius_m])
    size = 0.002 * drawing.unit_m
    dots = make_points(np.array(middles) + top, colours.REFERENCE, np.arange(2), size)
    return Layer("names", "Names", {WHOLE_MAP: dataclasses.replace(dots, labels=names)}, 2)
