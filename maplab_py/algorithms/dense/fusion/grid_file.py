"""The file of a grid of distances: a container of this project, described in docs/map_format.md.

A line of text names the format, a line of JSON has the settings and the number of rows of each array;
the arrays follow, little-endian, in the order of the header.
"""

from __future__ import annotations

import dataclasses
import json
import zlib
from typing import Any

import numpy as np

from maplab_py.algorithms.dense.fusion.block_kernels import BLOCK_SIDE
from maplab_py.algorithms.dense.fusion.grid import GridSettings, TsdfGrid
from maplab_py.array_types import F64, U64
from maplab_py.errors import MapError

_MAGIC = b"maplab-py tsdf 1\n"
_MAX_HEADER_BYTES = 100_000
_SHAPE = (BLOCK_SIDE,) * 3


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
    arrays = [
        grid.coordinates.astype("<i4"),
        grid.distance.astype("<f4"),
        grid.weight.astype("<f4"),
        stored.fused.resource_id.astype("<u8"),
        stored.fused.T_M_C.astype("<f8"),
    ]
    body = b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)
    header = {
        **dataclasses.asdict(grid.settings),
        "blocks": grid.count,
        "depth_maps": len(stored.fused.resource_id),
        "crc32": zlib.crc32(body),
    }
    return _MAGIC + json.dumps(header, sort_keys=True).encode() + b"\n" + body


def decode_grid(data: bytes, source: str) -> StoredGrid:
    """Read the content of a file.

    Raises:
        MapError: It is no such file, or damaged; names the source.
    """
    if not data.startswith(_MAGIC):
        raise MapError(
            f"{source}: it is no grid of maplab-py (C++ maplab's are not read): fuse the depth again "
            "by create_tsdf_from_depth_resource --overwrite"
        )
    end = data.find(b"\n", len(_MAGIC), _MAX_HEADER_BYTES)
    try:
        header = json.loads(data[len(_MAGIC) : end])
        settings = GridSettings(
            **{field.name: header[field.name] for field in dataclasses.fields(GridSettings)}
        )
        blocks, maps = int(header["blocks"]), int(header["depth_maps"])
        checksum = int(header["crc32"])
    except (ValueError, KeyError, TypeError, RecursionError):
        raise MapError(
            f"{source}: the header of the grid is damaged; fuse the depth again"
        ) from None
    body = memoryview(data)[end + 1 :]
    if zlib.crc32(body) != checksum or min(blocks, maps) < 0:
        raise MapError(f"{source}: the grid is damaged or ends early; fuse the depth again")
    parts: list[Any] = []
    for kind, shape in (
        ("<i4", (blocks, 3)),
        ("<f4", (blocks, *_SHAPE)),
        ("<f4", (blocks, *_SHAPE)),
        ("<u8", (maps, 2)),
        ("<f8", (maps, 7)),
    ):
        size = int(np.prod(shape)) * np.dtype(kind).itemsize
        if size > len(body):
            raise MapError(f"{source}: the grid ends early; fuse the depth again")
        parts.append(np.frombuffer(body[:size], dtype=kind).reshape(shape))
        body = body[size:]
    coordinates, distance, weight, ids, poses = parts
    grid = TsdfGrid.of(settings, coordinates, distance, weight)
    return StoredGrid(grid, FusedDepth(ids.astype(np.uint64), poses.astype(np.float64)))
