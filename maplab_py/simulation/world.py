"""Worlds: rooms in a row with landmarks on walls, floor, ceiling and furniture."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.simulation.scenario import WorldOptions

F64 = NDArray[np.float64]

_DOOR_WIDTH_M = 2.0
_DOOR_HEIGHT_M = 2.4
_CLUSTER_SIZE_M = 0.5
_CLUSTERS_PER_LANDMARK = 1.0 / 40.0
_SURFACE_OFFSET_M = 1e-6
"""Landmarks float this far off their surface, so that the surface does not hide them."""


@dataclasses.dataclass(frozen=True, eq=False)
class World:
    """Landmarks with normals, and boxes that hide what is behind them. Room 0 is centred at 0."""

    p_G: F64  # (L, 3)
    normal_G: F64  # (L, 3) unit, into the free space
    boxes: F64  # (B, 2, 3) lower and upper corners
    extent_m: F64  # (3,) of all rooms together
    centre_xy: F64  # (2,) of all rooms together


@dataclasses.dataclass(frozen=True, eq=False)
class _Faces:
    """Rectangles: corner + a * side_u + b * side_v with a, b in [0, 1]."""

    corner: F64  # (F, 3)
    side_u: F64  # (F, 3)
    side_v: F64  # (F, 3)
    normal: F64  # (F, 3)


def make_world(options: WorldOptions, rng: np.random.Generator) -> World:
    """Build the rooms and scatter landmarks on their surfaces."""
    size = np.asarray(options.room_size_m, dtype=np.float64)
    points, normals, boxes = [], [], []
    for room in range(options.rooms):
        low = np.array([(room - 0.5) * size[0], -0.5 * size[1], 0.0])
        furniture = _furniture(options.furniture_per_room, low, size, rng)
        p, n = _scatter(options, low, size, furniture, rng)
        keep = ~_in_doorway(p, room, options.rooms, size)
        points.append(p[keep])
        normals.append(n[keep])
        boxes.append(furniture)
    boxes += [_dividing_walls(room, size) for room in range(1, options.rooms)]
    extent = size * np.array([options.rooms, 1, 1])
    centre = np.array([0.5 * (options.rooms - 1) * size[0], 0.0])
    return World(
        np.concatenate(points), np.concatenate(normals), np.concatenate(boxes), extent, centre
    )


def _furniture(count: int, low: F64, size: F64, rng: np.random.Generator) -> F64:
    """Return cupboards (count, 2, 3) that stand against the long walls."""
    width = rng.uniform(0.5, 1.4, count)
    depth = rng.uniform(0.3, 0.7, count)
    height = rng.uniform(0.7, 2.0, count)
    x = low[0] + rng.uniform(0.1, 0.9, count) * (size[0] - width)
    y = np.where(np.arange(count) % 2 == 0, low[1], low[1] + size[1] - depth)
    corner = np.stack([x, y, np.zeros(count)], axis=1)
    return np.stack([corner, corner + np.stack([width, depth, height], axis=1)], axis=1)


def _scatter(
    options: WorldOptions, low: F64, size: F64, furniture: F64, rng: np.random.Generator
) -> tuple[F64, F64]:
    """Draw landmarks: a share of them in clusters, the others evenly over all surfaces."""
    inside = _box_faces(low, low + size, inwards=True)
    faces = _join([inside, *(_box_faces(b[0], b[1], inwards=False) for b in furniture)])
    area = np.linalg.norm(np.cross(faces.side_u, faces.side_v), axis=1)
    count = options.landmarks_per_room
    face = rng.choice(len(area), count, p=area / area.sum())
    place = rng.uniform(0.0, 1.0, (count, 2))
    clusters = max(1, int(count * _CLUSTERS_PER_LANDMARK))
    cluster = rng.integers(0, clusters, count)
    clustered = rng.uniform(size=count) < options.patchiness
    spread = rng.normal(0.0, _CLUSTER_SIZE_M, (count, 2))
    face = np.where(clustered, face[cluster], face)
    lengths = np.stack(
        [np.linalg.norm(faces.side_u[face], axis=1), np.linalg.norm(faces.side_v[face], axis=1)],
        axis=1,
    )
    near = place[cluster] + spread / lengths
    place = np.where(
        clustered[:, None] & np.all((near > 0.0) & (near < 1.0), axis=1)[:, None], near, place
    )
    points = (
        faces.corner[face]
        + place[:, :1] * faces.side_u[face]
        + place[:, 1:] * faces.side_v[face]
        + _SURFACE_OFFSET_M * faces.normal[face]
    )
    return points, faces.normal[face]


def _box_faces(low: F64, high: F64, *, inwards: bool) -> _Faces:
    """Return the six faces of a box with normals that look in or out."""
    size = high - low
    corners, sides_u, sides_v, normals = [], [], [], []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for upper in (False, True):
            corner = low.copy()
            corner[axis] = high[axis] if upper else low[axis]
            corners.append(corner)
            sides_u.append(np.eye(3)[u] * size[u])
            sides_v.append(np.eye(3)[v] * size[v])
            normals.append(np.eye(3)[axis] * (1.0 if upper != inwards else -1.0))
    return _Faces(np.array(corners), np.array(sides_u), np.array(sides_v), np.array(normals))


def _join(parts: list[_Faces]) -> _Faces:
    names = [field.name for field in dataclasses.fields(_Faces)]
    return _Faces(**{n: np.concatenate([getattr(part, n) for part in parts]) for n in names})


def _in_doorway(p: F64, room: int, rooms: int, size: F64) -> NDArray[np.bool_]:
    """Tell which points of a room hang in one of its doorways."""
    open_sides = [(room + 0.5) * size[0]] if room + 1 < rooms else []
    open_sides += [(room - 0.5) * size[0]] if room > 0 else []
    at_side = np.zeros(len(p), dtype=np.bool_)
    for x in open_sides:
        at_side |= np.abs(p[:, 0] - x) < 1e-3
    return np.asarray(
        at_side & (np.abs(p[:, 1]) < 0.5 * _DOOR_WIDTH_M) & (p[:, 2] < _DOOR_HEIGHT_M)
    )


def _dividing_walls(room: int, size: F64) -> F64:
    """Return the wall between two rooms as boxes (3, 2, 3) around its doorway."""
    x, half, thin = (room - 0.5) * size[0], 0.5 * size[1], 1e-7
    door = 0.5 * _DOOR_WIDTH_M
    return np.array(
        [
            [[x - thin, -half, 0.0], [x + thin, -door, size[2]]],
            [[x - thin, door, 0.0], [x + thin, half, size[2]]],
            [[x - thin, -door, _DOOR_HEIGHT_M], [x + thin, door, size[2]]],
        ]
    )


def is_hidden(boxes: F64, eye: F64, point: F64) -> NDArray[np.bool_]:
    """Tell which lines of sight from eyes (N, 3) to points (N, 3) cross a box.

    The slab test of Kay and Kajiya (1986), one box at a time.
    """
    hidden = np.zeros(len(eye), dtype=np.bool_)
    direction = point - eye
    direction = np.where(np.abs(direction) < 1e-12, 1e-12, direction)
    inverse = 1.0 / direction
    for low, high in boxes:
        a, b = (low - eye) * inverse, (high - eye) * inverse
        enters = np.minimum(a, b).max(axis=1)
        leaves = np.maximum(a, b).min(axis=1)
        hidden |= (enters < leaves) & (leaves > 0.0) & (enters < 1.0 - 1e-9)
    return hidden
