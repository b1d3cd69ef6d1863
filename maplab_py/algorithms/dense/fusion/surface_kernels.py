"""Compiled surface nets over voxel blocks: the surface between positive and negative distances.

A cell lies between eight voxel centres. It counts only if all eight have been observed; otherwise the
rim of the truncation band would become a false surface. Its vertex is the mean of the crossings on its
twelve edges. An edge between two voxels of different sign joins the vertices of the four cells around
it to a quadrilateral.
Source: Gibson, Constrained elastic surface nets, MICCAI 1998.
"""

from __future__ import annotations

import numpy as np

from maplab_py.algorithms.dense.fusion.block_kernels import BLOCK_SIDE, NEIGHBOURS
from maplab_py.array_types import F32, F64, I32
from maplab_py.compilation import compiled

_EDGES = (
    (0, 1), (2, 3), (4, 5), (6, 7), (0, 2), (1, 3), (4, 6), (5, 7), (0, 4), (1, 5), (2, 6), (3, 7),
)  # fmt: skip
"""Edges of a cell between its corners; the bits of a corner are its offsets along x, y and z."""


@compiled()
def neighbour_of(i: int, j: int, k: int) -> int:
    """Return the column of `around` of the block with a voxel, whose indices may be -1 or 8."""
    return 9 * (1 + i // BLOCK_SIDE) + 3 * (1 + j // BLOCK_SIDE) + 1 + k // BLOCK_SIDE


@compiled()
def read_block(
    block: int, around: I32, distance: F32, weight: F32, enough: float, values: F32
) -> None:
    """Copy the voxels (9, 9, 9) of a block and of the next ones along x, y and z; NaN = unobserved."""
    side = BLOCK_SIDE
    for i in range(side + 1):
        for j in range(side + 1):
            for k in range(side + 1):
                home = around[block, neighbour_of(i, j, k)]
                a, b, c = i % side, j % side, k % side
                is_observed = home >= 0 and weight[home, a, b, c] >= enough
                values[i, j, k] = distance[home, a, b, c] if is_observed else np.nan


@compiled()
def place_vertex(corners: F32, p: F64) -> bool:
    """Put the vertex (3,) of a cell of side 1; False if the surface does not pass through it."""
    negative = 0
    for m in range(8):
        if np.isnan(corners[m]):
            return False
        negative += corners[m] < 0
    if negative in (0, 8):
        return False
    p[:] = 0.0
    crossings = 0
    for a, b in _EDGES:
        if (corners[a] < 0) != (corners[b] < 0):
            s = corners[a] / (corners[a] - corners[b])
            p[0] += (a & 1) + s * ((b & 1) - (a & 1))
            p[1] += (a >> 1 & 1) + s * ((b >> 1 & 1) - (a >> 1 & 1))
            p[2] += (a >> 2) + s * ((b >> 2) - (a >> 2))
            crossings += 1
    p /= crossings
    return True


@compiled()
def place_vertices(
    coordinates: I32,
    around: I32,
    distance: F32,
    weight: F32,
    settings: F64,
    cells: I32,
    points: F64,
) -> int:
    """Number the cells that have a vertex, and put the vertices; return their number.

    Args:
        coordinates: Blocks (B, 3).
        around: Rows (B, 27) of the blocks around each.
        distance: Distances (B, 8, 8, 8).
        weight: Weights (B, 8, 8, 8).
        settings: Voxel size [m] and the weight from which a voxel counts as observed.
        cells: Numbers (B, 8, 8, 8) of the vertices to fill, -1 = none.
        points: Vertices (N, 3) to fill [m]; with N = 0 they are only counted.
    """
    side = BLOCK_SIDE
    values = np.empty((side + 1, side + 1, side + 1), dtype=np.float32)
    corners = np.empty(8, dtype=np.float32)
    p = np.empty(3)
    count = 0
    for block in range(len(coordinates)):
        read_block(block, around, distance, weight, settings[1], values)
        for i in range(side):
            for j in range(side):
                for k in range(side):
                    cells[block, i, j, k] = -1
                    for m in range(8):
                        corners[m] = values[i + (m & 1), j + (m >> 1 & 1), k + (m >> 2)]
                    if not place_vertex(corners, p):
                        continue
                    if len(points):
                        for axis, index in enumerate((i, j, k)):
                            voxels = coordinates[block, axis] * side + index + 0.5 + p[axis]
                            points[count, axis] = voxels * settings[0]
                    cells[block, i, j, k] = count
                    count += 1
    return count


@compiled()
def join_vertices(around: I32, distance: F32, cells: I32, quads: I32) -> int:
    """Join the vertices around every edge that the surface crosses; return the number of quads.

    Corners run anticlockwise as seen from the side of positive distances.

    Args:
        around: Rows (B, 27) of the blocks around each.
        distance: Distances (B, 8, 8, 8).
        cells: Numbers (B, 8, 8, 8) of the cells' vertices, -1 = none.
        quads: Vertices (M, 4) to fill; with M = 0 they are only counted.
    """
    side = BLOCK_SIDE
    corner = np.empty(4, dtype=np.int32)
    at = np.empty(3, dtype=np.int64)
    count = 0
    for block in range(len(around)):
        for i in range(side):
            for j in range(side):
                for k in range(side):
                    if cells[block, i, j, k] < 0:
                        continue
                    is_negative = distance[block, i, j, k] < 0
                    for axis in range(3):
                        p, q, r = i + (axis == 0), j + (axis == 1), k + (axis == 2)
                        home = around[block, neighbour_of(p, q, r)]
                        if (distance[home, p % side, q % side, r % side] < 0) == is_negative:
                            continue
                        is_complete = True
                        for m in range(4):
                            at[0], at[1], at[2] = i, j, k
                            at[(axis + 1) % 3] -= m in (1, 2)
                            at[(axis + 2) % 3] -= m >= 2
                            home = around[block, neighbour_of(at[0], at[1], at[2])]
                            corner[m] = (
                                cells[home, at[0] % side, at[1] % side, at[2] % side]
                                if home >= 0
                                else -1
                            )
                            is_complete = is_complete and corner[m] >= 0
                        if is_complete:
                            if len(quads):
                                for m in range(4):
                                    quads[count, m] = corner[m] if is_negative else corner[3 - m]
                            count += 1
    return count


def compile_kernels() -> None:
    """Compile the kernels of this module for the types that the grid uses."""
    around = np.full((1, NEIGHBOURS), -1, dtype=np.int32)
    voxels = np.zeros((1, BLOCK_SIDE, BLOCK_SIDE, BLOCK_SIDE), dtype=np.float32)
    cells = np.full(voxels.shape, -1, dtype=np.int32)
    coordinates = np.zeros((1, 3), dtype=np.int32)
    settings = np.array([0.1, 1.0])
    place_vertices(coordinates, around, voxels, voxels, settings, cells, np.zeros((0, 3)))
    join_vertices(around, voxels, cells, np.zeros((0, 4), dtype=np.int32))
