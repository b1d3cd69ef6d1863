"""Resources of missions, sensors and frames."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maplab_py.array_types import I64, Mask
from maplab_py.vimap.tables import ResourceOwner
from maplab_py.vimap.vi_map import VIMap


def resource_missions(vi_map: VIMap) -> I64:
    """Return the mission (row) of every resource (R,), -1 where it belongs to none."""
    table = vi_map.resources
    missions = np.where(table.owner_kind == ResourceOwner.NONE, -1, table.owner).astype(np.int64)
    of_frames = np.flatnonzero(table.owner_kind == ResourceOwner.FRAME)
    vertices = vi_map.frames.vertex[table.owner[of_frames]]
    missions[of_frames] = vi_map.vertices.mission[vertices]
    return missions


def resources_of(
    vi_map: VIMap, kinds: tuple[int, ...] | None = None, missions: NDArray[np.int64] | None = None
) -> Mask:
    """Return which resources (R,) are of some types and missions (rows); None = all."""
    table = vi_map.resources
    chosen = np.ones(len(table), dtype=np.bool_)
    if kinds is not None:
        chosen &= np.isin(table.type, kinds)
    if missions is not None:
        chosen &= np.isin(resource_missions(vi_map), missions)
    return chosen


def without_resources(vi_map: VIMap, removed: Mask) -> VIMap:
    """Return the map without some resources (R,); their files stay where they are."""
    return vi_map.replace(resources=vi_map.resources.take(~removed))
