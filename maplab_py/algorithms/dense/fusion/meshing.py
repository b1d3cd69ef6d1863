"""The mesh of the grids of a map."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from maplab_py.algorithms.dense.fusion.fusion import load_grids
from maplab_py.algorithms.dense.fusion.grid import Mesh
from maplab_py.algorithms.dense.fusion.mesh_colours import vertex_colours
from maplab_py.algorithms.dense.fusion.options import MESH_MIN_WEIGHT
from maplab_py.array_types import I64
from maplab_py.errors import EstimationError
from maplab_py.geometry import se3
from maplab_py.interop.mesh_files import write_mesh
from maplab_py.progress import SILENT, Progress
from maplab_py.report import Report
from maplab_py.vimap import VIMap


@dataclasses.dataclass(frozen=True)
class MeshReport(Report):
    """A mesh that was written."""

    file: Path
    grids: int
    vertices: int
    triangles: int


def map_mesh(
    vi_map: VIMap,
    map_folder: Path,
    missions: I64 | None = None,
    min_weight: float = MESH_MIN_WEIGHT,
) -> tuple[Mesh, int]:
    """Return the surface of the grids of missions in G, and the number of grids.

    Args:
        vi_map: Map.
        map_folder: Its folder.
        missions: Rows of missions; None = all.
        min_weight: Weight from which voxels count as observed.

    Raises:
        UserError: There is no grid.
        MapError: A file is missing or damaged.
        EstimationError: The grids have no surface of this weight.
    """
    grids = load_grids(vi_map, map_folder, missions)
    points, faces, count = [], [], 0
    for mission, stored in grids:
        mesh = stored.grid.mesh(min_weight)
        points.append(se3.transform(vi_map.T_G_M[mission], mesh.p))
        faces.append(mesh.faces + np.int32(count))
        count += len(mesh.p)
    if count == 0:
        raise EstimationError(
            f"the grid has no surface of weight {min_weight:g}: lower --dense_tsdf_mesh_min_weight"
        )
    return Mesh(np.concatenate(points), np.concatenate(faces)), len(grids)


def write_map_mesh(
    vi_map: VIMap,
    map_folder: Path,
    file: Path,
    missions: I64 | None = None,
    min_weight: float = MESH_MIN_WEIGHT,
    *,
    with_colours: bool = False,
    overwrite: bool = False,
    progress: Progress = SILENT,
) -> MeshReport:
    """Write the surface of the grids of missions to a file; see `map_mesh` and `vertex_colours`.

    Raises:
        UserError: The file cannot be written, or its suffix is of no mesh format.
    """
    mesh, grids = map_mesh(vi_map, map_folder, missions, min_weight)
    colours = None
    if with_colours:
        colours = vertex_colours(vi_map, map_folder, mesh.p, missions, progress=progress)
    write_mesh(mesh.p, mesh.faces, file, colours, overwrite=overwrite)
    return MeshReport(file, grids, len(mesh.p), len(mesh.faces))
