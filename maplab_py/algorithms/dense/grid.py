"""A grid of truncated signed distances in blocks of 8 x 8 x 8 voxels, near surfaces only."""

from __future__ import annotations

import dataclasses
import json
import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from maplab_py.algorithms.dense import grid_kernels
from maplab_py.algorithms.dense.pinhole import Pinhole
from maplab_py.array_types import F32, F64, I32, NDArray
from maplab_py.errors import MapError
from maplab_py.memory import require_memory

_FIRST_CAPACITY = 1024
_TABLE_ROWS_PER_BLOCK = 4
_BYTES_PER_BLOCK = 8 * grid_kernels.BLOCK_SIDE**3 + 12 + 16 * _TABLE_ROWS_PER_BLOCK
_STEPS_PER_BLOCK = 4
"""Blocks are allocated at pixels that are a quarter of a block apart at the largest depth ..."""
_MAX_PIXEL_STEP = 8
"""... but no further than this."""
_LIMIT = 1 << 20
"""Coordinates of blocks are smaller."""


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


class TsdfGrid:
    """Mean signed distances to the nearest surface, along the axes of the cameras that saw it.

    Distances are in units of the truncation distance and positive in free space. If all depth maps are
    allocated before the first is integrated, every block has all of them, the order does not matter, and
    each can be removed again.
    """

    def __init__(self, settings: GridSettings) -> None:
        self.settings = settings
        self.count = 0
        self._coordinates: I32 = np.zeros((0, 3), dtype=np.int32)
        shape = (0, grid_kernels.BLOCK_SIDE, grid_kernels.BLOCK_SIDE, grid_kernels.BLOCK_SIDE)
        self._distance: F32 = np.zeros(shape, dtype=np.float32)
        self._weight: F32 = np.zeros(shape, dtype=np.float32)
        self._table = np.zeros((0, 2), dtype=np.int64)

    @classmethod
    def of(cls, settings: GridSettings, coordinates: I32, distance: F32, weight: F32) -> TsdfGrid:
        """Make a grid of blocks (B, 3) with distances and weights (B, 8, 8, 8)."""
        grid = cls(settings)
        grid._reserve(len(coordinates))
        grid.count = len(coordinates)
        grid._coordinates[: grid.count] = coordinates
        grid._distance[: grid.count] = distance
        grid._weight[: grid.count] = weight
        grid_kernels.fill_table(grid.coordinates, grid._table)
        return grid

    @property
    def coordinates(self) -> I32:
        """Blocks (B, 3), in units of the block's side."""
        return self._coordinates[: self.count]

    @property
    def distance(self) -> F32:
        """Distances (B, 8, 8, 8)."""
        return self._distance[: self.count]

    @property
    def weight(self) -> F32:
        """Weights (B, 8, 8, 8), in measurements at a depth of 2 m; 0 = not observed."""
        return self._weight[: self.count]

    @property
    def nbytes(self) -> int:
        """Memory of the grid [bytes]."""
        arrays = (self._coordinates, self._distance, self._weight, self._table)
        return sum(array.nbytes for array in arrays)

    def allocate(
        self, depth: F32, pinhole: Pinhole, T_G_C: F64, *, with_free_space: bool = False
    ) -> None:
        """Make the blocks near the surface in a depth map (H, W) [m] of a camera at a pose (4, 4).

        Args:
            depth: Depths along the optical axis, 0 = unknown.
            T_G_C: Pose of the camera.
            with_free_space: Also make the blocks between the camera and the surface.

        Raises:
            NotEnoughMemory: The grid would exceed the allowed memory.
            MapError: A surface is too far from the origin for the voxel size.
        """
        s = self.settings
        block_m = grid_kernels.BLOCK_SIDE * s.voxel_size_m
        if np.abs(T_G_C[:3, 3]).max() + 2.0 * s.max_depth_m > block_m * _LIMIT:
            raise MapError(
                f"a camera is {np.abs(T_G_C[:3, 3]).max():.0f} m from the origin: the grid reaches "
                f"{block_m * _LIMIT:.0f} m; use larger voxels (--dense_tsdf_voxel_size_m)"
            )
        camera = np.array([pinhole.focal_px, *pinhole.centre_px])
        step = int(pinhole.focal_px * block_m / (_STEPS_PER_BLOCK * s.max_depth_m))
        step = min(max(step, 1), _MAX_PIXEL_STEP)
        range_m = s.min_depth_m, s.max_depth_m
        settings = np.array([block_m, s.truncation_m, *range_m, step, float(with_free_space)])
        while True:
            arguments = depth, camera, T_G_C, settings, self._table, self._coordinates
            count = (
                grid_kernels.allocate_blocks(*arguments, self.count)
                if len(self._table)
                else grid_kernels.FULL
            )
            if count != grid_kernels.FULL:
                break
            self._reserve(max(2 * len(self._coordinates), _FIRST_CAPACITY))
        self.count = count

    def integrate(self, depth: F32, pinhole: Pinhole, T_G_C: F64, *, first_block: int = 0) -> None:
        """Add a depth map to all blocks, or to those from a row on."""
        self._integrate(depth, pinhole, T_G_C, 1.0, first_block)

    def remove(self, depth: F32, pinhole: Pinhole, T_G_C: F64) -> None:
        """Take out a depth map that was integrated with the same arguments."""
        self._integrate(depth, pinhole, T_G_C, -1.0, 0)

    def mesh(self, min_weight: float, most: float = np.inf) -> Mesh:
        """Return the surface between voxels of at least this weight, and of distances up to `most`."""
        around = np.empty((self.count, grid_kernels.NEIGHBOURS), dtype=np.int32)
        grid_kernels.find_neighbours(self.coordinates, self._table, around)
        cells = np.empty(
            (self.count, grid_kernels.BLOCK_SIDE, grid_kernels.BLOCK_SIDE, grid_kernels.BLOCK_SIDE),
            dtype=np.int32,
        )
        settings = np.array([self.settings.voxel_size_m, max(min_weight, 1e-12), most])
        arguments = self.coordinates, around, self.distance, self.weight, settings, cells
        points = np.empty((grid_kernels.place_vertices(*arguments, np.empty((0, 3))), 3))
        quads = np.empty((0, 4), dtype=np.int32)
        if len(points):
            grid_kernels.place_vertices(*arguments, points)
            number = grid_kernels.join_vertices(around, self.distance, cells, quads)
            quads = np.empty((number, 4), dtype=np.int32)
        if len(quads):
            grid_kernels.join_vertices(around, self.distance, cells, quads)
        return _triangulate(points, quads)

    def sorted(self) -> TsdfGrid:
        """Return the grid with observed blocks only, in the order of their coordinates."""
        observed = np.flatnonzero((self.weight > 0.0).any(axis=(1, 2, 3)))
        order = observed[np.lexsort(self.coordinates[observed].T[::-1])]
        return TsdfGrid.of(
            self.settings, self.coordinates[order], self.distance[order], self.weight[order]
        )

    def _integrate(
        self, depth: F32, pinhole: Pinhole, T_G_C: F64, sign: float, first_block: int
    ) -> None:
        s = self.settings
        size = pinhole.width_px, pinhole.height_px
        image = np.array(
            [pinhole.focal_px, *pinhole.centre_px, *size, s.min_depth_m, s.max_depth_m]
        )
        settings = np.array(
            [s.voxel_size_m, s.truncation_m, float(s.depth_power), s.max_weight, sign]
        )
        T_C_G = np.linalg.inv(T_G_C)
        blocks = (array[first_block:] for array in (self.coordinates, self.distance, self.weight))
        grid_kernels.integrate_depth(depth, image, T_C_G, settings, *blocks)

    def _reserve(self, capacity: int) -> None:
        """Make room for so many blocks."""
        require_memory(capacity * _BYTES_PER_BLOCK, "the grid of distances")
        for name in ("_coordinates", "_distance", "_weight"):
            former = getattr(self, name)
            array = np.zeros((capacity, *former.shape[1:]), dtype=former.dtype)
            array[: self.count] = former[: self.count]
            setattr(self, name, array)
        rows = 1 << int(np.ceil(np.log2(max(_TABLE_ROWS_PER_BLOCK * capacity, 2))))
        self._table = np.full((rows, 2), -1, dtype=np.int64)
        grid_kernels.fill_table(self.coordinates, self._table)


def _triangulate(p: F64, quads: I32) -> Mesh:
    """Split quadrilaterals along the shorter diagonal; leave out vertices without a face."""
    diagonals = [np.linalg.norm(p[quads[:, k]] - p[quads[:, k + 2]], axis=1) for k in (0, 1)]
    turned = diagonals[1] < diagonals[0]
    corners = np.where(turned[:, None], np.roll(quads, -1, axis=1), quads)
    faces = corners[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)
    used = np.zeros(len(p), dtype=np.bool_)
    used[faces] = True
    number = np.cumsum(used, dtype=np.int32) - 1
    return Mesh(p[used], number[faces].astype(np.int32))


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
