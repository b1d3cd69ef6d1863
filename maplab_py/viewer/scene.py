"""A scene: what is drawn, as plain arrays. Nothing here knows of browsers.

Positions are float32 and relative to the scene's origin, which lies in the middle of the map when
the map is far from the origin of G, so that nothing is lost to rounding.
"""

import dataclasses
from collections.abc import Mapping
from enum import Enum
from typing import Self

import numpy as np
from numpy.typing import NDArray

from maplab_py.array_types import F32, F64, I64, U8, Rows
from maplab_py.viewer import colours as palettes

WHOLE_MAP = ""
"""Key of parts that belong to no single mission."""


class Entity(Enum):
    """Meaning of the rows of a part, for picking."""

    NONE = "none"
    VERTEX = "vertex"
    LANDMARK = "landmark"
    LOOP_CLOSURE = "loop closure"  # an edge of the map
    CLOSURE = "closure"  # one that the map remembers


class Points(Rows):
    """A cloud."""

    p: F32  # (N, 3) [m]
    colours: U8  # (N, 3)
    rows: I64  # (N,) rows of the map's table
    size_m: float
    labels: tuple[str, ...] = ()  # one for each of the first points; empty = no label


class Segments(Rows):
    """Straight lines."""

    ends: F32  # (N, 2, 3) [m]
    colours: U8  # (N, 3)
    rows: I64  # (N,) rows of the map's table
    width_px: float = 1.5


class Axes(Rows):
    """Coordinate frames with a name each."""

    T: F64  # (N, 7), relative to the scene's origin
    length_m: float
    labels: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh, in one colour or with a colour at each corner."""

    p: F32  # (N, 3) [m]
    faces: NDArray[np.int32]  # (F, 3)
    colours: U8  # (N, 3), or (3,) of the whole mesh
    opacity: float = 1.0  # of a mesh with a colour at each corner

    def __len__(self) -> int:
        return len(self.faces)


Part = Points | Segments | Axes | Mesh


@dataclasses.dataclass(frozen=True)
class LegendEntry:
    """One line of the legend: a swatch, or a ramp between two labels."""

    text: str
    colours: tuple[str, ...]  # one code = swatch, several = ramp
    low: str = ""
    high: str = ""

    @classmethod
    def ramp(cls, text: str, stops: U8, low: str, high: str) -> Self:
        """Return a ramp of colours (n, 3) between two labels."""
        return cls(text, palettes.hex_codes(stops), low, high)


@dataclasses.dataclass(frozen=True, eq=False)
class Layer:
    """Parts that one checkbox of the panel shows."""

    name: str
    title: str
    parts: Mapping[str, Part]  # by mission id, or `WHOLE_MAP`
    total: int  # in the map; parts may draw fewer
    entity: Entity = Entity.NONE
    is_visible: bool = True
    legend: tuple[LegendEntry, ...] = ()
    notes: tuple[str, ...] = ()  # why parts draw fewer
    choices: tuple[str, ...] = ()  # texts that the panel offers to restrict the layer to

    @property
    def drawn(self) -> int:
        """Number of drawn rows."""
        return sum(len(part) for part in self.parts.values())


@dataclasses.dataclass(frozen=True)
class MissionEntry:
    """One mission in the panel."""

    id: str
    name: str  # else the beginning of the id
    colour: str
    vertices: int
    length_m: float
    duration_s: float
    is_known: bool


@dataclasses.dataclass(frozen=True, eq=False)
class Extent:
    """Bounds of the map without its outliers; relative to the scene's origin."""

    centre: F64  # (3,)
    radius_m: float
    floor_m: float
    outline: F64  # (N, 3) points that a view of everything shows


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """Everything that is drawn of a map."""

    title: str
    layers: tuple[Layer, ...]
    missions: tuple[MissionEntry, ...]
    extent: Extent
    origin_G: F64  # (3,) of the scene, in G
    notes: tuple[str, ...] = ()

    def layer(self, name: str) -> Layer:
        """Return the layer of this name; KeyError when the scene has none."""
        return {layer.name: layer for layer in self.layers}[name]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all layers."""
        return tuple(layer.name for layer in self.layers)


def is_same_part(a: Part | None, b: Part | None) -> bool:
    """Tell whether two parts draw the same."""
    if a is b:
        return True
    if a is None or b is None or type(a) is not type(b):
        return False
    pairs = [(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a)]
    return all(
        np.array_equal(x, y) if isinstance(x, np.ndarray) else bool(x == y) for x, y in pairs
    )
