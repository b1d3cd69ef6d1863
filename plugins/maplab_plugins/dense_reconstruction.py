"""maplab's dense reconstruction plugin: depth of stereo images, fusion, meshes."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import TYPE_CHECKING

from maplab_py.algorithms.dense import options as dense_options
from maplab_py.plugin import (
    ALL_MISSIONS,
    CommandContext,
    MissionChoice,
    UserError,
    check_writable,
    command,
)

if TYPE_CHECKING:
    from maplab_py.algorithms.dense import clouds, field, meshing, reconstruction
    from maplab_py.algorithms.dense.fusion import FusionReport


_STEREO, _SGBM, _BM = (
    dense_options.StereoOptions(),
    dense_options.SgbmOptions(),
    dense_options.BmOptions(),
)


@command(
    "stereo_dense_reconstruction",
    "stereo_dense",
    "sdr",
    example="stereo_dense_reconstruction --dense_stereo_multi_view=false",
    see_also=("import_images", "convert_all_depth_maps_to_point_clouds"),
)
def stereo_dense_reconstruction(
    context: CommandContext,
    *,
    missions: MissionChoice = ALL_MISSIONS,
    dense_depth_resource_output_type: int = 8,
    overwrite: bool = False,
    stereo: dense_options.StereoOptions = _STEREO,
    sgbm: dense_options.SgbmOptions = _SGBM,
    bm: dense_options.BmOptions = _BM,
) -> reconstruction.StereoReport:
    """Compute depth from the stereo images of every vertex, by OpenCV's block matching.

    Images of every camera model are rectified. Pixels that the right image, or the depth of
    neighbouring vertices, does not confirm are removed. Depth is at the pixels of the left camera's
    distorted image. The files are written into the map when it is saved.

    Args:
        dense_depth_resource_output_type: 8 = raw depth maps, 17 = clouds with colours.
        overwrite: Replace what frames have of this type.
    """
    from maplab_py.algorithms.dense.reconstruction import StereoSettings, reconstruct_stereo

    return context.apply(
        reconstruct_stereo,
        context.map_folder or Path(),
        missions.rows(context.vi_map),
        StereoSettings(stereo, sgbm, bm),
        output_type=dense_depth_resource_output_type,
        overwrite=overwrite,
    )


@command(
    "convert_all_depth_maps_to_point_clouds",
    see_also=("stereo_dense_reconstruction", "visualize_xyzrgbn_pointclouds"),
)
def convert_all_depth_maps_to_point_clouds(context: CommandContext) -> clouds.ConvertedDepthMaps:
    """Make a point cloud of every depth map, with colours where its frame has an image.

    Frames that have a cloud keep it. The files are written into the map when it is saved.
    """
    from maplab_py.algorithms.dense.clouds import convert_depth_maps

    return context.apply(convert_depth_maps, context.map_folder or Path())


@command(
    "create_tsdf_from_depth_resource",
    "tsdf",
    "depth_fusion",
    example="tsdf --dense_tsdf_voxel_size_m=0.1 --dense_result_mesh_output_file=room.ply",
    writes_files=True,
    see_also=("stereo_dense_reconstruction", "create_mesh_from_tsdf_grid"),
)
def create_tsdf_from_depth_resource(
    context: CommandContext,
    *,
    missions: MissionChoice = ALL_MISSIONS,
    dense_depth_resource_input_type: str = "",
    options: dense_options.FusionOptions = dense_options.FusionOptions(),
    update: bool = False,
    dense_update_threshold_m: float = 0.01,
    dense_max_memory_gb: float = 0.0,
    dense_result_mesh_output_file: Path | None = None,
    dense_tsdf_mesh_min_weight: float = dense_options.MESH_MIN_WEIGHT,
    overwrite: bool = False,
) -> FusionReport:
    """Fuse the depth of cameras into a grid of truncated signed distances.

    Missions with known base frames share a grid; each other one has its own. The grid is a resource of
    its first mission and is written into the map when it is saved.

    Args:
        dense_depth_resource_input_type: Number or name of the resource type to fuse: depth maps (8, 9) or
            clouds of cameras (16, 17, 21); empty = the first of 9, 8, 17, 16, 21 that there is.
        update: Do not fuse again: take the depth maps whose poses have changed out of the grid and add
            them at their present poses. Voxels and weights stay as they are.
        dense_update_threshold_m: Depth maps that moved by less stay as they are.
        dense_max_memory_gb: Memory that the grid may take; 0 = most of what is available.
        dense_result_mesh_output_file: Also write the mesh: .ply, .obj, .stl or .glb.
        dense_tsdf_mesh_min_weight: Weight from which voxels count as observed, in measurements at 2 m.
        overwrite: Replace grids that the missions have, and the file of the mesh.
    """
    from maplab_py.algorithms.dense.fusion import fuse_depth, update_grids
    from maplab_py.memory import memory_limited

    if dense_result_mesh_output_file is not None:
        _check_mesh(dense_result_mesh_output_file, overwrite=overwrite)
    rows = missions.rows(context.vi_map)
    folder = context.map_folder or Path()
    input_type = _depth_type(dense_depth_resource_input_type)
    with memory_limited(dense_max_memory_gb, "--dense_max_memory_gb"):
        make = (
            functools.partial(update_grids, threshold_m=dense_update_threshold_m)
            if update
            else functools.partial(fuse_depth, overwrite=overwrite)
        )
        report = context.apply(make, folder, rows, options, input_type=input_type)
    if dense_result_mesh_output_file is not None:
        from maplab_py.algorithms.dense.meshing import write_map_mesh

        file = dense_result_mesh_output_file
        write_map_mesh(
            context.vi_map, folder, file, rows, dense_tsdf_mesh_min_weight, overwrite=overwrite
        )
    return report


@command(
    "create_esdf_from_depth_resource",
    "esdf",
    example="esdf --dense_esdf_max_distance_m=3",
    writes_files=True,
    see_also=("create_tsdf_from_depth_resource", "visualize_esdf"),
)
def create_esdf_from_depth_resource(
    context: CommandContext,
    *,
    missions: MissionChoice = ALL_MISSIONS,
    dense_depth_resource_input_type: str = "",
    options: dense_options.DistanceOptions = dense_options.DistanceOptions(),
    fusion: dense_options.FusionOptions = dense_options.FusionOptions(),
    dense_tsdf_mesh_min_weight: float = dense_options.MESH_MIN_WEIGHT,
    dense_max_memory_gb: float = 0.0,
    overwrite: bool = False,
) -> field.FieldsReport:
    """Compute the distance of every voxel that cameras have seen from the nearest surface.

    Depth is fused as by create_tsdf_from_depth_resource, together with the free space in front of the
    surfaces. The Euclidean signed distance field is positive in free space and negative behind surfaces,
    and exact: no distance is propagated from voxel to voxel. Missions with known base frames share a
    field; each other one has its own. The field is a resource of its first mission and is written into the
    map when it is saved.

    Args:
        dense_depth_resource_input_type: As of create_tsdf_from_depth_resource.
        dense_tsdf_mesh_min_weight: Weight from which voxels count as observed for the surface, in
            measurements at 2 m.
        dense_max_memory_gb: Memory that the grid and the field may take; 0 = most of what is available.
        overwrite: Replace fields that the missions have, and the file for path planners.
    """
    from maplab_py.algorithms.dense.field import create_fields, export_voxels
    from maplab_py.memory import memory_limited

    file = options.export_map_for_panning_path
    if file is not None:
        _check_cloud(file, overwrite=overwrite)
    rows = missions.rows(context.vi_map)
    folder = context.map_folder or Path()
    with memory_limited(dense_max_memory_gb, "--dense_max_memory_gb"):
        report = context.apply(
            create_fields,
            folder,
            rows,
            options,
            fusion,
            min_weight=dense_tsdf_mesh_min_weight,
            input_type=_depth_type(dense_depth_resource_input_type),
            overwrite=overwrite,
        )
    if file is not None:
        export_voxels(context.vi_map, folder, file, rows, overwrite=overwrite)
    return report


@command(
    "create_mesh_from_tsdf_grid",
    "export_tsdf",
    example="create_mesh_from_tsdf_grid --dense_result_mesh_output_file=room.glb",
    writes_files=True,
    see_also=("create_tsdf_from_depth_resource",),
)
def create_mesh_from_tsdf_grid(
    context: CommandContext,
    *,
    dense_result_mesh_output_file: Path,
    missions: MissionChoice = ALL_MISSIONS,
    dense_tsdf_mesh_min_weight: float = dense_options.MESH_MIN_WEIGHT,
    dense_result_mesh_colours: bool = False,
    overwrite: bool = False,
) -> meshing.MeshReport:
    """Write the surface of the grids as a triangle mesh, in the global frame.

    The surface passes only through cells all of whose eight voxels have been observed.

    Args:
        dense_result_mesh_output_file: File to write: .ply, .obj, .stl or .glb.
        dense_tsdf_mesh_min_weight: Weight from which voxels count as observed, in measurements at 2 m.
        dense_result_mesh_colours: Give the vertices the colours of the images in which they are seen; needs
            images and depth maps.
    """
    from maplab_py.algorithms.dense.meshing import write_map_mesh

    _check_mesh(dense_result_mesh_output_file, overwrite=overwrite)
    return write_map_mesh(
        context.vi_map,
        context.map_folder or Path(),
        dense_result_mesh_output_file,
        missions.rows(context.vi_map),
        dense_tsdf_mesh_min_weight,
        with_colours=dense_result_mesh_colours,
        overwrite=overwrite,
        progress=context.progress,
    )


def _check_mesh(path: Path, *, overwrite: bool) -> None:
    """Refuse a file of a mesh before any work is done."""
    from maplab_py.interop.mesh_files import check_mesh_path

    check_mesh_path(path)
    check_writable(path, overwrite=overwrite)


def _check_cloud(path: Path, *, overwrite: bool) -> None:
    """Refuse a file of voxels before any work is done."""
    if path.suffix.lower() != ".ply":
        raise UserError(f"--dense_esdf_export_map_for_panning_path={path}: give a file named .ply")
    check_writable(path, overwrite=overwrite)


def _depth_type(given: str) -> int | None:
    """Return the number of the resource type of depth that a user names, None for none."""
    from maplab_py.storage.resources.types import resource_type_of

    return resource_type_of(given, "--dense_depth_resource_input_type").number if given else None
