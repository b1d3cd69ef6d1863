"""Surfaces that appeared in space that was free, and those where space is free now."""

from pathlib import Path

import numpy as np

from maplab_py.algorithms.dense import field, fusion, meshing
from maplab_py.algorithms.dense.grid import Mesh
from maplab_py.array_types import F64, I64, Mask
from maplab_py.geometry import se3
from maplab_py.vimap import VIMap, resources_of

_FREE_VOXELS = 1.5
"""Distance from all surfaces at which space was surely free: those of two sessions differ by a voxel."""
_NO_STEP = 0.99
"""Distance, as a share of the truncation, that no voxel beside a surface has: where free space and the inside
of an object meet at once, the object only hides what is behind it."""
_MIN_AREA_M2 = 0.02
"""Area of a connected surface that is shown."""


def changed_surfaces(before: tuple[VIMap, Path], after: tuple[VIMap, Path]) -> tuple[Mesh, Mesh]:
    """Return the surfaces that appeared, and those that vanished, in G.

    Args:
        before: Map with grids and distance fields, and its folder.
        after: Another one in the same frame G.

    Raises:
        UserError: A map has no grid, or no distance field.
        MapError: A file is missing or damaged.
        EstimationError: A grid has no surface of this weight.
    """
    meshes = [meshing.map_mesh(*state, most=_NO_STEP)[0] for state in (before, after)]
    appeared = _large_parts(meshes[1], _is_free(*before, meshes[1].p))
    return appeared, _large_parts(meshes[0], _is_free(*after, meshes[0].p))


def has_voxels(vi_map: VIMap) -> bool:
    """Return whether a map has grids and distance fields."""
    return all(resources_of(vi_map, (kind,)).any() for kind in (fusion.GRID_TYPE, field.FIELD_TYPE))


def _is_free(vi_map: VIMap, folder: Path, p_G: F64) -> Mask:
    """Return which points (N, 3) lie in space that a map has seen to be free."""
    is_free: Mask = np.zeros(len(p_G), dtype=np.bool_)
    is_near = is_free.copy()
    for mission, distances in field.load_fields(vi_map, folder):
        distance_m = distances.at(se3.transform(se3.inverse(vi_map.T_G_M[mission]), p_G))
        limit_m = min(_FREE_VOXELS * distances.voxel_size_m, 0.9 * distances.max_distance_m)
        is_free |= distance_m > limit_m
        is_near |= distance_m <= limit_m
    return is_free & ~is_near


def _large_parts(mesh: Mesh, is_kept: Mask) -> Mesh:
    """Return the triangles with kept corners (N,) that are connected to a surface of some size."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    faces = mesh.faces[is_kept[mesh.faces].all(axis=1)]
    ends = np.concatenate([faces[:, :2], faces[:, 1:]])
    links = coo_matrix((np.ones(len(ends)), ends.T), shape=(len(mesh.p), len(mesh.p)))
    _, part = connected_components(links, directed=False)
    a, b, c = (mesh.p[faces[:, corner]] for corner in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    part_of = part[faces[:, 0]]
    faces = faces[np.bincount(part_of, area, minlength=len(mesh.p))[part_of] >= _MIN_AREA_M2]
    corners, index = np.unique(faces, return_inverse=True)
    rows: I64 = index.reshape(-1, 3)
    return Mesh(mesh.p[corners], rows.astype(np.int32))
