"""Meshes to show: of the grids of a map, or of a file, and their colours."""

import dataclasses
from pathlib import Path

import numpy as np

from maplab_py.algorithms.dense import meshing, triangle_tree
from maplab_py.algorithms.dense.field import known_voxels, load_fields
from maplab_py.array_types import F64, I64, U8
from maplab_py.errors import UserError
from maplab_py.interop import mesh_files
from maplab_py.progress import SILENT, Progress
from maplab_py.viewer import colours, options, scene
from maplab_py.viewer.layers.clouds import Cloud
from maplab_py.vimap import VIMap

_USUAL_PART = 95.0
"""Percentile of the distances that has the last colour."""


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
    mesh, _ = meshing.map_mesh(vi_map, map_folder, missions, min_weight)
    colours = None
    if with_colours:
        colours = meshing.vertex_colours(vi_map, map_folder, mesh.p, missions, progress=progress)
    return Cloud("Mesh", mesh.p, colours, faces=mesh.faces)


def coloured_mesh(
    mesh: Cloud, colouring: options.MeshColouring, reference: Cloud | None = None
) -> Cloud:
    """Return a mesh in the colours that a rule gives it.

    Args:
        colouring: "shaded" is one colour, "colour" those of the mesh, "height" by z, "distance" by the
            distance of every vertex from the reference; "auto" is the distance with a reference, else the
            mesh's colours if it has some, else one colour.
        reference: Another mesh.

    Raises:
        UserError: The mesh has no colours, or there is no reference, although the rule needs them.
    """
    if colouring == "distance" or (colouring == "auto" and reference is not None):
        if reference is None or reference.faces is None:
            raise UserError("--mesh_colouring=distance needs another mesh: --mesh_reference_file")
        distance = triangle_tree.TriangleTree(reference.p_G, reference.faces).distances(mesh.p_G)
        largest = max(float(np.percentile(distance, _USUAL_PART)), 1e-9)
        low, high = "0 m", f"{largest:.3g} m"
        return _ramp(mesh, distance / largest, colours.HEAT, "distance", low, high)
    if colouring == "height":
        part, low_m, high_m = colours.normalised(mesh.p_G[:, 2])
        low, high = f"{low_m:.3g} m", f"{high_m:.3g} m"
        return _ramp(mesh, part, colours.SEQUENTIAL, "height", low, high)
    if colouring == "colour" and mesh.colours is None:
        raise UserError(f"--mesh_colouring=colour: the mesh {mesh.title} has no colours")
    return dataclasses.replace(mesh, colours=None) if colouring == "shaded" else mesh


def _ramp(mesh: Cloud, part: F64, stops: U8, text: str, low: str, high: str) -> Cloud:
    legend = scene.LegendEntry.ramp(text, stops, low, high)
    return dataclasses.replace(mesh, colours=colours.ramp(part, stops), legend=(legend,))


def read_mesh(path: Path, flag: str = "--mesh_file") -> Cloud:
    """Return the mesh of a file (.ply, .obj, .stl or .glb), in G; messages name the flag.

    Raises:
        UserError: The file cannot be read.
        MapError: It is no mesh, or damaged.
    """
    try:
        content = mesh_files.read_mesh(path)
    except OSError as error:
        raise UserError(f"{flag}={path} cannot be read ({error.strerror})") from error
    return Cloud(path.name, content.p, content.colours, faces=content.faces)


def field_slice(
    vi_map: VIMap, map_folder: Path, missions: I64 | None, height_m: float | None
) -> Cloud:
    """Return the voxels at a height in G, coloured by their distances.

    Args:
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
    legend = scene.LegendEntry.ramp("distance", stops, f"{near:.3g} m", f"{far:.3g} m")
    return Cloud("Distance field", p_G[rows], colours.ramp(part, stops), legend=(legend,))
