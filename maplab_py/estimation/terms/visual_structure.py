"""Blocks of the reduced system that the landmarks fill, and the order of their elimination.

Eliminating a landmark with n observations touches one block for each of its n (n + 1) / 2 pairs of
observations. There are some ten times as many pairs as observations and a hundred times as many as
blocks, so they are never listed or sorted: a pair belongs to the block row of its later vertex, and
rows are walked through by the VIEWS of their vertex, the observations made from there.

Landmarks are eliminated SLAB by slab. What a landmark leaves with each of its observations (Y of
`kernels/templates/visual`) is needed by all rows that see it, so it is kept for one slab: memory is bounded,
and what a slab leaves is still in the processor's cache when the rows ask for it.
"""

from typing import NamedTuple

import numpy as np

from maplab_py.array_types import I32, I64
from maplab_py.compilation import compiled
from maplab_py.memory import require_memory
from maplab_py.vimap.table import starts_of_counts

_ABSENT = -1
_SMALL_SLAB, _MOST_SLABS = 65_536, 64
"""A slab has at least so many observations, and more where there would be too many slabs."""
_CHUNKS, _PIECES = 4, 16
_BYTES_PER_BLOCK, _BYTES_PER_OBSERVATION = 160, 100
"""Of a block of the reduced system: its place, and what analysing it takes."""


class EliminationPlan(NamedTuple):
    """Structure of the reduced system and order of the work. B blocks, S slabs of O observations.

    Landmarks of a slab are evaluated in chunks, block rows are summed up in pieces, each by one
    thread. Every chunk has separate sums, so the number of chunks is fixed; pieces share nothing.
    """

    row_start: I64  # (V + 1,) offsets of the block rows
    cols: I32  # (B,) ascending within a row; the last one is the diagonal
    slab_start: I64  # (S + 1,) landmarks
    chunk_start: I64  # (S, chunks + 1) landmarks
    first: I32  # (O,) first observation of every observation's landmark
    view_start: I64  # (S, V + 1) offsets into views
    views: I32  # (O,) observations by slab, then vertex
    piece_start: I64  # (S, pieces + 1) block rows
    largest_slab: int  # observations
    widest_row: int  # blocks

    @property
    def rows(self) -> I32:
        """Row (B,) of every block."""
        return np.repeat(
            np.arange(len(self.row_start) - 1, dtype=np.int32), np.diff(self.row_start)
        )


def elimination_plan(start: I64, vertex: I32, num_vertices: int) -> EliminationPlan:
    """Find the blocks and share out the work.

    Args:
        start: Offsets (L + 1,) of the landmarks' observations.
        vertex: Vertex (O,) of every observation, ascending within a landmark.
        num_vertices: V.
    """
    counts = np.diff(start)
    first = np.repeat(start[:-1], counts).astype(np.int32)
    slab_start = _cut_evenly(start, max(_SMALL_SLAB, -(-len(vertex) // _MOST_SLABS)))
    view_start, views = sort_views(start[slab_start], vertex, num_vertices)
    in_row = count_blocks(vertex, first, view_start, views)
    row_start = starts_of_counts(in_row)
    needed = _BYTES_PER_BLOCK * row_start[-1] + _BYTES_PER_OBSERVATION * len(vertex)
    require_memory(float(needed), "the system of normal equations")
    slabs = range(len(slab_start) - 1)
    return EliminationPlan(
        row_start=row_start,
        cols=_ascending(block_columns(vertex, first, view_start, views, row_start), row_start),
        slab_start=slab_start,
        chunk_start=np.stack([_chunks(start, *slab_start[s : s + 2]) for s in slabs]),
        first=first,
        view_start=view_start,
        views=views,
        piece_start=np.stack([_pieces(first, views, view_start[s]) for s in slabs]),
        largest_slab=int(np.diff(start[slab_start]).max(initial=0)),
        widest_row=int(in_row.max(initial=0)),
    )


def landmark_chunks(start: I64) -> I64:
    """Cut all landmarks into chunks of about as many observations: offsets (chunks + 1,)."""
    return _chunks(start, 0, len(start) - 1)


def _cut_evenly(start: I64, size: int) -> I64:
    """Cut landmarks into slabs of about so many observations: offsets (S + 1,), S at least 1."""
    count = max(1, round(float(start[-1]) / size))
    cuts = np.searchsorted(start, np.linspace(0, start[-1], count + 1)[1:-1])
    return np.concatenate([[0], cuts, [len(start) - 1]]).astype(np.int64)


def _chunks(start: I64, low: int, high: int) -> I64:
    """Cut the landmarks low .. high - 1 into chunks of about as many observations."""
    wanted = np.linspace(start[low], start[high], _CHUNKS + 1)[1:-1]
    cuts = low + np.searchsorted(start[low : high + 1], wanted)
    return np.concatenate([[low], cuts, [high]]).astype(np.int64)


def _pieces(first: I32, views: I32, view_start: I64) -> I64:
    """Cut the block rows into pieces with about as many pairs of observations of a slab."""
    slab_views = views[view_start[0] : view_start[-1]]
    work = np.concatenate([[0], np.cumsum(slab_views - first[slab_views] + 2)])
    of_rows = work[view_start - view_start[0]]
    cuts = np.searchsorted(of_rows, np.linspace(0, of_rows[-1], _PIECES + 1)[1:-1])
    return np.concatenate([[0], cuts, [len(view_start) - 1]]).astype(np.int64)


@compiled()
def sort_views(slab_start: I64, vertex: I32, num_vertices: int) -> tuple[I64, I32]:
    """Sort observations by slab, then vertex: (offsets (S, V + 1), observations (O,)).

    Args:
        slab_start: First observation of every slab, and O at the end.
        vertex: Vertex (O,) of every observation.
        num_vertices: V.
    """
    num_slabs = len(slab_start) - 1
    view_start = np.zeros((num_slabs, num_vertices + 1), np.int64)
    views = np.empty(len(vertex), np.int32)
    free = np.empty(num_vertices, np.int64)
    for slab in range(num_slabs):
        for o in range(slab_start[slab], slab_start[slab + 1]):
            view_start[slab, vertex[o] + 1] += 1
        view_start[slab, 0] = slab_start[slab]
        for v in range(num_vertices):
            free[v] = view_start[slab, v]
            view_start[slab, v + 1] += view_start[slab, v]
        for o in range(slab_start[slab], slab_start[slab + 1]):
            views[free[vertex[o]]] = o
            free[vertex[o]] += 1
    return view_start, views


@compiled()
def count_blocks(vertex: I32, first: I32, view_start: I64, views: I32) -> I64:
    """Return the number of blocks (V,) in each block row: the diagonal, and lower ones in use."""
    num_slabs, num_vertices = view_start.shape[0], view_start.shape[1] - 1
    count = np.ones(num_vertices, np.int64)
    last_row = np.full(num_vertices, _ABSENT, np.int64)  # the row in which a column was met last
    for row in range(num_vertices):
        last_row[row] = row
        for slab in range(num_slabs):
            for view in views[view_start[slab, row] : view_start[slab, row + 1]]:
                for col in vertex[first[view] : view]:
                    if last_row[col] != row:
                        last_row[col] = row
                        count[row] += 1
    return count


@compiled()
def block_columns(vertex: I32, first: I32, view_start: I64, views: I32, row_start: I64) -> I32:
    """Return the column (B,) of every block, for offsets of the rows."""
    num_slabs, num_vertices = view_start.shape[0], view_start.shape[1] - 1
    cols = np.empty(row_start[num_vertices], np.int32)
    last_row = np.full(num_vertices, _ABSENT, np.int64)
    for row in range(num_vertices):
        last_row[row] = row
        met = row_start[row]
        cols[met] = row
        for slab in range(num_slabs):
            for view in views[view_start[slab, row] : view_start[slab, row + 1]]:
                for col in vertex[first[view] : view]:
                    if last_row[col] != row:
                        last_row[col] = row
                        met += 1
                        cols[met] = col
    return cols


def _ascending(cols: I32, row_start: I64) -> I32:
    """Sort the columns (B,) within every row; numpy's sort need not be compiled with the kernels."""
    counts = np.diff(row_start)
    base = np.repeat(np.arange(len(counts)) * len(counts), counts)
    keys = cols + base
    keys.sort()
    return (keys - base).astype(np.int32)
