"""Commands that write and read ROS bags."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from maplab_py.interop.bags import options as bags
from maplab_py.plugin import ALL_MISSIONS, CommandContext, MissionChoice, command

if TYPE_CHECKING:
    from maplab_py.interop.bags.listing import BagInfo

_POSES, _EXPORT, _IMPORT = bags.PoseToBagOptions(), bags.BagExportOptions(), bags.BagImportOptions()


@command(
    "pose_to_bag",
    example="pose_to_bag --rosbag_plugin_input_bag=walk.bag --rosbag_plugin_output_bag=with_poses.bag",
    writes_files=True,
    see_also=("export_bag", "bag_info", "export_trajectory_to_csv"),
)
def pose_to_bag(
    context: CommandContext,
    *,
    rosbag_plugin_input_bag: Path,
    rosbag_plugin_output_bag: Path,
    options: bags.PoseToBagOptions = _POSES,
    chosen: MissionChoice = ALL_MISSIONS,
    overwrite: bool = False,
) -> bags.BagReport:
    """Copy a bag and add the poses of the map: to /tf, and as T_G_I, T_M_I and T_G_M.

    The copy has the format of the input, and its messages are copied byte by byte. With several missions,
    frames and topics end in _0, _1, ... by the time of their beginning.

    Args:
        rosbag_plugin_input_bag: ROS 1 bag, or file or folder of a ROS 2 bag.
        rosbag_plugin_output_bag: ROS 1 bag, or folder of a ROS 2 bag to write.
        overwrite: Replace a bag that exists.
    """
    from maplab_py.interop.bags.poses import add_poses_to_bag

    return add_poses_to_bag(
        context.vi_map,
        rosbag_plugin_input_bag,
        rosbag_plugin_output_bag,
        options,
        missions=chosen.rows(context.vi_map),
        overwrite=overwrite,
        progress=context.progress,
    )


@command(
    "export_bag",
    example="export_bag v1_01.bag --map_mission=59f0",
    writes_files=True,
    see_also=("pose_to_bag", "bag_info", "export_images", "rovioli"),
)
def export_bag(
    context: CommandContext,
    bag: Path,
    *,
    map_mission: str = "",
    options: bags.BagExportOptions = _EXPORT,
    overwrite: bool = False,
) -> bags.BagReport:
    """Write a mission as a ROS bag: poses, tf, IMU samples, images, depth maps, clouds.

    Images, depth maps and clouds are the resources of the map. Topics are those of the sensors, else /imu0,
    /cam0/image_raw, /points0, ...; rovioli reads the bag with the sensors.yaml of the map, and with
    --imu_topic and --camera_topics where it has no topics.

    Args:
        bag: File .bag of ROS 1, or folder of a ROS 2 bag.
        overwrite: Replace a bag that exists.
    """
    from maplab_py.interop.bags.exporting import export_bag as write

    return write(
        context.vi_map,
        context.map_folder or Path(),
        context.mission_row(map_mission),
        bag,
        options,
        overwrite=overwrite,
        progress=context.progress,
    )


@command(
    "export_mcap",
    example="export_mcap v1_01_mcap",
    writes_files=True,
    see_also=("export_bag", "visualize", "export_view"),
)
def export_mcap(
    context: CommandContext,
    recording: Path,
    *,
    mcap_images: bool = True,
    overwrite: bool = False,
) -> bags.BagReport:
    """Write the map for Foxglove and other viewers: paths, poses, landmarks, loop closures, images.

    The messages are those of ROS 2, in the frame map; landmarks, closures and paths are there from the
    beginning.

    Args:
        recording: Folder to write; the .mcap in it has the same name.
        mcap_images: Write the images of the map's resources, too.
        overwrite: Replace a recording that exists.
    """
    from maplab_py.interop.bags.exporting import export_mcap as write

    return write(
        context.vi_map,
        context.map_folder or Path(),
        recording,
        images=mcap_images,
        overwrite=overwrite,
        progress=context.progress,
    )


@command(
    "bag_info",
    example="bag_info walk.bag",
    see_also=("recording_info", "export_bag", "pose_to_bag"),
    needs_map=False,
    reads=("bag",),
)
def bag_info(context: CommandContext, bag: Path) -> BagInfo:
    """List the topics of a ROS bag: types, numbers of messages, begin, duration, rate.

    Every message is read, so that damage shows. `recording_info` checks a bag against a calibration.

    Args:
        bag: ROS 1 bag, or file or folder of a ROS 2 bag.
    """
    from maplab_py.interop.bags.listing import bag_info as read

    return read(bag, progress=context.progress)


@command(
    "import_bag_resources",
    example="import_bag_resources images_of_v1_01.bag --resource_topic=/cam0/image_raw --camera=0 "
    "--map_mission=59f0",
    see_also=("bag_info", "import_images", "import_depth_maps", "import_point_clouds"),
    reads=("rosbag_path",),
)
def import_bag_resources(
    context: CommandContext,
    rosbag_path: Path,
    *,
    map_mission: str = "",
    options: bags.BagImportOptions = _IMPORT,
) -> bags.BagImport:
    """Attach images, depth images or point clouds of a topic to frames or a sensor of a mission.

    Image and frame belong together if each is the nearest of the other in time. Frames that have an image
    keep it. Depth images are in millimetres (16UC1, compressedDepth) or metres (32FC1). The files are
    written into the map when it is saved.

    Args:
        rosbag_path: ROS 1 bag, or file or folder of a ROS 2 bag.
    """
    from maplab_py.interop.bags.importing import import_bag_resources as attach

    return context.apply(attach, context.mission_row(map_mission), rosbag_path, options)
