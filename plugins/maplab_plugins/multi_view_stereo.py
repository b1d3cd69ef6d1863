"""Export for programs of multi-view stereo; maplab's PMVS interface, and COLMAP."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from maplab_py.plugin import ALL_MISSIONS, CommandContext, MissionChoice, UserError, command

if TYPE_CHECKING:
    from maplab_py.algorithms.dense.export import MvsExport


@command(
    "export_colmap_mvs",
    example="export_colmap_mvs --colmap_workspace=dense --colmap_max_image_size=1600",
    writes_files=True,
    see_also=("import_images", "export_for_pmvs_reconstruction", "stereo_dense_reconstruction"),
)
def export_colmap_mvs(
    context: CommandContext,
    *,
    colmap_workspace: Path,
    colmap_max_image_size: int = 0,
    missions: MissionChoice = ALL_MISSIONS,
    every_nth: int = 1,
    only_good_landmarks: bool = True,
    overwrite: bool = False,
) -> MvsExport:
    """Write a dense workspace of COLMAP: undistorted images, sparse model, settings of patch match.

    `colmap patch_match_stereo --workspace_path=...` and `colmap stereo_fusion` continue from there. Images
    of every camera model are undistorted; poses and landmarks are those of the map, in the global frame.

    Args:
        colmap_workspace: Folder that gets images, sparse and stereo.
        colmap_max_image_size: Longer side of the images in pixels; 0 = as recorded.
        every_nth: Use the images of every n-th vertex of each mission only.
        only_good_landmarks: Leave out landmarks of bad quality.
    """
    from maplab_py.algorithms.dense import export

    if colmap_max_image_size < 0 or every_nth < 1:
        raise UserError(
            f"--colmap_max_image_size={colmap_max_image_size}, --every_nth={every_nth}: must be at "
            "least 0 and 1"
        )
    views = export.UndistortedViews(
        context.vi_map,
        context.map_folder or Path(),
        missions.rows(context.vi_map),
        export.UndistortionOptions(max_size_px=colmap_max_image_size),
        every_nth=every_nth,
    )
    return export.write_colmap_workspace(
        views,
        colmap_workspace,
        only_good=only_good_landmarks,
        overwrite=overwrite,
        progress=context.progress,
    )


@command(
    "export_for_pmvs_reconstruction",
    "export_for_pmvs",
    example="export_for_pmvs --pmvs_reconstruction_folder=pmvs",
    writes_files=True,
    see_also=("import_images", "export_colmap_mvs"),
)
def export_for_pmvs_reconstruction(
    context: CommandContext,
    *,
    pmvs_reconstruction_folder: Path,
    pmvs_undistortion_alpha: float = 0.0,
    pmvs_undistortion_scale: float = 1.0,
    pmvs_image_format: Literal["ppm", "jpg"] = "ppm",
    pmvs_export_data_for_nth_vertex: int = 1,
    cmvs_use_only_good_landmarks: bool = True,
    missions: MissionChoice = ALL_MISSIONS,
    overwrite: bool = False,
) -> MvsExport:
    """Write undistorted images, projection matrices and a Bundler file for CMVS and PMVS-2.

    Args:
        pmvs_reconstruction_folder: Folder that gets visualize, txt, models and the files of CMVS.
        pmvs_undistortion_alpha: 0 = undistorted images have valid pixels only, 1 = all of the recorded image.
        pmvs_undistortion_scale: Scale of the undistorted images.
        pmvs_image_format: Format of the images.
        pmvs_export_data_for_nth_vertex: Use the images of every n-th vertex of each mission only.
        cmvs_use_only_good_landmarks: Leave out landmarks of bad quality.
    """
    from maplab_py.algorithms.dense.export import (
        UndistortedViews,
        UndistortionOptions,
        write_pmvs_folder,
    )

    if not 0.0 <= pmvs_undistortion_alpha <= 1.0 or not 0.05 <= pmvs_undistortion_scale <= 4.0:
        raise UserError(
            f"--pmvs_undistortion_alpha={pmvs_undistortion_alpha:g}, --pmvs_undistortion_scale="
            f"{pmvs_undistortion_scale:g}: must be from 0 to 1 and from 0.05 to 4"
        )
    if pmvs_export_data_for_nth_vertex < 1:
        raise UserError("--pmvs_export_data_for_nth_vertex: must be 1 or greater")
    views = UndistortedViews(
        context.vi_map,
        context.map_folder or Path(),
        missions.rows(context.vi_map),
        UndistortionOptions(pmvs_undistortion_alpha, pmvs_undistortion_scale),
        every_nth=pmvs_export_data_for_nth_vertex,
    )
    return write_pmvs_folder(
        views,
        pmvs_reconstruction_folder,
        image_format=pmvs_image_format,
        only_good=cmvs_use_only_good_landmarks,
        overwrite=overwrite,
        progress=context.progress,
    )
