"""Which blocks of the reduced system the landmarks fill.

Eliminating a landmark with n observations touches one block for each of its n (n + 1) / 2 pairs of
observations. There are some ten times as many pairs as observations and a hundred times as many as
blocks, so they are counted off row by row, without ever being listed or sorted.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maplab_py.estimation.linear.jit import compiled

I64 = NDArray[np.int64]
I32 = NDArray[np.int32]

_ABSENT = -1


@compiled()
def observations_by_vertex(vertex: I32, num_vertices: int) -> tuple[I64, I64]:
    """Return offsets (V + 1,) and the observations (O,) of every vertex, ascending."""
    start = np.zeros(num_vertices + 1, np.int64)
    for v in vertex:
        start[v + 1] += 1
    for v in range(num_vertices):
        start[v + 1] += start[v]
    free = start[:-1].copy()
    order = np.empty(len(vertex), np.int64)
    for o in range(len(vertex)):
        order[free[vertex[o]]] = o
        free[vertex[o]] += 1
    return start, order


@compiled()
def count_blocks(
    vertex: I32, first: I64, by_vertex_start: I64, by_vertex: I64, num_vertices: int
) -> I64:
    """Return the number of blocks (V,) in each block row: the diagonal, and lower ones in use."""
    count = np.ones(num_vertices, np.int64)
    last_row = np.full(num_vertices, _ABSENT, np.int64)  # the row in which a column was met last
    for row in range(num_vertices):
        last_row[row] = row
        for place in range(by_vertex_start[row], by_vertex_start[row + 1]):
            own = by_vertex[place]
            for other in range(first[own], own):
                col = vertex[other]
                if last_row[col] != row:
                    last_row[col] = row
                    count[row] += 1
    return count


@compiled()
def place_pairs(
    vertex: I32,
    first: I64,
    pair_start: I64,
    by_vertex_start: I64,
    by_vertex: I64,
    row_start: I64,
    cols: I64,
    pair_block: I32,
) -> None:
    """Fill the columns of all blocks and the block of every pair.

    Args:
        vertex: Vertex (O,) of every observation, ascending within a landmark.
        first: First observation (O,) of every observation's landmark.
        pair_start: First pair (O,) of every observation's landmark.
        by_vertex_start: Offsets (V + 1,) into by_vertex.
        by_vertex: Observations (O,) of every vertex.
        row_start: Offsets (V + 1,) of the block rows.
        cols: Result (B,): columns, ascending within a row.
        pair_block: Result (P,): blocks of the pairs (b, a), a <= b, of every landmark.
    """
    num_vertices = len(row_start) - 1
    block_of = np.full(num_vertices, _ABSENT, np.int64)
    for row in range(num_vertices):
        low, high = row_start[row], row_start[row + 1]
        met = low
        cols[met], block_of[row] = row, low
        for place in range(by_vertex_start[row], by_vertex_start[row + 1]):
            own = by_vertex[place]
            for other in range(first[own], own):
                col = vertex[other]
                if block_of[col] < low:
                    met += 1
                    cols[met], block_of[col] = col, met
        cols[low:high].sort()
        for block in range(low, high):
            block_of[cols[block]] = block
        for place in range(by_vertex_start[row], by_vertex_start[row + 1]):
            own = by_vertex[place]
            rank = own - first[own]
            pair = pair_start[own] + rank * (rank + 1) // 2
            for other in range(first[own], own + 1):
                pair_block[pair] = block_of[vertex[other]]
                pair += 1


def reduced_blocks(
    start: I64, vertex: I32, pair_start: I64, num_vertices: int
) -> tuple[I64, I64, I32, I64]:
    """Return row and column vertex of every block, the block of each pair, and the diagonal blocks.

    Blocks are in order of row, then column; the diagonal block of every vertex is among them.

    Args:
        start: Offsets (L + 1,) of the landmarks' observations.
        vertex: Vertex (O,) of every observation, ascending within a landmark.
        pair_start: Offsets (L + 1,) of the landmarks' pairs (b, a), a <= b.
        num_vertices: V.
    """
    counts = np.diff(start)
    first, first_pair = np.repeat(start[:-1], counts), np.repeat(pair_start[:-1], counts)
    by_vertex_start, by_vertex = observations_by_vertex(vertex, num_vertices)
    in_row = count_blocks(vertex, first, by_vertex_start, by_vertex, num_vertices)
    row_start = np.concatenate([[0], np.cumsum(in_row)])
    cols = np.empty(row_start[-1], dtype=np.int64)
    pair_block = np.empty(int(pair_start[-1]), dtype=np.int32)
    place_pairs(vertex, first, first_pair, by_vertex_start, by_vertex, row_start, cols, pair_block)
    rows = np.repeat(np.arange(num_vertices), in_row)
    return rows, cols, pair_block, row_start[1:] - 1
