"""The command that shows a mesh: of the map's grids, or of a file."""

from __future__ import annotations

from pathlib import Path

from maplab_plugins.visualization.following import ViewerOptions, ViewReport, show
from maplab_py.algorithms.dense.fusion.options import MESH_MIN_WEIGHT
from maplab_py.plugin import ALL_MISSIONS, CommandContext, MissionChoice, command
from maplab_py.viewer.options import VisualizationOptions

_OPTIONS = VisualizationOptions()
_VIEWER = ViewerOptions()


@command(
    "visualize_mesh",
    example="visualize_mesh",
    acts_outside=True,
    guards_effects=True,
    see_also=("create_mesh_from_tsdf_grid", "create_tsdf_from_depth_resource"),
)
def visualize_mesh(
    context: CommandContext,
    *,
    mesh_file: Path | None = None,
    missions: MissionChoice = ALL_MISSIONS,
    dense_tsdf_mesh_min_weight: float = MESH_MIN_WEIGHT,
    dense_result_mesh_colours: bool = False,
    options: VisualizationOptions = _OPTIONS,
    viewer: ViewerOptions = _VIEWER,
) -> ViewReport:
    """Show the map with the mesh of its grids, or with a mesh from a file.

    Args:
        mesh_file: PLY file with triangles in the global frame; empty = the mesh of the map's grids.
        dense_tsdf_mesh_min_weight: Weight from which voxels count as observed, in measurements at 2 m.
        dense_result_mesh_colours: Colour the mesh of the grids by the images of the map; the colours of
            a mesh file are always shown.
    """
    from maplab_py.viewer.building import Subject
    from maplab_py.viewer.mesh_sources import grid_mesh, read_mesh

    if mesh_file is not None:
        mesh = read_mesh(mesh_file)
    else:
        rows = missions.rows(context.vi_map)
        folder = context.map_folder or Path()
        mesh = grid_mesh(
            context.vi_map, folder, rows, dense_tsdf_mesh_min_weight,
            with_colours=dense_result_mesh_colours, progress=context.progress,
        )  # fmt: skip
    subject = Subject(context.vi_map, context.map_key, options, clouds=(mesh,))
    return show(context, subject, viewer)
