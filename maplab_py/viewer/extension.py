"""Layers that plugins add to the viewer: a function from a map to points or lines in G.

Example, the landmarks above a height::

    @viewer_layer("ceiling", title="Ceiling")
    def ceiling(vi_map):
        high = vi_map.p_G[vi_map.p_G[:, 2] > 2.2]
        return LayerPoints(high, colours=(200, 120, 0))

Every drawing of a map then has a checkbox for it; it is rebuilt whenever the map changes.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from maplab_py.array_types import F64, I64, U8
from maplab_py.errors import MaplabError
from maplab_py.vimap import VIMap

if TYPE_CHECKING:
    from maplab_py.viewer.drawing import Drawing
    from maplab_py.viewer.scene import Layer, Part

Colours = U8 | tuple[int, int, int]

_ORANGE = (230, 120, 20)

logger = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True, eq=False)
class LayerPoints:
    """N points to draw."""

    p_G: F64  # (N, 3) [m]
    colours: Colours = _ORANGE  # red, green and blue, 0 to 255: (N, 3), or one for all
    missions: I64 | None = None  # (N,) rows of missions that they are hidden with; None = none
    size_m: float | None = None  # None = as suits the size of the map


@dataclasses.dataclass(frozen=True, eq=False)
class LayerLines:
    """N straight lines to draw."""

    ends_G: F64  # (N, 2, 3) [m]
    colours: Colours = _ORANGE  # red, green and blue, 0 to 255: (N, 3), or one for all
    missions: I64 | None = None  # (N,) rows of missions that they are hidden with; None = none
    width_px: float = 2.0


LayerShapes = LayerPoints | LayerLines
LayerFunction = Callable[[VIMap], LayerShapes]


@dataclasses.dataclass(frozen=True)
class ViewerLayer:
    """A layer of a plugin."""

    name: str
    title: str
    function: LayerFunction
    is_visible: bool = True


REGISTERED: dict[str, ViewerLayer] = {}
"""The layers of all plugins that were imported."""


def viewer_layer(
    name: str, *, title: str = "", is_visible: bool = True
) -> Callable[[LayerFunction], LayerFunction]:
    """Make a layer of the viewer of a function; a decorator, the function stays as it is.

    The function gets the map and returns `LayerPoints` or `LayerLines`, empty ones where the map
    has nothing to draw. It runs in the viewer's thread, for every value of the map that is shown.

    Args:
        name: A short unique name: letters, digits and underscores.
        title: Words beside the checkbox; empty = the name.
        is_visible: It is drawn at first; else it waits for its checkbox.

    Raises:
        ValueError: The name has other characters, as those of the viewer's tree of objects.
    """
    if not name.isidentifier():
        raise ValueError(f"viewer layer '{name}': letters, digits and underscores are expected")

    def decorate(function: LayerFunction) -> LayerFunction:
        REGISTERED[name] = ViewerLayer(name, title or name, function, is_visible)
        return function

    return decorate


def plugin_layers(drawing: Drawing, taken: set[str]) -> tuple[list[Layer], list[str]]:
    """Return the layers of all plugins, and a line for each that cannot be drawn.

    Args:
        taken: Names of layers that are there already.
    """
    layers, problems = [], []
    for definition in REGISTERED.values():
        if definition.name in taken:
            problems.append(f"layer {definition.name}: the viewer has one of this name")
            continue
        try:
            layers.append(_build(definition, drawing))
        except MaplabError as error:
            problems.append(f"layer {definition.name}: {error}")
        except Exception as error:
            logger.exception("layer %s cannot be drawn", definition.name)
            problems.append(f"layer {definition.name}: {type(error).__name__}: {error}")
    return layers, problems


def _build(definition: ViewerLayer, drawing: Drawing) -> Layer:
    """Return what a plugin wants drawn, moved to where its missions are drawn."""
    from maplab_py.viewer.scene import WHOLE_MAP, Layer

    shapes = definition.function(drawing.vi_map)
    p_G, colour = _check(shapes)
    count = len(p_G)
    groups: list[tuple[str, I64]] = [(WHOLE_MAP, np.arange(count))]
    p = p_G - drawing.origin_G
    if shapes.missions is not None:
        mission = np.asarray(shapes.missions, dtype=np.int64).reshape(-1)
        _check_rows(mission, count, len(drawing.mission_ids))
        p = p_G + drawing.shift[mission].reshape(count, *[1] * (p_G.ndim - 2), 3)
        groups = drawing.by_mission(mission)
    parts: dict[str, Part] = {
        key: _part(shapes, drawing, p[rows], colour[rows], rows) for key, rows in groups
    }
    name, title = definition.name, definition.title
    return Layer(name, title, parts, count, is_visible=definition.is_visible)


def _check(shapes: LayerShapes) -> tuple[F64, U8]:
    """Return positions (N, 3) or (N, 2, 3) and colours (N, 3) of the right shapes."""
    wanted: tuple[int, ...]
    if isinstance(shapes, LayerPoints):
        p_G, wanted = np.asarray(shapes.p_G, dtype=np.float64), (3,)
    elif isinstance(shapes, LayerLines):
        p_G, wanted = np.asarray(shapes.ends_G, dtype=np.float64), (2, 3)
    else:
        raise MaplabError(f"gave {type(shapes).__name__}, not LayerPoints or LayerLines")
    if p_G.shape[1:] != wanted:
        raise MaplabError(f"positions are {p_G.shape}, not (N, {', '.join(map(str, wanted))})")
    colour = np.asarray(shapes.colours)
    if colour.shape not in ((3,), (len(p_G), 3)):
        raise MaplabError(f"colours are {colour.shape}, not (3,) or ({len(p_G)}, 3)")
    return p_G, np.broadcast_to(colour.astype(np.uint8), (len(p_G), 3))


def _check_rows(mission: I64, count: int, missions: int) -> None:
    if len(mission) != count or (count and not 0 <= mission.min() <= mission.max() < missions):
        raise MaplabError(
            f"missions must be {count} numbers below {missions}, one for each point or line"
        )


def _part(shapes: LayerShapes, drawing: Drawing, p: F64, colour: U8, rows: I64) -> Part:
    from maplab_py.viewer.drawing import make_points, make_segments

    if isinstance(shapes, LayerLines):
        return make_segments(p[:, 0], p[:, 1], colour, rows, shapes.width_px)
    size_m = 0.006 * drawing.unit_m if shapes.size_m is None else shapes.size_m
    return make_points(p, colour, rows, size_m)
