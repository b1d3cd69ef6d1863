"""Regions that changed between sessions, and the images before and after side by side."""

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np

from maplab_py.algorithms.dense.grid import Mesh
from maplab_py.algorithms.map_update.options import Change
from maplab_py.array_types import U8, U64
from maplab_py.viewer import colours
from maplab_py.viewer.drawing import Drawing, ImageOf, make_points, make_segments
from maplab_py.viewer.layers.clouds import Cloud
from maplab_py.viewer.scene import WHOLE_MAP, Entity, Layer
from maplab_py.vimap import VIMap, from_hex

_COLOURS = {"vanished": "#d2455a", "appeared": "#3fa372", "moved": "#e09b2d"}
_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 0.5
_EDGES = np.array(
    [[a, b] for a in range(8) for b in range(a) if np.abs(_CORNERS[a] - _CORNERS[b]).sum() == 1.0]
)
_GAP_PX = 6
_CAPTION = 12
"""Width of an image in heights of the line above it: the panel shows both images small."""


def change_layers(drawing: Drawing, changes: Sequence[Change]) -> list[Layer]:
    """Return a layer of boxes round the regions, with lines to where they moved, and one of names on them.

    A click on a name selects the vertex that saw the region best before the change.
    """
    ends, colour, rows = [], [], []
    for number, change in enumerate(changes):
        centre = np.array([change.x_m, change.y_m, change.z_m])
        lines = list((centre + change.size_m * _CORNERS)[_EDGES])
        if change.to_m:
            lines.append(np.array([centre, [float(word) for word in change.to_m.split()]]))
        ends += lines
        colour += [colours.from_hex(_COLOURS[change.change])[0]] * len(lines)
        rows += [number] * len(lines)
    if not ends:
        return []
    p = np.array(ends) - drawing.origin_G
    boxes = make_segments(p[:, 0], p[:, 1], np.array(colour), np.array(rows), 3.0)
    before = drawing.vi_map.vertex_index.rows(_ids([c.view_before for c in changes]))
    named = np.flatnonzero(before >= 0)
    tops = np.array([[c.x_m, c.y_m, c.z_m + 0.5 * c.size_m] for c in changes]) - drawing.origin_G
    tints = np.concatenate([colours.from_hex(_COLOURS[c.change]) for c in changes])
    dots = make_points(tops[named], tints[named], before[named], 0.012 * drawing.unit_m)
    labels = [f"{changes[row].change} by {changes[row].until}" for row in named.tolist()]
    names = {WHOLE_MAP: dataclasses.replace(dots, labels=tuple(labels))}
    return [
        Layer("changes", "Changes", {WHOLE_MAP: boxes}, len(changes)),
        Layer("change_names", "Dates of changes", names, len(named), Entity.VERTEX),
    ]


def mesh_clouds(meshes: Sequence[Mesh]) -> tuple[Cloud, ...]:
    """Return the surfaces that appeared and vanished as meshes to draw; those that are empty are left out."""
    names = ("appeared", "vanished")[: len(meshes)]
    return tuple(
        Cloud(
            f"Surfaces that {name}", mesh.p, np.tile(colours.from_hex(_COLOURS[name]), (len(mesh.p), 1)),
            faces=mesh.faces,
        )
        for name, mesh in zip(names, meshes, strict=True)
        if len(mesh.faces)
    )  # fmt: skip


class ChangeImages:
    """Images of the vertices of a map; where a change is seen best that of the new session beside it."""

    def __init__(
        self, before: tuple[VIMap, ImageOf], after: tuple[VIMap, ImageOf], changes: Sequence[Change]
    ) -> None:
        self._image_of = (before[1], after[1])
        rows = before[0].vertex_index.rows(_ids([c.view_before for c in changes]))
        partners = after[0].vertex_index.rows(_ids([c.view_after for c in changes]))
        self._after = dict(zip(rows.tolist(), partners.tolist(), strict=True))

    def __call__(self, vertex: int) -> U8 | None:
        """Return the picture of a vertex (row) of the map, or both pictures of a change."""
        if self._after.get(vertex, -1) < 0:
            return self._image_of[0](vertex)
        images = self._image_of[0](vertex), self._image_of[1](self._after[vertex])
        named = zip(images, ("before", "after"), strict=True)
        shown = [_captioned(image, name) for image, name in named if image is not None]
        if not shown:
            return None
        height = max(len(image) for image in shown)
        parts = []
        for image in shown:
            part = np.full((height, image.shape[1] + _GAP_PX, 3), 255, dtype=np.uint8)
            part[: len(image), : image.shape[1]] = image
            parts.append(part)
        return np.concatenate(parts, axis=1)


def _captioned(image: U8, caption: str) -> U8:
    """Return an image under a line of text."""
    height = max(image.shape[1] // _CAPTION, 2)
    line = np.full((height, image.shape[1], 3), 255, dtype=np.uint8)
    place, width = (0, height - height // 4), max(height // 12, 1)
    font = cv2.FONT_HERSHEY_SIMPLEX
    cv2.putText(line, caption, place, font, height / 32, (0, 0, 0), width, cv2.LINE_AA)
    return np.concatenate([line, image])


def _ids(words: Sequence[str]) -> U64:
    return np.array([from_hex(word) for word in words], dtype=np.uint64).reshape(-1, 2)
