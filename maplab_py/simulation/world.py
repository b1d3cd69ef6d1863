"""Worlds: rooms in a row, corridors around a block or streets, with landmarks on their surfaces."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.array_types import F64, I64, Mask, NDArray
from maplab_py.simulation.scenario import WorldOptions
from maplab_py.simulation.surfaces import Surfaces, box_surfaces, scatter

_DOOR_WIDTH_M = 2.0
_DOOR_HEIGHT_M = 2.4
_THIN_M = 1e-7
"""Half the thickness of walls and slabs that landmarks float in front of."""
_STAIR_MARGIN_M = 0.3


@dataclasses.dataclass(frozen=True, eq=False)
class World:
    """Landmarks with normals, and boxes that occlude them. Room 0 is centred at 0."""

    p_G: F64  # (L, 3)
    normal_G: F64  # (L, 3) unit, into the free space
    look: I64  # (L,) landmarks of equal number have the same appearance
    boxes: F64  # (B, 2, 3) lower and upper corners
    bounds: F64  # (2, 3) lower and upper corner of everything
    moving: I64  # (L,) number of the object that carries the landmark, -1 = none
    objects: tuple[MovingObject, ...] = ()
    exists: Mask | None = None  # (sessions, L) where the world changes
    has_box: Mask | None = None  # (sessions, B)
    light: I64 | None = None  # (L,) the only light in which the landmark is seen, -1 = any

    def in_session(self, number: int) -> World:
        """Return the world with the boxes of a session; landmarks keep their rows."""
        if self.has_box is None:
            return self
        return dataclasses.replace(self, boxes=self.boxes[self.has_box[number]])


def make_world(options: WorldOptions, rng: np.random.Generator) -> World:
    """Build the walls, scatter landmarks on their surfaces, and let objects move."""
    if options.layout == "corridor":
        world = _corridor(options, rng)
    elif options.layout == "city":
        world = _city(options, rng)
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
    carrier = np.repeat(np.arange(count), options.landmarks_per_object)
    return dataclasses.replace(
        world,
        p_G=np.concatenate([world.p_G, p_G]),
        normal_G=np.concatenate([world.normal_G, normal_G]),
        look=np.concatenate([world.look, first + np.arange(len(p_G))]),
        moving=np.concatenate([world.moving, carrier]),
        objects=objects,
    )


def _standing(p_G: F64) -> I64:
    return np.full(len(p_G), -1, dtype=np.int64)


# -- rooms ----------------------------------------------------------------------------------------


def _rooms(options: WorldOptions, rng: np.random.Generator) -> World:
    rooms = [_furnish(room, options, rng) for room in range(options.rooms)]
    p_G = np.concatenate([room.p_G for room in rooms])
    return _world_of_rooms(options, rooms, np.arange(len(p_G)))


def _identical_rooms(options: WorldOptions, rng: np.random.Generator) -> World:
    """Build one room, repeat it, and add some distinct landmarks to each; corridors differ."""
    size = np.asarray(options.room_size_m, dtype=np.float64)
    low = _corner_of_room(0, size)
    furniture = _furniture(options.furniture_per_room, low, size, rng)
    surfaces = _room_surfaces(low, size, furniture)
    distinct_count = round(options.distinct_share * options.landmarks_per_room)
    common_p, common_n = scatter(
        surfaces, options, options.landmarks_per_room - distinct_count, rng
    )
    rooms, looks, begin = [], [], len(common_p)
    for room in range(options.rooms):
        if room in options.corridor_rooms:
            rooms.append(_furnish(room, options, rng))
            looks.append(begin + np.arange(len(rooms[-1].p_G)))
            begin += len(rooms[-1].p_G)
            continue
        shift = np.array([room * size[0], 0.0, 0.0])
        distinct_p, distinct_n = scatter(surfaces, options, distinct_count, rng)
        p = np.concatenate([common_p, distinct_p]) + shift
        look = np.concatenate([np.arange(len(common_p)), begin + np.arange(distinct_count)])
        keep = ~_in_doorway(p, room, options.rooms, size)
        normal = np.concatenate([common_n, distinct_n])
        rooms.append(_Room(p[keep], normal[keep], furniture + shift))
        looks.append(look[keep])
        begin += distinct_count
    return _world_of_rooms(options, rooms, np.concatenate(looks))


@dataclasses.dataclass(frozen=True, eq=False)
class _Room:
    """Landmarks of a room and what stands in it."""

    p_G: F64  # (L, 3)
    normal_G: F64  # (L, 3)
    boxes: F64  # (B, 2, 3)


def _furnish(room: int, options: WorldOptions, rng: np.random.Generator) -> _Room:
    """Return a room with furniture of its own, or an empty corridor."""
    size = np.asarray(options.room_size_m, dtype=np.float64)
    low = _corner_of_room(room, size)
    if room in options.corridor_rooms:
        side = 0.5 * (size[1] - options.corridor_width_m)
        inner = np.array([0.0, side, 0.0])
        surfaces = box_surfaces(low + inner, low + size - inner, inwards=True)
        boxes = np.array(
            [
                [low, low + np.array([size[0], side, size[2]])],
                [low + np.array([0.0, size[1] - side, 0.0]), low + size],
            ]
        )
    else:
        boxes = _furniture(options.furniture_per_room, low, size, rng)
        surfaces = _room_surfaces(low, size, boxes)
    p, n = scatter(surfaces, options, options.landmarks_per_room, rng)
    keep = ~_in_doorway(p, room, options.rooms, size)
    return _Room(p[keep], n[keep], boxes)


def _world_of_rooms(options: WorldOptions, rooms: list[_Room], look: I64) -> World:
    size = np.asarray(options.room_size_m, dtype=np.float64)
    walls = [_dividing_walls(room, size) for room in range(1, options.rooms)]
    low = _corner_of_room(0, size)
    high = _corner_of_room(options.rooms - 1, size) + size
    p_G = np.concatenate([room.p_G for room in rooms])
    return World(
        p_G,
        np.concatenate([room.normal_G for room in rooms]),
        look,
        np.concatenate([*(room.boxes for room in rooms), *walls]),
        np.stack([low, high]),
        _standing(p_G),
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
    return Surfaces.concatenate(
        [inside, *(box_surfaces(box[0], box[1], inwards=False) for box in furniture)]
    )


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


# -- streets --------------------------------------------------------------------------------------


def _city(options: WorldOptions, rng: np.random.Generator) -> World:
    p_G, normal_G = street_landmarks(options, rng)
    return World(
        p_G,
        normal_G,
        np.arange(len(p_G)),
        block_boxes(options),
        street_bounds(options),
        _standing(p_G),
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
    points, normals, looks = [], [], []
    for floor in range(options.floors):
        if floor == 0 or not options.identical_floors:
            surfaces = _floor_surfaces(options, block, floor * size[2])
            p, n = scatter(surfaces, options, options.landmarks_per_room, rng)
            look = floor * options.landmarks_per_room + np.arange(len(p))
        else:
            p = p + np.array([0.0, 0.0, size[2]])
        keep = ~_in_block(p, block) & ~_in_stairwell(p, n, floor, options)
        points.append(p[keep])
        normals.append(n[keep])
        looks.append(look[keep])
    p_G = np.concatenate(points)
    look = np.unique(np.concatenate(looks), return_inverse=True)[1]  # numbered without gaps
    slabs = [_slab(floor * size[2], options) for floor in range(1, options.floors)]
    bounds = np.array([[-half[0], -half[1], 0.0], [half[0], half[1], top]])
    boxes = np.concatenate([block[None], *slabs])
    return World(p_G, np.concatenate(normals), look, boxes, bounds, _standing(p_G))


def _floor_surfaces(options: WorldOptions, block: F64, z_m: float) -> Surfaces:
    """Return the surfaces of one floor of the corridor, whose ground is at height z."""
    half = 0.5 * np.asarray(options.room_size_m[:2])
    low, high = np.append(-half, z_m), np.append(half, z_m + options.room_size_m[2])
    outer = box_surfaces(low, high, inwards=True)
    inner = box_surfaces(
        np.append(block[0, :2], low[2]), np.append(block[1, :2], high[2]), inwards=False
    )
    return Surfaces.concatenate([outer, inner.take(np.arange(4))])


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


_SIZE_M = np.array([0.6, 0.6, 1.5])
_REACH_M = (1.0, 2.5)


@dataclasses.dataclass(frozen=True, eq=False)
class MovingObject:
    """A box that oscillates; its landmarks are stored at the middle of its path."""

    reach_G: F64  # (3,) from the middle to a turning point [m]
    period_s: float
    phase: float

    def displacement(self, time_s: F64) -> F64:
        """Return the offset (N, 3) [m] of the object from the middle of its path at times (N,)."""
        swing = np.sin(2.0 * np.pi * time_s / self.period_s + self.phase)
        return np.asarray(swing[:, None] * self.reach_G)


def make_moving_objects(
    count: int, landmarks: int, speed_mps: float, bounds: F64, rng: np.random.Generator
) -> tuple[tuple[MovingObject, ...], F64, F64]:
    """Draw objects inside bounds (2, 3).

    Returns:
        The objects; points and normals (count * landmarks, 3), object after object.
    """
    objects, points, normals = [], [], []
    for _ in range(count):
        margin = 0.5 * _SIZE_M[:2] + 0.3
        xy = rng.uniform(bounds[0, :2] + margin, bounds[1, :2] - margin)
        angle = rng.uniform(0.0, 2.0 * np.pi)
        direction = np.array([np.cos(angle), np.sin(angle)])
        # as far as the walls allow in both directions
        room = np.minimum(xy - bounds[0, :2], bounds[1, :2] - xy) - margin
        allowed = float(np.min(room / np.maximum(np.abs(direction), 1e-9)))
        reach = min(rng.uniform(*_REACH_M), max(allowed, 0.0))
        low = np.array([*(xy - 0.5 * _SIZE_M[:2]), bounds[0, 2]])
        surfaces = box_surfaces(low, low + _SIZE_M, inwards=False)
        p, n = scatter(surfaces, WorldOptions(patchiness=0.0), landmarks, rng)
        points.append(p)
        normals.append(n)
        # mean speed of a sinusoid: 4 reach / period
        period = max(4.0 * reach / speed_mps, 1.0)
        phase = rng.uniform(0.0, 2.0 * np.pi)
        objects.append(MovingObject(np.append(reach * direction, 0.0), period, phase))
    return tuple(objects), np.concatenate(points), np.concatenate(normals)


# A grid of streets between blocks of houses: geometry of the blocks and routes round them.
#
# Block (column, row) has its centre at (column, row) times the pitch, which is the size of a block plus
# the width of a street. Streets surround every block, so the outermost blocks have streets on all sides
# too. There is no ceiling; facades and pavement carry the landmarks.

_TURN_RADIUS_M = 2.0
_ROUTE_POINTS = 4096


def pitch_m(options: WorldOptions) -> F64:
    """Return the distances (2,) [m] between the centres of neighbouring blocks."""
    return np.asarray(options.room_size_m[:2], dtype=np.float64) + options.corridor_width_m


def block_boxes(options: WorldOptions) -> F64:
    """Return the blocks of houses as boxes (columns * rows, 2, 3), row by row."""
    size = np.asarray(options.room_size_m, dtype=np.float64)
    columns, rows = options.blocks
    column, row = np.meshgrid(np.arange(columns), np.arange(rows))
    centre = np.stack([column.ravel(), row.ravel()], axis=1) * pitch_m(options)
    low = np.column_stack([centre - 0.5 * size[:2], np.zeros(len(centre))])
    return np.stack([low, low + size], axis=1)


def street_landmarks(options: WorldOptions, rng: np.random.Generator) -> tuple[F64, F64]:
    """Scatter `landmarks_per_room` landmarks around each block: points and normals (L, 3)."""
    points, normals = [], []
    for low, high in block_boxes(options):
        around = _surroundings(low, high, options.corridor_width_m)
        p, n = scatter(around, options, options.landmarks_per_room, rng)
        hidden = (n[:, 2] > 0.5) & np.all((p[:, :2] > low[:2]) & (p[:, :2] < high[:2]), axis=1)
        points.append(p[~hidden])
        normals.append(n[~hidden])
    return np.concatenate(points), np.concatenate(normals)


def street_bounds(options: WorldOptions) -> F64:
    """Return the lower and upper corner (2, 3) of blocks and streets."""
    boxes = block_boxes(options)
    margin = np.array([options.corridor_width_m, options.corridor_width_m, 0.0])
    return np.stack([boxes[:, 0].min(axis=0) - margin, boxes[:, 1].max(axis=0) + margin])


def street_route(options: WorldOptions, first: tuple[int, int], last: tuple[int, int]) -> F64:
    """Return the closed route (4096, 2) in the streets round a rectangle of blocks, anticlockwise.

    Args:
        first: Column and row of the block at the rectangle's lower corner.
        last: Column and row of the block at its upper corner.
    """
    half = 0.5 * pitch_m(options)
    low, high = np.asarray(first) * 2.0 * half - half, np.asarray(last) * 2.0 * half + half
    angle = np.linspace(0.0, 0.5 * np.pi, 17)
    arc = _TURN_RADIUS_M * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    corners = []
    for quarter, corner in enumerate(
        ((high[0], low[1]), (high[0], high[1]), (low[0], high[1]), (low[0], low[1]))
    ):
        turned = _turn(arc, quarter - 1)
        inwards = _turn(np.array([[-1.0, -1.0]]), quarter - 1) * _TURN_RADIUS_M
        corners.append(np.asarray(corner) + inwards + turned)
    route = np.concatenate([*corners, corners[0][:1]])
    length = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(route, axis=0), axis=1)))
    at = np.linspace(0.0, length[-1], _ROUTE_POINTS, endpoint=False)
    return np.stack([np.interp(at, length, route[:, axis]) for axis in range(2)], axis=1)


def _turn(xy: F64, quarters: int) -> F64:
    """Return points (N, 2) turned by a number of right angles."""
    for _ in range(quarters % 4):
        xy = np.stack([-xy[:, 1], xy[:, 0]], axis=1)
    return xy


def _surroundings(low: F64, high: F64, street_m: float) -> Surfaces:
    """Return the four facades of a block, and the ground with half of the streets around it."""
    facades = box_surfaces(low, high, inwards=False)
    half = 0.5 * np.array([street_m, street_m])
    corner = np.append(low[:2] - half, 0.0)[None]
    size = high[:2] - low[:2] + 2.0 * half
    ground = Surfaces(
        corner,
        np.array([[size[0], 0.0, 0.0]]),
        np.array([[0.0, size[1], 0.0]]),
        np.array([[0.0, 0.0, 1.0]]),
    )
    walls = Surfaces(facades.corner[:4], facades.side_u[:4], facades.side_v[:4], facades.normal[:4])
    return Surfaces.concatenate([walls, ground])
