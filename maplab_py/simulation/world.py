"""Worlds: rooms in a row or corridors around a block, with landmarks on their surfaces."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.simulation.moving_objects import MovingObject, make_moving_objects
from maplab_py.simulation.scenario import WorldOptions
from maplab_py.simulation.surfaces import Surfaces, box_surfaces, join, scatter

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

_DOOR_WIDTH_M = 2.0
_DOOR_HEIGHT_M = 2.4
_THIN_M = 1e-7
"""Half the thickness of walls and slabs that landmarks float in front of."""
_STAIR_MARGIN_M = 0.3


@dataclasses.dataclass(frozen=True, eq=False)
class World:
    """Landmarks with normals, and boxes that hide what is behind them. Room 0 is centred at 0."""

    p_G: F64  # (L, 3)
    normal_G: F64  # (L, 3) unit, into the free space
    look: I64  # (L,) landmarks of equal number look alike
    boxes: F64  # (B, 2, 3) lower and upper corners
    bounds: F64  # (2, 3) lower and upper corner of everything
    moving: I64  # (L,) number of the object that carries the landmark, -1 = none
    objects: tuple[MovingObject, ...] = ()


def make_world(options: WorldOptions, rng: np.random.Generator) -> World:
    """Build the walls, scatter landmarks on their surfaces, and let objects move."""
    if options.layout == "corridor":
        world = _corridor(options, rng)
    elif options.identical_rooms:
        world = _identical_rooms(options, rng)
    else:
        world = _rooms(options, rng)
    return _with_moving_objects(world, options, rng) if options.moving_objects else world


def _with_moving_objects(world: World, options: WorldOptions, rng: np.random.Generator) -> World:
    count = options.moving_objects
    objects, p_G, normal_G = make_moving_objects(
        count, options.landmarks_per_object, options.object_speed_mps, world.bounds, rng
    )
    first = int(world.look.max(initial=-1)) + 1
    return World(
        np.concatenate([world.p_G, p_G]),
        np.concatenate([world.normal_G, normal_G]),
        np.concatenate([world.look, first + np.arange(len(p_G))]),
        world.boxes,
        world.bounds,
        np.concatenate([world.moving, np.repeat(np.arange(count), options.landmarks_per_object)]),
        objects,
    )


def _standing(p_G: F64) -> I64:
    return np.full(len(p_G), -1, dtype=np.int64)


# -- rooms ----------------------------------------------------------------------------------------


def _rooms(options: WorldOptions, rng: np.random.Generator) -> World:
    size = np.asarray(options.room_size_m, dtype=np.float64)
    points, normals, boxes = [], [], []
    for room in range(options.rooms):
        low = _corner_of_room(room, size)
        furniture = _furniture(options.furniture_per_room, low, size, rng)
        surfaces = _room_surfaces(low, size, furniture)
        p, n = scatter(surfaces, options, options.landmarks_per_room, rng)
        keep = ~_in_doorway(p, room, options.rooms, size)
        points.append(p[keep])
        normals.append(n[keep])
        boxes.append(furniture)
    p_G = np.concatenate(points)
    return _world_of_rooms(options, p_G, np.concatenate(normals), np.arange(len(p_G)), boxes)


def _identical_rooms(options: WorldOptions, rng: np.random.Generator) -> World:
    """Build one room, repeat it, and give each a few landmarks of its own."""
    size = np.asarray(options.room_size_m, dtype=np.float64)
    low = _corner_of_room(0, size)
    furniture = _furniture(options.furniture_per_room, low, size, rng)
    surfaces = _room_surfaces(low, size, furniture)
    own = round(options.distinct_share * options.landmarks_per_room)
    common_p, common_n = scatter(surfaces, options, options.landmarks_per_room - own, rng)
    points, normals, looks, boxes = [], [], [], []
    for room in range(options.rooms):
        shift = np.array([room * size[0], 0.0, 0.0])
        own_p, own_n = scatter(surfaces, options, own, rng)
        p = np.concatenate([common_p, own_p]) + shift
        first_own = len(common_p) + room * own
        look = np.concatenate([np.arange(len(common_p)), np.arange(first_own, first_own + own)])
        keep = ~_in_doorway(p, room, options.rooms, size)
        points.append(p[keep])
        normals.append(np.concatenate([common_n, own_n])[keep])
        looks.append(look[keep])
        boxes.append(furniture + shift)
    return _world_of_rooms(
        options, np.concatenate(points), np.concatenate(normals), np.concatenate(looks), boxes
    )


def _world_of_rooms(
    options: WorldOptions, p_G: F64, normal_G: F64, look: I64, boxes: list[F64]
) -> World:
    size = np.asarray(options.room_size_m, dtype=np.float64)
    walls = [_dividing_walls(room, size) for room in range(1, options.rooms)]
    low = _corner_of_room(0, size)
    high = _corner_of_room(options.rooms - 1, size) + size
    return World(
        p_G, normal_G, look, np.concatenate([*boxes, *walls]), np.stack([low, high]), _standing(p_G)
    )


def _corner_of_room(room: int, size: F64) -> F64:
    return np.array([(room - 0.5) * size[0], -0.5 * size[1], 0.0])


def _furniture(count: int, low: F64, size: F64, rng: np.random.Generator) -> F64:
    """Return cupboards (count, 2, 3) that stand against the long walls."""
    width = rng.uniform(0.5, 1.4, count)
    depth = rng.uniform(0.3, 0.7, count)
    height = rng.uniform(0.7, 2.0, count)
    x = low[0] + rng.uniform(0.1, 0.9, count) * (size[0] - width)
    y = np.where(np.arange(count) % 2 == 0, low[1], low[1] + size[1] - depth)
    corner = np.stack([x, y, np.zeros(count)], axis=1)
    return np.stack([corner, corner + np.stack([width, depth, height], axis=1)], axis=1)


def _room_surfaces(low: F64, size: F64, furniture: F64) -> Surfaces:
    inside = box_surfaces(low, low + size, inwards=True)
    return join([inside, *(box_surfaces(box[0], box[1], inwards=False) for box in furniture)])


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
    x, half = (room - 0.5) * size[0], 0.5 * size[1]
    door = 0.5 * _DOOR_WIDTH_M
    return np.array(
        [
            [[x - _THIN_M, -half, 0.0], [x + _THIN_M, -door, size[2]]],
            [[x - _THIN_M, door, 0.0], [x + _THIN_M, half, size[2]]],
            [[x - _THIN_M, -door, _DOOR_HEIGHT_M], [x + _THIN_M, door, size[2]]],
        ]
    )


# -- corridors ------------------------------------------------------------------------------------


def stair_half_length(options: WorldOptions) -> float:
    """Return half the length [m] of the stairs in the two sides of a corridor along y."""
    return 0.5 * (options.room_size_m[1] - 3.0 * options.corridor_width_m)


def _corridor(options: WorldOptions, rng: np.random.Generator) -> World:
    size = np.asarray(options.room_size_m, dtype=np.float64)
    half, width = 0.5 * size[:2], options.corridor_width_m
    top = options.floors * size[2]
    block = np.array([[*(width - half), 0.0], [*(half - width), top]])
    points, normals = [], []
    for floor in range(options.floors):
        low = np.array([-half[0], -half[1], floor * size[2]])
        high = np.array([half[0], half[1], (floor + 1) * size[2]])
        outer = box_surfaces(low, high, inwards=True)
        inner = box_surfaces(
            np.array([*block[0, :2], low[2]]), np.array([*block[1, :2], high[2]]), inwards=False
        )
        walls = join([outer, _first(inner, 4)])
        p, n = scatter(walls, options, options.landmarks_per_room, rng)
        keep = ~_in_block(p, block) & ~_in_stairwell(p, n, floor, options)
        points.append(p[keep])
        normals.append(n[keep])
    p_G = np.concatenate(points)
    slabs = [_slab(floor * size[2], options) for floor in range(1, options.floors)]
    bounds = np.array([[-half[0], -half[1], 0.0], [half[0], half[1], top]])
    boxes = np.concatenate([block[None], *slabs])
    return World(p_G, np.concatenate(normals), np.arange(len(p_G)), boxes, bounds, _standing(p_G))


def _first(surfaces: Surfaces, count: int) -> Surfaces:
    return Surfaces(
        surfaces.corner[:count],
        surfaces.side_u[:count],
        surfaces.side_v[:count],
        surfaces.normal[:count],
    )


def _in_block(p: F64, block: F64) -> NDArray[np.bool_]:
    """Tell which points of floor and ceiling lie inside the block."""
    return np.asarray(np.all((p[:, :2] > block[0, :2]) & (p[:, :2] < block[1, :2]), axis=1))


def _in_stairwell(p: F64, normal: F64, floor: int, options: WorldOptions) -> NDArray[np.bool_]:
    """Tell which points hang in an opening between two floors."""
    in_well = np.abs(p[:, 1]) < stair_half_length(options) + _STAIR_MARGIN_M
    in_well &= np.abs(p[:, 0]) > 0.5 * options.room_size_m[0] - options.corridor_width_m
    open_below = (normal[:, 2] > 0.5) & (floor > 0)
    open_above = (normal[:, 2] < -0.5) & (floor + 1 < options.floors)
    return np.asarray(in_well & (open_below | open_above))


def _slab(z: float, options: WorldOptions) -> F64:
    """Return the ceiling between two floors of the corridor as boxes (6, 2, 3)."""
    x, y = 0.5 * options.room_size_m[0], 0.5 * options.room_size_m[1]
    width = options.corridor_width_m
    well = stair_half_length(options) + _STAIR_MARGIN_M
    rectangles = [[-x, -y, x, width - y], [-x, y - width, x, y]]
    for side in (-1.0, 1.0):
        low, high = sorted((side * x, side * (x - width)))
        rectangles += [[low, width - y, high, -well], [low, well, high, y - width]]
    low_high = np.array(rectangles).reshape(-1, 2, 2)
    heights = np.broadcast_to(np.array([z - _THIN_M, z + _THIN_M]), (len(low_high), 2))
    return np.concatenate([low_high, heights[:, :, None]], axis=2)
