"""The file of a Euclidean distance field, described in docs/map_format.md."""

from __future__ import annotations

from maplab_py.algorithms.dense.distance.field import DistanceField
from maplab_py.algorithms.dense.fusion.block_kernels import BLOCK_SIDE
from maplab_py.algorithms.dense.grid_container import GridContent, GridFormat, encode_arrays

_FORMAT = GridFormat("esdf 1", "distance field", "create_esdf_from_depth_resource")


def encode_field(field: DistanceField) -> bytes:
    """Return the content of the file; equal fields give equal bytes."""
    header = {
        "voxel_size_m": field.voxel_size_m,
        "max_distance_m": field.max_distance_m,
        "blocks": len(field.coordinates),
    }
    return encode_arrays(_FORMAT, header, (field.coordinates, field.distance_m))


def decode_field(data: bytes, source: str) -> DistanceField:
    """Read the content of a file.

    Raises:
        MapError: It is no such file, or damaged; names the source.
    """
    content = GridContent(_FORMAT, data, source)
    blocks = content.count("blocks")
    return DistanceField(
        float(content.value("voxel_size_m")),
        float(content.value("max_distance_m")),
        content.array("<i4", (blocks, 3)),
        content.array("<f4", (blocks, *(BLOCK_SIDE,) * 3)),
    )
