"""Meshes to show: of the grids of a map, or of a file."""

from __future__ import annotations

from pathlib import Path

from maplab_py.algorithms.dense.fusion.mesh_colours import vertex_colours
from maplab_py.algorithms.dense.fusion.meshing import map_mesh
from maplab_py.array_types import I64
from maplab_py.errors import MapError, UserError
from maplab_py.input_files import DEFAULT_MAX_BYTES, read_bytes
from maplab_py.interop.ply import parse_ply
from maplab_py.progress import SILENT, Progress
from maplab_py.viewer.layers.clouds import Cloud
from maplab_py.vimap import VIMap


def grid_mesh(
    vi_map: VIMap,
    map_folder: Path,
    missions: I64 | None,
    min_weight: float,
    *,
    with_colours: bool = False,
    progress: Progress = SILENT,
) -> Cloud:
    """Return the mesh of the grids of missions (rows, None = all), in G; see `vertex_colours`.

    Raises:
        UserError: There is no grid, or colours are wanted and no frame has image and depth map.
        MapError: A file is missing or damaged.
        EstimationError: The grids have no surface of this weight.
    """
    mesh, _ = map_mesh(vi_map, map_folder, missions, min_weight)
    colours = None
    if with_colours:
        colours = vertex_colours(vi_map, map_folder, mesh.p, missions, progress=progress)
    return Cloud("Mesh", mesh.p, colours, faces=mesh.faces)


def read_mesh(path: Path) -> Cloud:
    """Return the mesh of a PLY file, in G.

    Raises:
        UserError: The file cannot be read, or has no triangles.
        MapError: It is no PLY file, or damaged.
    """
    try:
        data = read_bytes(path, DEFAULT_MAX_BYTES, remedy="reduce the mesh", error=MapError)
    except OSError as error:
        raise UserError(f"--mesh_file={path} cannot be read ({error.strerror})") from error
    content = parse_ply(data, str(path))
    if content.faces is None or not len(content.faces):
        raise UserError(f"--mesh_file={path} has no triangles: give a mesh")
    if content.faces.min() < 0 or content.faces.max() >= len(content.p):
        raise MapError(f"{path}: a triangle refers to a vertex that is not there")
    return Cloud(path.name, content.p, content.colours, faces=content.faces)
