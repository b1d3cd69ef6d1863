"""Commands that exchange maps with COLMAP."""

from pathlib import Path

from maplab_py.interop.colmap import options as colmap_options
from maplab_py.plugin import CommandContext, UserError, command, key_of_folder


@command(
    "export_colmap",
    example="export_colmap --colmap_folder=office_colmap --quality=good",
    writes_files=True,
    see_also=("import_colmap", "compare_maps"),
)
def export_colmap(
    context: CommandContext,
    colmap_folder: Path | None = None,
    *,
    missions: str = "",
    options: colmap_options.ColmapExportOptions = colmap_options.ColmapExportOptions(),
    overwrite: bool = False,
) -> colmap_options.ColmapExportReport:
    """Write missions as a COLMAP model: cameras, rigs, frames, images, points.

    Each vertex with images becomes a frame, each observed landmark a point; the world is the map's frame G.
    Images are named <mission>/cam<index>/<time stamp>.png. The file maplab.npz beside the model has the
    ids of the map: `import_colmap` gives them back, and COLMAP ignores it.

    Args:
        colmap_folder: Folder to write into.
        missions: Mission ids or unambiguous prefixes, separated by commas; empty = all.
    """
    from maplab_py.interop.colmap.exporting import export_colmap as write

    return write(
        context.vi_map,
        _given(colmap_folder),
        options,
        missions=context.mission_rows("", missions),
        overwrite=overwrite,
    )


@command(
    "import_colmap",
    example="import_colmap --colmap_folder=office_colmap --align_to=office_truth.csv",
    needs_map=False,
    see_also=("export_colmap", "compare_maps", "init_track_landmarks", "optimize_visual"),
)
def import_colmap(
    context: CommandContext,
    colmap_folder: Path | None = None,
    *,
    database: Path | None = None,
    options: colmap_options.ColmapImportOptions = colmap_options.ColmapImportOptions(),
    map_key: str = "",
) -> colmap_options.ColmapImportReport:
    """Make a map of a COLMAP model: a mission of each rig, with odometry edges and landmarks, without IMU.

    The reference sensor of a rig becomes the body frame. Scale and gravity of a model are arbitrary unless
    --align_to, or --scale and --gravity are given: the missions are then marked, and optvi refuses
    inertial terms.

    Args:
        colmap_folder: Folder with cameras, images and points3D, and with rigs and frames where the model has
            them, as .bin or .txt.
        database: COLMAP's database of the model, for descriptors and scales of the keypoints.
        map_key: Name of the map in memory; by default the folder's name.
    """
    from maplab_py.interop.colmap.importing import import_colmap as read

    folder = _given(colmap_folder)
    key = context.maps.check_new_key(map_key or key_of_folder(folder))
    vi_map, report = read(
        folder, options, database=database, map_key=key, progress=context.progress
    )
    context.maps.add(key, vi_map)
    return report


def _given(folder: Path | None) -> Path:
    if folder is None:
        raise UserError("no folder: give --colmap_folder=...")
    return folder
