"""Commands that turn images, depth maps and point clouds into resources of a map, and back."""

from pathlib import Path

from maplab_py.interop.resources import depth_maps, images, matching
from maplab_py.plugin import CommandContext, command


@command(
    "import_images",
    example="import_images images_of_v1_01 --map_mission=59f0",
    see_also=("export_images", "resource_statistics"),
    reads=("dataset_folder",),
)
def import_images(
    context: CommandContext,
    dataset_folder: Path,
    *,
    map_mission: str = "",
    options: images.ImageImportOptions = images.ImageImportOptions(),
) -> matching.ImportedResources:
    """Attach the images of an EuRoC or TUM-VI folder to the frames of a mission.

    The k-th camera of the mission gets the images of cam<k>. Image and frame belong together if each is
    the nearest of the other in time. Frames that have an image keep it. The files are written into the
    map when it is saved.

    Args:
        dataset_folder: Folder with mav0/cam0 or cam0; its calibration is not read.
    """
    return context.apply(
        images.import_images, context.mission_row(map_mission), dataset_folder, options
    )


@command(
    "export_images",
    "export_timestamped_images",
    example="export_images exported_images",
    writes_files=True,
    see_also=("import_images",),
)
def export_images(
    context: CommandContext,
    dataset_folder: Path,
    *,
    map_mission: str = "",
    resource_type: str = "raw_images",
    overwrite: bool = False,
) -> matching.ExportedImages:
    """Write the images of a mission as an EuRoC folder: mav0/cam0/data/<stamp>.png and data.csv.

    Args:
        dataset_folder: Folder that gets mav0.
        resource_type: Number or name of the type of image or depth map.
    """
    from maplab_py.storage.resources.types import resource_type_of

    return images.export_images(
        context.vi_map,
        context.map_folder or Path(),
        context.mission_row(map_mission),
        resource_type_of(resource_type).number,
        dataset_folder,
        overwrite=overwrite,
        progress=context.progress,
    )


@command(
    "import_depth_maps",
    example="import_depth_maps depth_of_v1_01 --map_mission=59f0",
    see_also=("import_images", "resource_statistics"),
    reads=("depth_folder",),
)
def import_depth_maps(
    context: CommandContext,
    depth_folder: Path,
    *,
    map_mission: str = "",
    camera: int = 0,
    options: depth_maps.DepthImportOptions = depth_maps.DepthImportOptions(),
) -> matching.ImportedResources:
    """Attach depth images of another program to the frames of a camera, as raw depth maps.

    The files are 16-bit PNG images named <time stamp in ns>.png, of the size of the camera's images:
    depth along the optical axis at the pixels of the distorted image, 0 = unknown.

    Args:
        depth_folder: Folder with the files.
        camera: Index of the camera in its rig.
    """
    return context.apply(
        depth_maps.import_depth_maps,
        context.mission_row(map_mission),
        camera,
        depth_folder,
        options,
    )


@command(
    "import_point_clouds",
    example="import_point_clouds clouds_of_v1_01 --map_mission=59f0 --sensor_id=5c1a",
    see_also=("visualize_xyz_pointclouds", "resource_statistics"),
    reads=("point_cloud_folder",),
)
def import_point_clouds(
    context: CommandContext,
    point_cloud_folder: Path,
    *,
    map_mission: str = "",
    sensor_id: str = "",
) -> matching.ImportedResources:
    """Attach point clouds of another program to a sensor of a mission, each at its time.

    The files are PLY or PCD, named <time stamp in ns>.ply or .pcd, with points in the sensor's frame.

    Args:
        point_cloud_folder: Folder with the files.
        sensor_id: Id or unambiguous prefix of the sensor; empty = the mission's lidar.
    """
    from maplab_py.interop.resources.point_clouds import import_point_clouds as attach

    return context.apply(attach, context.mission_row(map_mission), point_cloud_folder, sensor_id)
