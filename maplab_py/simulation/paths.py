"""Paths in a world: position and yaw as functions of the number of turns."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from maplab_py.array_types import F64
from maplab_py.simulation.scenario import MotionOptions, WorldOptions
from maplab_py.simulation.streets import street_route
from maplab_py.simulation.world import stair_half_length

Path = Callable[[F64, MotionOptions, WorldOptions], tuple[F64, F64]]
"""Takes turns (N,) [rad]; returns positions (N, 3) above the height of the motion, and yaw (N,)."""

_POINTS_PER_TURN = 4096
_LANE_M = 0.4
"""Distance from the middle of a doorway, so that the paths in both directions differ."""
_DOOR_APPROACH_M = 1.5


def follow(turn: F64, motion: MotionOptions, world: WorldOptions) -> tuple[F64, F64]:
    """Return positions (N, 3) above the height of the motion and yaw (N,) after turns (N,) [rad].

    The yaw points in the direction of increasing `turn`; in reverse motion it is opposite except
    on room_scan.
    """
    position, yaw = _PATHS[motion.kind](turn, motion, world)
    if motion.reverse and motion.kind != "room_scan":
        yaw = yaw + np.pi
    return position, yaw


def _room_scan(turn: F64, motion: MotionOptions, world: WorldOptions) -> tuple[F64, F64]:
    """Walk along an ellipse and look at the walls."""
    half = _half_room(motion, world)
    xy = np.stack([half[0] * np.cos(turn), half[1] * np.sin(turn)], axis=1)
    return _in_room(xy, motion, world), np.unwrap(
        np.arctan2(xy[:, 1] / half[1], xy[:, 0] / half[0])
    )


def _figure_8(turn: F64, motion: MotionOptions, world: WorldOptions) -> tuple[F64, F64]:
    """Walk a lemniscate and look ahead."""
    half = _half_room(motion, world)
    xy = np.stack([half[0] * np.sin(turn), half[1] * np.sin(2.0 * turn)], axis=1)
    ahead = np.stack([half[0] * np.cos(turn), 2.0 * half[1] * np.cos(2.0 * turn)], axis=1)
    return _in_room(xy, motion, world), np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))


def _loop(turn: F64, motion: MotionOptions, world: WorldOptions) -> tuple[F64, F64]:
    """Walk along the walls of all rooms, through the doorways there and back, and look ahead."""
    size_x = world.room_size_m[0]
    half = _half_room(motion, world)
    half[0] += 0.5 * (world.rooms - 1) * size_x
    xy = _superellipse(half, 4)
    xy[:, 0] += 0.5 * (world.rooms - 1) * size_x
    narrow = min(_LANE_M / half[1], 1.0)
    wide_y = xy[:, 1].copy()
    for door in range(1, world.rooms):
        distance = xy[:, 0] - (door - 0.5) * size_x
        xy[:, 1] *= 1.0 - (1.0 - narrow) * np.exp(-((distance / _DOOR_APPROACH_M) ** 2))
    for room in world.corridor_rooms:
        inside = np.abs(xy[:, 0] - room * size_x) <= 0.5 * size_x
        xy[:, 1] = np.where(inside, narrow * wide_y, xy[:, 1])
    return _along(np.column_stack([xy, np.zeros(len(xy))]), turn)


def _corridor(turn: F64, _: MotionOptions, world: WorldOptions) -> tuple[F64, F64]:
    """Walk the corridors, floor by floor up and down again, and look ahead."""
    half = 0.5 * (np.asarray(world.room_size_m[:2]) - world.corridor_width_m)
    # begins in the middle of the side at -y, away from the stairs
    xy = np.roll(_superellipse(half, 8), _POINTS_PER_TURN // 4, axis=0)
    position, yaw = _along(np.column_stack([xy, np.zeros(len(xy))]), turn)
    if world.floors == 1:
        return position, yaw
    circuit = np.floor(turn / (2.0 * np.pi))
    within = turn / (2.0 * np.pi) - circuit
    step = np.mod(circuit, 2 * (world.floors - 1))
    upwards = step < world.floors - 1
    # up the stairs at +x in the first half of a circuit, down those at -x in the second
    stair = np.clip(position[:, 1] / stair_half_length(world), -1.0, 1.0)
    rise = np.where(within < 0.5, 0.5 + 0.5 * stair, 1.0)
    fall = np.where(within < 0.5, 0.0, 0.5 - 0.5 * stair)
    floor = np.where(upwards, step + _smooth(rise), 2 * (world.floors - 1) - step - _smooth(fall))
    position[:, 2] = floor * world.room_size_m[2]
    return position, yaw


def _streets(turn: F64, motion: MotionOptions, world: WorldOptions) -> tuple[F64, F64]:
    """Walk the streets round a rectangle of blocks and look ahead."""
    xy = street_route(world, motion.first_block, motion.last_block)
    return _along(np.column_stack([xy, np.zeros(len(xy))]), turn)


_PATHS: dict[str, Path] = {
    "room_scan": _room_scan,
    "figure_8": _figure_8,
    "loop": _loop,
    "vehicle": _loop,
    "corridor": _corridor,
    "streets": _streets,
}


def _half_room(motion: MotionOptions, world: WorldOptions) -> F64:
    return 0.5 * np.asarray(world.room_size_m[:2]) - motion.wall_distance_m


def _in_room(xy: F64, motion: MotionOptions, world: WorldOptions) -> F64:
    shift = motion.room * world.room_size_m[0]
    return np.column_stack([xy[:, 0] + shift, xy[:, 1], np.zeros(len(xy))])


def _superellipse(half: F64, power: int) -> F64:
    """Return one turn (4096, 2) of the curve |x / a|^n + |y / b|^n = 1, from +x towards +y."""
    angle = 2.0 * np.pi * np.arange(_POINTS_PER_TURN) / _POINTS_PER_TURN
    c, s = np.cos(angle), np.sin(angle)
    radius = (np.abs(c) ** power + np.abs(s) ** power) ** (-1.0 / power)
    return np.stack([half[0] * radius * c, half[1] * radius * s], axis=1)


def _along(curve: F64, turn: F64) -> tuple[F64, F64]:
    """Return positions (N, 3) and yaw (N,) at even speed along a closed curve (K, 3)."""
    closed = np.concatenate([curve, curve[:1]])
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    circuits = turn / (2.0 * np.pi)
    place = np.mod(circuits, 1.0) * length[-1]
    position = np.stack([np.interp(place, length, closed[:, k]) for k in range(3)], axis=1)
    ahead = np.roll(curve, -1, axis=0) - np.roll(curve, 1, axis=0)
    heading = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    round_trip = 2.0 * np.pi * np.round((heading[-1] - heading[0]) / (2.0 * np.pi))
    heading = np.concatenate([heading, heading[:1] + round_trip])
    return position, np.interp(place, length, heading) + round_trip * np.floor(circuits)


def _smooth(fraction: F64) -> F64:
    """Return a smooth step from 0 to 1 with zero slope at both ends."""
    return fraction**2 * (3.0 - 2.0 * fraction)
