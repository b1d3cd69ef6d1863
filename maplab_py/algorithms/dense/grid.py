"""A grid of truncated signed distances in blocks of 8 x 8 x 8 voxels, near surfaces only."""

from __future__ import annotations

import dataclasses
import json
import zlib
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from maplab_py.algorithms.dense import grid_kernels
from maplab_py.algorithms.dense.grid_kernels import BLOCK_SIDE, KEY_BITS, LIMIT
from maplab_py.algorithms.dense.pinhole import Pinhole
from maplab_py.array_types import F32, F64, I32, I64, Mask, NDArray
from maplab_py.errors import MapError
from maplab_py.memory import require_memory

BLOCK_SHAPE = (BLOCK_SIDE,) * 3
_BYTES_PER_BLOCK = 8 * BLOCK_SIDE**3 + 12
_STEPS_PER_BLOCK = 4
"""Blocks are taken at pixels that are a quarter of a block apart at the largest depth ..."""
_MAX_PIXEL_STEP = 8
"""... but no further than this."""
_MOST_BLOCKS = 1_000_000
"""Blocks of a depth map, 4 GB of voxels, that are looked for at first."""
_BLOCKS_AT_A_TIME = 2048
"""Blocks whose voxels are meshed at a time."""
_CORNERS = np.array([[m & 1, m >> 1 & 1, m >> 2] for m in range(8)])
"""Offsets of the corners of a cell."""
_EDGES = [(m, m + (1 << axis)) for axis in range(3) for m in range(8) if not m >> axis & 1]
"""Edges of a cell between its corners."""
_AROUND_EDGE = np.ones((3, 4, 4), dtype=np.int64)
"""Offsets in a bordered block of the four cells around a cell's first edge along x, y and z."""
_AROUND_EDGE[..., 0] = 0
for _axis in range(3):
    _AROUND_EDGE[_axis, [1, 2], 1 + (_axis + 1) % 3] = 0
    _AROUND_EDGE[_axis, [2, 3], 1 + (_axis + 2) % 3] = 0


@dataclasses.dataclass(frozen=True)
class GridSettings:
    """Settings on which the numbers of a grid depend."""

    voxel_size_m: float
    truncation_m: float
    min_depth_m: float
    max_depth_m: float
    depth_power: int  # the weight of a measurement falls with this power of its depth
    max_weight: float


@dataclasses.dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles; corners run anticlockwise as seen from the free side."""

    p: F64  # (N, 3) [m]
    faces: I32  # (F, 3)


View = tuple[F32, Pinhole, F64]
"""Depths (H, W) [m] along the optical axis of a camera, 0 = unknown; the camera and its pose (4, 4)."""


def blocks_of_views(
    views: Iterable[View], settings: GridSettings, *, with_free_space: bool = False
) -> I32:
    """Return the blocks (B, 3) near the surfaces in depth maps, in the order of their coordinates.

    Args:
        with_free_space: Also those between the cameras and the surfaces.

    Raises:
        NotEnoughMemory: A grid of them would exceed the allowed memory.
        MapError: A surface is too far from the origin for the voxel size.
    """
    block_m, keys = BLOCK_SIDE * settings.voxel_size_m, np.empty(0, dtype=np.int64)
    for depth, pinhole, T_G_C in views:
        from_origin_m = float(np.abs(T_G_C[:3, 3]).max())
        if from_origin_m + 2.0 * settings.max_depth_m > block_m * LIMIT:
            raise MapError(
                f"a camera is {from_origin_m:.0f} m from the origin: the grid reaches "
                f"{block_m * LIMIT:.0f} m; use larger voxels (--dense_tsdf_voxel_size_m)"
            )
        camera = np.array([pinhole.focal_px, *pinhole.centre_px])
        step = int(pinhole.focal_px * block_m / (_STEPS_PER_BLOCK * settings.max_depth_m))
        step = min(max(step, 1), _MAX_PIXEL_STEP)
        range_m = settings.min_depth_m, settings.max_depth_m
        numbers = [block_m, settings.truncation_m, *range_m, step, with_free_space, _MOST_BLOCKS]
        while True:  # more blocks are looked for only if those so far have room
            touched = grid_kernels.keys_of_depth(depth, camera, T_G_C, np.array(numbers, float))
            together = np.union1d(keys, touched)
            require_memory(len(together) * _BYTES_PER_BLOCK, "the grid of distances")
            if len(touched) < numbers[-1]:
                break
            numbers[-1] *= 4
        keys = together
    parts = (keys >> KEY_BITS * place & (2 * LIMIT - 1) for place in (2, 1, 0))
    return np.stack([part - LIMIT for part in parts], axis=1).astype(np.int32)


def rows_in(blocks: I32, wanted: I32 | I64) -> I64:
    """Return the rows (N,) of wanted blocks (N, 3) in sorted blocks (B, 3), -1 = not there."""
    if not len(blocks):
        return np.full(len(wanted), -1, dtype=np.int64)
    low = blocks.min(axis=0).astype(np.int64) - 1
    size = blocks.max(axis=0).astype(np.int64) - low + 2
    keys, queries = (
        np.ravel_multi_index(tuple(np.clip(c - low, 0, size - 1).T), tuple(size))
        for c in (blocks, wanted)
    )
    place = np.minimum(np.searchsorted(keys, queries), len(keys) - 1)
    return np.where(keys[place] == queries, place, -1)


@dataclasses.dataclass(frozen=True, eq=False)
class TsdfGrid:
    """Mean signed distances to the nearest surface, along the axes of the cameras that saw it.

    Distances are in units of the truncation distance and positive in free space. If every block has all
    depth maps, their order does not matter, and each can be removed again.
    """

    settings: GridSettings
    coordinates: I32  # (B, 3) blocks, sorted, in units of the block's side
    distance: F32  # (B, 8, 8, 8)
    weight: F32  # (B, 8, 8, 8) in measurements at a depth of 2 m; 0 = not observed

    @classmethod
    def unobserved(cls, settings: GridSettings, coordinates: I32) -> TsdfGrid:
        """Make a grid of sorted blocks (B, 3) that no depth map has been added to."""
        voxels = np.zeros((len(coordinates), *BLOCK_SHAPE), dtype=np.float32)
        return cls(settings, coordinates, voxels, voxels.copy())

    @property
    def nbytes(self) -> int:
        """Memory of the grid [bytes]."""
        return self.coordinates.nbytes + self.distance.nbytes + self.weight.nbytes

    def integrate(self, depth: F32, pinhole: Pinhole, T_G_C: F64, *, sign: float = 1.0) -> None:
        """Add a depth map; with the sign -1, take it out if it was added with the same arguments."""
        s = self.settings
        size = pinhole.width_px, pinhole.height_px
        image = [pinhole.focal_px, *pinhole.centre_px, *size, s.min_depth_m, s.max_depth_m]
        settings = [s.voxel_size_m, s.truncation_m, float(s.depth_power), s.max_weight, sign]
        voxels = self.coordinates, self.distance, self.weight
        T_C_G = np.linalg.inv(T_G_C)
        grid_kernels.integrate_depth(depth, np.array(image), T_C_G, np.array(settings), *voxels)

    def chosen(self, rows: I64) -> TsdfGrid:
        """Return the grid of some of its blocks (rows)."""
        return TsdfGrid(
            self.settings, self.coordinates[rows], self.distance[rows], self.weight[rows]
        )

    def joined(self, other: TsdfGrid) -> TsdfGrid:
        """Return the grid with the blocks of another one, none of which it has."""
        coordinates = np.concatenate([self.coordinates, other.coordinates])
        distance = np.concatenate([self.distance, other.distance])
        weight = np.concatenate([self.weight, other.weight])
        joined = TsdfGrid(self.settings, coordinates, distance, weight)
        return joined.chosen(np.lexsort(coordinates.T[::-1]))

    def mesh(self, min_weight: float, most: float = np.inf) -> Mesh:
        """Return the surface between voxels of at least this weight, and of distances up to `most`.

        A cell lies between eight voxel centres. It counts only if all eight have been observed; otherwise
        the rim of the truncation band would become a false surface. Its vertex is the mean of the crossings
        on its twelve edges. An edge between two voxels of different sign joins the vertices of the four
        cells around it to a quadrilateral.
        Source: Gibson, Constrained elastic surface nets, MICCAI 1998.
        """
        count, enough = len(self.coordinates), np.float64(max(min_weight, 1e-12))
        parts = [slice(k, k + _BLOCKS_AT_A_TIME) for k in range(0, count, _BLOCKS_AT_A_TIME)]
        number = np.full((count, *BLOCK_SHAPE), -1, dtype=np.int32)
        before, after = (
            np.stack([rows_in(self.coordinates, self.coordinates + step * o) for o in _CORNERS])
            for step in (-1, 1)
        )
        points, cells, signs = [np.empty((0, 3))], [], []
        for part in parts:
            weight = _with_border(self.weight, after[:, part], 1, 0.0)
            distance = _with_border(self.distance, after[:, part], 1, 0.0)
            cell, corner = _crossed_cells(np.where(weight >= enough, distance, np.nan), most)
            voxel = BLOCK_SIDE * self.coordinates[part][cell[:, 0]] + cell[:, 1:]
            first = sum(map(len, points))
            number[part][tuple(cell.T)] = np.arange(first, first + len(cell))
            points.append((voxel + 0.5 + _crossing(corner)) * self.settings.voxel_size_m)
            cells.append(cell)
            signs.append(corner[:, [0, 1, 2, 4]] < 0.0)
        quads = [np.empty((0, 4), dtype=np.int32)]
        for part, cell, is_negative in zip(parts, cells, signs, strict=True):
            border = _with_border(number, before[:, part], -1, -1)
            quads.append(_quads(border, cell, is_negative))
        return _triangulate(np.concatenate(points), np.concatenate(quads))


def _with_border(voxels: Any, rows: I64, step: int, fill: float) -> Any:
    """Return the voxels (b, 9, 9, 9) of blocks and of the next ones along x, y and z.

    Args:
        voxels: Values (B, 8, 8, 8).
        rows: Rows (8, b) of the blocks and of those beside them, at the offsets `_CORNERS`; -1 = none.
        step: 1 for the next blocks, -1 for the ones before.
        fill: Value of voxels of blocks that are not there.
    """
    inner, beyond, beside = (slice(8), 8, 0) if step > 0 else (slice(1, 9), 0, 7)
    result = np.full((rows.shape[1], *(BLOCK_SIDE + 1,) * 3), fill, dtype=voxels.dtype)
    for offset, row in zip(_CORNERS.tolist(), rows, strict=True):
        there = np.flatnonzero(row >= 0)
        to = tuple(beyond if shift else inner for shift in offset)
        of = tuple(beside if shift else slice(None) for shift in offset)
        result[(there, *to)] = voxels[(row[there], *of)]
    return result


def _crossed_cells(values: F32, most: float) -> tuple[I64, F32]:
    """Return the cells (N, 4) that the surface passes, block and place in it, and their corners (N, 8).

    Args:
        values: Distances (b, 9, 9, 9), NaN = unobserved.
        most: Largest distance of a voxel beside a surface.
    """
    corners = np.stack(
        [values[:, x : x + 8, y : y + 8, z : z + 8] for x, y, z in _CORNERS], axis=-1
    )
    is_observed = (corners <= np.float64(most)).all(axis=-1)
    negative = np.count_nonzero(corners < 0.0, axis=-1)
    crossed = is_observed & (negative > 0) & (negative < 8)
    return np.argwhere(crossed), corners[crossed]


def _crossing(corner: F32) -> F64:
    """Return the means (N, 3) of the surface's crossings of the edges of cells of side 1."""
    total, count = np.zeros((len(corner), 3)), np.zeros((len(corner), 1))
    for a, b in _EDGES:
        rows = np.flatnonzero((corner[:, a] < 0.0) != (corner[:, b] < 0.0))
        share = corner[rows, a] / (corner[rows, a] - corner[rows, b])
        total[rows] += _CORNERS[a] + share[:, None] * (_CORNERS[b] - _CORNERS[a])
        count[rows] += 1.0
    return total / count


def _quads(number: I32, cell: I64, is_negative: Mask) -> I32:
    """Join the vertices around every edge from a cell's first corner that the surface crosses.

    Corners run anticlockwise as seen from the side of positive distances.

    Args:
        number: Vertices (b, 9, 9, 9) of the cells of blocks and of those before, -1 = none.
        cell: Cells (N, 4), see `_crossed_cells`.
        is_negative: Signs (N, 4) at the first corner and the next ones along x, y and z.
    """
    around = [number[tuple((cell + offset).T)] for offset in _AROUND_EDGE.reshape(-1, 4)]
    corners = np.stack(around, axis=-1).reshape(-1, 3, 4)
    crossed = is_negative[:, 1:] != is_negative[:, :1]
    crossed &= (corners >= 0).all(axis=2)
    quads = np.where(is_negative[:, :1, None], corners, corners[:, :, ::-1])
    return np.asarray(quads[crossed], dtype=np.int32)


def _triangulate(p: F64, quads: I32) -> Mesh:
    """Split quadrilaterals along the shorter diagonal; leave out vertices without a face."""
    diagonals = [np.linalg.norm(p[quads[:, k]] - p[quads[:, k + 2]], axis=1) for k in (0, 1)]
    turned = diagonals[1] < diagonals[0]
    corners = np.where(turned[:, None], np.roll(quads, -1, axis=1), quads)
    faces = corners[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)
    used, faces = np.unique(faces, return_inverse=True)
    return Mesh(p[used], faces.reshape(-1, 3).astype(np.int32))


# The container of grids in resource files, described in docs/map_format.md.
#
# A line of text names the format, a line of JSON has the settings and the number of rows of each array;
# the arrays follow, little-endian, in the order of the header.


_MAX_HEADER_BYTES = 100_000


@dataclasses.dataclass(frozen=True)
class GridFormat:
    """One kind of grid."""

    name: str  # in the first line, with its version
    noun: str  # in messages
    command: str  # that makes one

    @property
    def first_line(self) -> bytes:
        """Return the line that a file begins with."""
        return f"maplab-py {self.name}\n".encode()


def encode_arrays(
    kind: GridFormat, header: dict[str, Any], arrays: Sequence[NDArray[Any]]
) -> bytes:
    """Return the content of a file; equal arguments give equal bytes."""
    body = b"".join(
        np.ascontiguousarray(array, array.dtype.newbyteorder("<")).tobytes() for array in arrays
    )
    header = {**header, "crc32": zlib.crc32(body)}
    return kind.first_line + json.dumps(header, sort_keys=True).encode() + b"\n" + body


class GridContent:
    """The content of a file."""

    def __init__(self, kind: GridFormat, data: bytes, source: str) -> None:
        """Read the header and check the arrays.

        Raises:
            MapError: It is no such file, or damaged; names the source.
        """
        self._source, self._kind = source, kind
        start = len(kind.first_line)
        if not data.startswith(kind.first_line):
            raise MapError(
                f"{source}: it is no {kind.noun} of maplab-py (C++ maplab's are not read): make it "
                f"again by {kind.command} --overwrite"
            )
        end = data.find(b"\n", start, _MAX_HEADER_BYTES)
        try:
            self._header = json.loads(data[start:end])
            checksum = self.count("crc32")
        except (ValueError, TypeError, RecursionError):
            raise self._damaged(f"the header of the {kind.noun} is damaged") from None
        self._body = memoryview(data)[end + 1 :]
        if zlib.crc32(self._body) != checksum:
            raise self._damaged(f"the {kind.noun} is damaged or ends early")

    def count(self, name: str) -> int:
        """Return a whole number of the header, 0 or greater; see `value`."""
        number = self.value(name)
        if not isinstance(number, int) or number < 0:
            raise self._damaged(f"the header of the {self._kind.noun} is damaged")
        return number

    def value(self, name: str) -> float:
        """Return a number of the header.

        Raises:
            MapError: There is none of this name.
        """
        number = self._header.get(name) if isinstance(self._header, dict) else None
        if not isinstance(number, int | float):
            raise self._damaged(f"the header of the {self._kind.noun} is damaged")
        return number

    def array(self, kind: str, shape: tuple[int, ...]) -> NDArray[Any]:
        """Return the next array, of a numpy type such as "<f4".

        Raises:
            MapError: The file ends before.
        """
        size = int(np.prod(shape, dtype=object)) * np.dtype(kind).itemsize
        if size > len(self._body):
            raise self._damaged(f"the {self._kind.noun} ends early")
        part, self._body = self._body[:size], self._body[size:]
        return np.frombuffer(part, dtype=kind).reshape(shape)

    def _damaged(self, what: str) -> MapError:
        return MapError(f"{self._source}: {what}; make it again by {self._kind.command}")
