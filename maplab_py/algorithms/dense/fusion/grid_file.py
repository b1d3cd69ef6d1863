"""The file of a grid of truncated signed distances, described in docs/map_format.md."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from maplab_py.algorithms.dense.fusion.block_kernels import BLOCK_SIDE
from maplab_py.algorithms.dense.fusion.grid import GridSettings, TsdfGrid
from maplab_py.algorithms.dense.grid_container import GridContent, GridFormat, encode_arrays
from maplab_py.array_types import F64, U64

_FORMAT = GridFormat("tsdf 1", "grid", "create_tsdf_from_depth_resource")
_SHAPE = (BLOCK_SIDE,) * 3
_WHOLE_NUMBERS = ("depth_power",)


@dataclasses.dataclass(frozen=True, eq=False)
class FusedDepth:
    """The depth resources in a grid, and the poses that they were integrated with."""

    resource_id: U64  # (K, 2)
    T_M_C: F64  # (K, 7)


@dataclasses.dataclass(frozen=True, eq=False)
class StoredGrid:
    """A grid in the frame of the mission that owns it."""

    grid: TsdfGrid
    fused: FusedDepth


def encode_grid(stored: StoredGrid) -> bytes:
    """Return the content of the file; equal grids give equal bytes."""
    grid = stored.grid.sorted()
    header = {
        **dataclasses.asdict(grid.settings),
        "blocks": grid.count,
        "depth_maps": len(stored.fused.resource_id),
    }
    fused = stored.fused
    arrays = grid.coordinates, grid.distance, grid.weight, fused.resource_id, fused.T_M_C
    return encode_arrays(_FORMAT, header, arrays)


def decode_grid(data: bytes, source: str) -> StoredGrid:
    """Read the content of a file.

    Raises:
        MapError: It is no such file, or damaged; names the source.
    """
    content = GridContent(_FORMAT, data, source)
    values: dict[str, Any] = {
        field.name: (content.count if field.name in _WHOLE_NUMBERS else content.value)(field.name)
        for field in dataclasses.fields(GridSettings)
    }
    blocks, maps = content.count("blocks"), content.count("depth_maps")
    coordinates = content.array("<i4", (blocks, 3))
    distance = content.array("<f4", (blocks, *_SHAPE))
    weight = content.array("<f4", (blocks, *_SHAPE))
    ids, poses = content.array("<u8", (maps, 2)), content.array("<f8", (maps, 7))
    grid = TsdfGrid.of(GridSettings(**values), coordinates, distance, weight)
    return StoredGrid(grid, FusedDepth(ids.astype(np.uint64), poses.astype(np.float64)))
