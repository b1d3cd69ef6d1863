"""A grid of streets between blocks of houses: geometry of the blocks and routes round them.

Block (column, row) has its centre at (column, row) times the pitch, which is the size of a block
plus the width of a street. Streets surround every block, so the outermost blocks have streets on
all sides too. There is no ceiling; facades and pavement carry the landmarks.
"""

from __future__ import annotations

import numpy as np

from maplab_py.array_types import F64
from maplab_py.simulation.scenario import WorldOptions
from maplab_py.simulation.surfaces import Surfaces, box_surfaces, join, scatter

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
        options: The world.
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
    return join([walls, ground])
