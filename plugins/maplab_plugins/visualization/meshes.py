"""The commands that show a mesh, of the map's grids or of a file, and a slice of a distance field."""

from pathlib import Path

from maplab_plugins.visualization.following import ViewerOptions, ViewReport, show
from maplab_py.algorithms.dense.options import MESH_MIN_WEIGHT
from maplab_py.plugin import ALL_MISSIONS, CommandContext, MissionChoice, command
from maplab_py.viewer.options import MeshColouring, VisualizationOptions


@command(
    "visualize_mesh",
    guards_effects=True,
    see_also=("create_mesh_from_tsdf_grid", "create_tsdf_from_depth_resource"),
)
def visualize_mesh(
    context: CommandContext,
    *,
    mesh_file: Path | None = None,
    mesh_colouring: MeshColouring = "auto",
    mesh_reference_file: Path | None = None,
    missions: MissionChoice = ALL_MISSIONS,
    dense_tsdf_mesh_min_weight: float = MESH_MIN_WEIGHT,
    dense_result_mesh_colours: bool = False,
    options: VisualizationOptions = VisualizationOptions(),
    display: ViewerOptions = ViewerOptions(),
) -> ViewReport:
    """Show the map with the mesh of its grids, or with a mesh from a file.

    Args:
        mesh_file: Triangles in the global frame (PLY, OBJ, STL, GLB); empty = the mesh of the map's grids.
        mesh_colouring: shaded = one colour, colour = that of the images or of the file, height = by z,
            distance = from the mesh of --mesh_reference_file; auto = the distance with such a file, else
            colours if there are any, else one colour.
        mesh_reference_file: File of another mesh, in the global frame.
        dense_tsdf_mesh_min_weight: Weight from which voxels count as observed, in measurements at 2 m.
        dense_result_mesh_colours: Colour the mesh of the grids by the images of the map, as colour does.
    """
    from maplab_py.viewer.mesh_sources import coloured_mesh, grid_mesh, read_mesh

    reference = None
    if mesh_reference_file is not None:
        reference = read_mesh(mesh_reference_file, "--mesh_reference_file")
    if mesh_file is not None:
        mesh = read_mesh(mesh_file)
    else:
        rows = missions.rows(context.vi_map)
        folder = context.map_folder or Path()
        mesh = grid_mesh(
            context.vi_map, folder, rows, dense_tsdf_mesh_min_weight,
            with_colours=dense_result_mesh_colours or mesh_colouring == "colour",
            progress=context.progress,
        )  # fmt: skip
    mesh = coloured_mesh(mesh, mesh_colouring, reference)
    return show(context, display, options, clouds=(mesh,))


@command(
    "visualize_esdf",
    guards_effects=True,
    see_also=("create_esdf_from_depth_resource",),
)
def visualize_esdf(
    context: CommandContext,
    *,
    missions: MissionChoice = ALL_MISSIONS,
    dense_esdf_slice_height_m: float | None = None,
    options: VisualizationOptions = VisualizationOptions(),
    display: ViewerOptions = ViewerOptions(),
) -> ViewReport:
    """Show the map with a horizontal slice through its distance field, coloured by the distance.

    Args:
        dense_esdf_slice_height_m: Height of the slice in the global frame; empty = the median height of
            the vertices.
    """
    from maplab_py.viewer import mesh_sources

    rows = missions.rows(context.vi_map)
    folder = context.map_folder or Path()
    cloud = mesh_sources.field_slice(context.vi_map, folder, rows, dense_esdf_slice_height_m)
    return show(context, display, options, clouds=(cloud,))
