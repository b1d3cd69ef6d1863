"""Horizontal slices through the distance fields of a map."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from maplab_py.algorithms.dense.distance.fields import known_voxels, load_fields
from maplab_py.array_types import I64
from maplab_py.errors import UserError
from maplab_py.viewer import colours
from maplab_py.viewer.layers.clouds import Cloud
from maplab_py.viewer.scene import LegendEntry
from maplab_py.vimap import VIMap


def field_slice(
    vi_map: VIMap, map_folder: Path, missions: I64 | None, height_m: float | None
) -> Cloud:
    """Return the voxels at a height in G, coloured by their distances.

    Args:
        vi_map: Map.
        map_folder: Its folder.
        missions: Rows of missions; None = all.
        height_m: Height; None = the median of the vertices.

    Raises:
        UserError: There is no distance field, or none of its voxels is at this height.
        MapError: A file is missing or damaged.
    """
    fields = load_fields(vi_map, map_folder, missions)
    p_G, distance_m = known_voxels(vi_map, fields)
    z = float(np.median(vi_map.T_G_I[:, 6])) if height_m is None else height_m
    # a layer of voxels is as thick as a voxel; in a tilted field some voxels more are in it
    half_m = 0.5 * max(field.voxel_size_m for _, field in fields) + 1e-9
    rows = np.flatnonzero(np.abs(p_G[:, 2] - z) <= half_m)
    if not len(rows):
        low, high = p_G[:, 2].min(), p_G[:, 2].max()
        raise UserError(
            f"--dense_esdf_slice_height_m={z:.2f}: the distance field has voxels from {low:.2f} m to "
            f"{high:.2f} m"
        )
    near, far = float(distance_m[rows].min()), float(distance_m[rows].max())
    part = (distance_m[rows] - near) / max(far - near, 1e-9)
    stops = colours.SEQUENTIAL[::-1]
    legend = LegendEntry(
        "distance", tuple(colours.hex_codes(stops)), f"{near:.3g} m", f"{far:.3g} m"
    )
    return Cloud("Distance field", p_G[rows], colours.ramp(part, stops), legend=(legend,))
