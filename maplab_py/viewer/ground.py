"""The ground below a map: its grid, labelled axes and a scale bar."""

import dataclasses

import numpy as np

from maplab_py.array_types import F64
from maplab_py.viewer import colours, drawing, scene

_SECTION_CELLS = 5
_STEP_CELLS = (1, 2, 5, 10, 20, 50)
_MAX_INTERVALS = 7
_CORNER = 0.3
"""Coordinates along x and y that are closer than this part of their distance share a label."""
_FLAT = 0.085
"""Height of a map, as a part of its longer side, below which the label at its top would lie on others."""
_BAR_COLOUR = colours.from_hex("#6b7280")[0]


@dataclasses.dataclass(frozen=True, eq=False)
class Ground:
    """Contents of the ground plane; positions are relative to the scene's origin, numbers are those of G."""

    cell_m: float
    section_m: float
    position: F64  # (3,) of a crossing of thick grid lines
    reach_m: float  # distance at which the grid has faded
    axes: scene.Segments  # x, y and z along the edges of the map
    bar: scene.Segments  # the scale bar
    labels: tuple[str, ...]
    p_labels: F64  # (N, 3)


def make_ground(extent: scene.Extent, origin_G: F64) -> Ground:
    """Return the ground of a map; grid lines are at round coordinates of G.

    Args:
        extent: Where the map is, relative to the scene's origin.
        origin_G: The scene's origin (3,).
    """
    cell = cell_size_m(extent.radius_m)
    section = _SECTION_CELLS * cell
    low, high = _corners(extent, origin_G, cell)
    centre = np.round((extent.centre + origin_G) / section) * section - origin_G
    position = np.array([centre[0], centre[1], extent.floor_m])
    step = _label_step_m(float((high - low)[:2].max()), cell)
    labels, p_labels = _axis_labels(low, high, origin_G, step)
    aside = np.array([0.0, -2.0 * cell, 0.0])
    start, end = low + aside, low + aside + np.array([step, 0.0, 0.0])
    bar = drawing.make_segments(start[None], end[None], _BAR_COLOUR, np.array([0]), 5.0)
    labels.append(f"{step:g} m")
    p_labels.append(0.5 * (start + end))
    return Ground(
        cell, section, position, 7.0 * extent.radius_m, _axes(low, high), bar, tuple(labels),
        np.array(p_labels),
    )  # fmt: skip


def cell_size_m(radius_m: float) -> float:
    """Return the width of the grid's squares, 2 or 5 times a power of ten metres."""
    decade = float(10.0 ** np.floor(np.log10(max(radius_m, 0.1))))
    return decade / 5.0 if radius_m < 2.5 * decade else decade / 2.0


def _corners(extent: scene.Extent, origin_G: F64, cell: float) -> tuple[F64, F64]:
    """Return the lower and the upper corner of the map, on grid lines in x and y."""
    points = np.concatenate([extent.outline, extent.centre[None]])
    low, high = points.min(axis=0), points.max(axis=0)
    low[:2] = np.floor((low + origin_G)[:2] / cell) * cell - origin_G[:2]
    high[:2] = np.ceil((high + origin_G)[:2] / cell) * cell - origin_G[:2]
    low[2] = extent.floor_m
    return low, np.maximum(high, low + np.array([cell, cell, 0.0]))


def _label_step_m(span_m: float, cell: float) -> float:
    """Return the distance of labels along the longer side: a few, on grid lines."""
    fitting = [cell * n for n in _STEP_CELLS if span_m <= _MAX_INTERVALS * cell * n]
    return fitting[0] if fitting else cell * _STEP_CELLS[-1]


def _axis_labels(low: F64, high: F64, origin_G: F64, step: float) -> tuple[list[str], list[F64]]:
    """Return the coordinates along x and y, and the height of the map's top."""
    labels: list[str] = []
    places: list[F64] = []
    for axis, name in enumerate("xy"):
        first = np.ceil((low[axis] + origin_G[axis]) / step - 1e-6)
        last = np.floor((high[axis] + origin_G[axis]) / step + 1e-6)
        for value in (step * np.arange(first, last + 1.0)).tolist():
            place = low.copy()
            place[axis] = value - origin_G[axis]
            label = f"{name} {value + 0.0:g}"  # no "-0"
            if places and np.linalg.norm(places[0] - place) < _CORNER * step and name == "y":
                labels[0] += f", {label}"
                continue
            labels.append(label)
            places.append(place)
    if high[2] - low[2] > _FLAT * (high - low)[:2].max():
        labels.append(f"z {high[2] + origin_G[2]:.1f}")
        places.append(np.array([low[0], low[1], high[2]]))
    return labels, places


def _axes(low: F64, high: F64) -> scene.Segments:
    """Return lines along x, y and z from the lower corner to the end of the map."""
    start = np.repeat(low[None], 3, axis=0)
    end = start + np.diag(high - low)
    return drawing.make_segments(start, end, colours.AXES, np.arange(3), 2.0)
