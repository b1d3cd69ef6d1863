"""Look-up of the vertex, landmark, loop closure or mission of an id or of its beginning."""

from __future__ import annotations

import numpy as np

from maplab_py.array_types import F64, I64, U64
from maplab_py.errors import UserError
from maplab_py.viewer.drawing import Drawing
from maplab_py.viewer.picking import Pick
from maplab_py.viewer.scene import Entity
from maplab_py.vimap.ids import HEX_DIGITS

MIN_DIGITS = 4
"""Fewer digits of an id mean nothing."""


def find_by_id(drawing: Drawing, text: str) -> Pick:
    """Return the entity whose id starts with some digits, as if it had been clicked.

    A mission is represented by its first vertex.

    Args:
        drawing: The map as it is drawn.
        text: 4 to 32 hexadecimal digits.

    Raises:
        UserError: The text is no beginning of an id, no id starts with it, or several do.
    """
    prefix = text.strip().lower()
    if not MIN_DIGITS <= len(prefix) <= HEX_DIGITS or prefix.strip("0123456789abcdef"):
        raise UserError(
            f"'{text.strip()}': {MIN_DIGITS} to {HEX_DIGITS} hexadecimal digits of an id are expected"
        )
    vi_map = drawing.vi_map
    tables = (
        ("vertex", vi_map.vertices.id, Entity.VERTEX),
        ("landmark", vi_map.landmarks.id, Entity.LANDMARK),
        ("loop closure", vi_map.loop_closure_edges.id, Entity.LOOP_CLOSURE),
        ("mission", vi_map.missions.id, Entity.NONE),
    )
    matches = [
        (name, row, entity)
        for name, ids, entity in tables
        for row in _rows_with_prefix(ids, prefix).tolist()
    ]
    if not matches:
        raise UserError(
            f"no vertex, landmark, loop closure or mission has an id that starts {prefix}"
        )
    if len(matches) > 1:
        kinds = ", ".join(dict.fromkeys(name for name, *_ in matches))
        raise UserError(f"{len(matches)} ids start with {prefix} ({kinds}): give more digits")
    _, row, entity = matches[0]
    if entity is Entity.NONE:
        start, stop = vi_map.vertex_start[row : row + 2].tolist()
        if start == stop:
            raise UserError(f"mission {prefix} has no vertices: there is nothing to show")
        row, entity = start, Entity.VERTEX
    return Pick(entity, row, _position(drawing, entity, row), 0.0)


def _rows_with_prefix(ids: U64, prefix: str) -> I64:
    """Return the rows (K,) of ids (N, 2) whose hexadecimal form starts with some digits."""
    low = prefix.ljust(HEX_DIGITS, "0")
    high = prefix.ljust(HEX_DIGITS, "f")
    words = ids.reshape(-1, 2)
    half = HEX_DIGITS // 2
    keep = np.ones(len(words), dtype=np.bool_)
    for column, digits in enumerate((slice(0, half), slice(half, None))):
        least, most = np.uint64(int(low[digits], 16)), np.uint64(int(high[digits], 16))
        keep &= (words[:, column] >= least) & (words[:, column] <= most)
    return np.flatnonzero(keep)


def _position(drawing: Drawing, entity: Entity, row: int) -> F64:
    """Return where an entity (3,) is drawn.

    Raises:
        UserError: It has no position.
    """
    if entity is Entity.LANDMARK:
        p = drawing.p_landmarks[row]
    elif entity is Entity.VERTEX:
        p = drawing.p_vertices[row]
    else:
        edges = drawing.vi_map.loop_closure_edges
        ends = np.array([edges.from_vertex[row], edges.to_vertex[row]])
        p = drawing.p_vertices[ends].mean(axis=0)
    if not np.isfinite(p).all():
        raise UserError(f"this {entity.value} has no finite position: it cannot be shown")
    return np.asarray(p)
