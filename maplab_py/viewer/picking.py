"""Picking: the vertex, landmark or loop closure of a click."""

import dataclasses

import numpy as np
from numpy.typing import ArrayLike

from maplab_py.algorithms.loop_closure.closure_record import read_record
from maplab_py.array_types import F32, F64, I64, U64
from maplab_py.errors import MapError, UserError
from maplab_py.viewer.drawing import Drawing
from maplab_py.viewer.layers.closures import closure_ends
from maplab_py.viewer.scene import Entity, Points, Scene, Segments
from maplab_py.vimap import IdArray, VIMap, to_hex
from maplab_py.vimap.ids import HEX_DIGITS

_CONE_RAD = np.radians(1.2)
"""A click means nothing that is further from its ray than this."""

_BONUS_RAD = {
    Entity.VERTEX: 0.4 * _CONE_RAD,
    Entity.LANDMARK: 0.1 * _CONE_RAD,
    Entity.LOOP_CLOSURE: 0.0,
    Entity.CLOSURE: 0.0,
}
"""Vertices are few and large and win against what is beside them, as do points against lines."""


@dataclasses.dataclass(frozen=True, eq=False)
class Pick:
    """Clicked entity."""

    entity: Entity
    row: int
    p: F64  # (3,) in the scene
    angle_rad: float  # between the ray and the point


def pick(
    scene: Scene,
    origin: ArrayLike,
    direction: ArrayLike,
    *,
    layers: set[str] | None = None,
    missions: set[str] | None = None,
) -> Pick | None:
    """Return what lies nearest to a ray, or None.

    Nearest is by angle as seen from the ray's origin, so that a click is as exact far away as
    close by; among things at nearly the same angle the front one wins.

    Args:
        origin: Where the ray begins (3,), in the scene.
        direction: Its direction (3,).
        layers: Names of the layers that are visible; None = all.
        missions: Ids of the missions that are visible; None = all.
    """
    o = np.asarray(origin, dtype=np.float64)
    d = np.asarray(direction, dtype=np.float64)
    d = d / np.linalg.norm(d)
    best: Pick | None = None
    best_score = np.inf
    for layer in scene.layers:
        if layer.entity is Entity.NONE or (layers is not None and layer.name not in layers):
            continue
        for mission_id, part in layer.parts.items():
            if missions is not None and mission_id and mission_id not in missions:
                continue
            if not isinstance(part, (Points, Segments)) or not len(part):
                continue
            nearest = _nearest(part, o, d)
            score = nearest[0] - _BONUS_RAD[layer.entity]
            if nearest[0] <= _CONE_RAD and score < best_score:
                best_score = score
                row = int(part.rows[nearest[1]])
                best = Pick(layer.entity, row, nearest[2], nearest[0])
    return best


def _nearest(part: Points | Segments, o: F64, d: F64) -> tuple[float, int, F64]:
    """Return angle [rad], place in the part, and point (3,) of what lies nearest to the ray."""
    p = part.p if isinstance(part, Points) else _nearest_on_segments(part.ends, o, d)
    v = p - o.astype(p.dtype)
    depth = v @ d.astype(p.dtype)
    square = np.einsum("ij,ij->i", v, v) - depth * depth
    with np.errstate(divide="ignore", invalid="ignore"):
        angle = np.sqrt(np.maximum(square, 0.0)) / depth
    angle[~(depth > 0.0)] = np.inf
    least = float(angle.min())
    if not np.isfinite(least):
        return np.inf, 0, np.zeros(3)
    similar = np.flatnonzero(angle <= least + 0.1 * _CONE_RAD)
    place = int(similar[np.argmin(depth[similar])])
    return float(angle[place]), place, p[place].astype(np.float64)


def _nearest_on_segments(ends: F32, o: F64, d: F64) -> F64:
    """Return the points (N, 3) of segments (N, 2, 3) that are closest to a line.

    Source: Eberly, 3D Game Engine Design, 2006, distance between line and segment.
    """
    start = ends[:, 0].astype(np.float64)
    u = ends[:, 1] - start
    w = start - o
    along = u @ d
    normal_u = u - along[:, None] * d
    normal_w = w - (w @ d)[:, None] * d
    length = np.einsum("ij,ij->i", normal_u, normal_u)
    part = -np.einsum("ij,ij->i", normal_u, normal_w) / np.maximum(length, 1e-12)
    return np.asarray(start + np.clip(part, 0.0, 1.0)[:, None] * u)


MIN_DIGITS = 4
"""Fewer digits of an id mean nothing."""


def find_by_id(drawing: Drawing, text: str) -> Pick:
    """Return the entity whose id starts with some digits, as if it had been clicked.

    A mission is represented by its first vertex.

    Args:
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
    recorded = recorded_ids(vi_map)
    tables = (
        ("vertex", vi_map.vertices.id, Entity.VERTEX),
        ("landmark", vi_map.landmarks.id, Entity.LANDMARK),
        ("loop closure", vi_map.loop_closure_edges.id, Entity.LOOP_CLOSURE),
        ("closure", recorded, Entity.CLOSURE),
        ("mission", vi_map.missions.id, Entity.NONE),
    )
    matches = [
        (name, row, entity)
        for name, ids, entity in tables
        for row in _rows_with_prefix(ids, prefix).tolist()
    ]
    edges = [
        to_hex(vi_map.loop_closure_edges.id[row])
        for name, row, _ in matches
        if name == "loop closure"
    ]
    matches = [  # an edge that was made from a recorded closure has its id
        match
        for match in matches
        if match[2] is not Entity.CLOSURE or to_hex(recorded[match[1]]) not in edges
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


def recorded_ids(vi_map: VIMap) -> IdArray:
    """Return the ids (N, 2) of the recorded closures; none if the record is damaged."""
    try:
        return np.asarray(read_record(vi_map).closures.id)
    except MapError:
        return np.zeros((0, 2), dtype=np.uint64)


def id_of(vi_map: VIMap, picked: Pick) -> str:
    """Return the id of what was picked."""
    ids = {
        Entity.VERTEX: vi_map.vertices.id,
        Entity.LANDMARK: vi_map.landmarks.id,
        Entity.LOOP_CLOSURE: vi_map.loop_closure_edges.id,
    }
    table = recorded_ids(vi_map) if picked.entity is Entity.CLOSURE else ids[picked.entity]
    return to_hex(table[picked.row])


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


def ends_of(drawing: Drawing, entity: Entity, row: int) -> tuple[int, ...]:
    """Return the vertices (rows) that a closure joins; none of another entity."""
    if entity is Entity.LOOP_CLOSURE:
        edges = drawing.vi_map.loop_closure_edges
        return int(edges.from_vertex[row]), int(edges.to_vertex[row])
    if entity is Entity.CLOSURE:
        closure = read_record(drawing.vi_map).closures.take(np.array([row]))
        return tuple(np.concatenate(closure_ends(drawing, closure)).tolist())
    return ()


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
        p = drawing.p_vertices[list(ends_of(drawing, entity, row))].mean(axis=0)
    if not np.isfinite(p).all():
        raise UserError(f"this {entity.value} has no finite position: it cannot be shown")
    return np.asarray(p)
