"""Commands that show dense clouds and depth maps, which a map keeps as resources."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from maplab_plugins.visualization.following import ViewerOptions, ViewReport, show
from maplab_py.plugin import CommandContext, command
from maplab_py.viewer.options import PlaybackOptions, PointCloudOptions, VisualizationOptions

if TYPE_CHECKING:
    from maplab_py.viewer.layers.clouds import Cloud


@command("visualize_xyz_pointclouds", acts_outside=True, guards_effects=True)
def visualize_xyz_pointclouds(
    context: CommandContext,
    *,
    clouds: PointCloudOptions = PointCloudOptions(),
    options: VisualizationOptions = VisualizationOptions(),
    display: ViewerOptions = ViewerOptions(),
) -> ViewReport:
    """Show the clouds of plain points, coloured by height."""
    return _show(context, "point_cloud", clouds, options, display)


@command("visualize_xyzi_pointclouds", acts_outside=True, guards_effects=True)
def visualize_xyzi_pointclouds(
    context: CommandContext,
    *,
    clouds: PointCloudOptions = PointCloudOptions(),
    options: VisualizationOptions = VisualizationOptions(),
    display: ViewerOptions = ViewerOptions(),
) -> ViewReport:
    """Show the clouds whose points have intensities, as those of a lidar."""
    return _show(context, "point_cloud_w_intensity", clouds, options, display)


@command("visualize_xyzi_pointclouds_from_mission", acts_outside=True, guards_effects=True)
def visualize_xyzi_pointclouds_from_mission(
    context: CommandContext,
    *,
    map_mission: str = "",
    clouds: PointCloudOptions = PointCloudOptions(),
    options: VisualizationOptions = VisualizationOptions(),
    display: ViewerOptions = ViewerOptions(),
) -> ViewReport:
    """Show the clouds with intensities of one mission.

    Args:
        map_mission: Mission id or unambiguous prefix; may be omitted if the map has only one.
    """
    row = context.mission_row(map_mission)
    return _show(context, "point_cloud_w_intensity", clouds, options, display, np.array([row]))


@command("visualize_xyzi_pointclouds_sequentially", acts_outside=True, guards_effects=True)
def visualize_xyzi_pointclouds_sequentially(
    context: CommandContext,
    *,
    clouds: PointCloudOptions = PointCloudOptions(),
    options: VisualizationOptions = VisualizationOptions(),
    playback: PlaybackOptions = PlaybackOptions(),
    display: ViewerOptions = ViewerOptions(),
) -> ViewReport:
    """Play the missions with their clouds with intensities."""
    return _show(context, "point_cloud_w_intensity", clouds, options, display, playback=playback)


@command("visualize_xyzrgbn_pointclouds", acts_outside=True, guards_effects=True)
def visualize_xyzrgbn_pointclouds(
    context: CommandContext,
    *,
    clouds: PointCloudOptions = PointCloudOptions(),
    options: VisualizationOptions = VisualizationOptions(),
    display: ViewerOptions = ViewerOptions(),
) -> ViewReport:
    """Show the coloured clouds and meshes."""
    return _show(context, "color_point_cloud", clouds, options, display)


@command("visualize_raw_depth_map_pointclouds", acts_outside=True, guards_effects=True)
def visualize_raw_depth_map_pointclouds(
    context: CommandContext,
    *,
    clouds: PointCloudOptions = PointCloudOptions(),
    options: VisualizationOptions = VisualizationOptions(),
    display: ViewerOptions = ViewerOptions(),
) -> ViewReport:
    """Show the raw depth maps as points in space."""
    return _show(context, "raw_depth_maps", clouds, options, display)


@command("visualize_optimized_depth_map_pointclouds", acts_outside=True, guards_effects=True)
def visualize_optimized_depth_map_pointclouds(
    context: CommandContext,
    *,
    clouds: PointCloudOptions = PointCloudOptions(),
    options: VisualizationOptions = VisualizationOptions(),
    display: ViewerOptions = ViewerOptions(),
) -> ViewReport:
    """Show the optimised depth maps as points in space."""
    return _show(context, "optimized_depth_maps", clouds, options, display)


def _show(
    context: CommandContext,
    name: str,
    clouds: PointCloudOptions,
    options: VisualizationOptions,
    display: ViewerOptions,
    missions: np.ndarray[tuple[int, ...], np.dtype[np.int64]] | None = None,
    playback: PlaybackOptions | None = None,
) -> ViewReport:
    """Load the clouds of a resource type and show them with the map."""
    from maplab_py.viewer.building import Subject
    from maplab_py.viewer.resource_clouds import load_clouds

    folder = context.map_folder or Path()
    loaded = load_clouds(
        context.vi_map, folder, name, clouds, missions=missions, progress=context.progress
    )
    if clouds.export_accumulated_pc_to_ply_path:
        _write(loaded, Path(clouds.export_accumulated_pc_to_ply_path))
    subject = Subject(context.vi_map, context.map_key, options, clouds=loaded)
    return show(context, subject, display, playback=playback, plays=playback is not None)


def _write(clouds: tuple[Cloud, ...], path: Path) -> None:
    from maplab_py.interop.ply import PlyCloud, write_ply
    from maplab_py.viewer.layers.clouds import cloud_colours, colour_ranges

    has_intensity = all(cloud.intensity is not None for cloud in clouds)
    ranges = colour_ranges(clouds)
    intensity = [cloud.intensity for cloud in clouds if cloud.intensity is not None]
    write_ply(
        PlyCloud(
            np.concatenate([cloud.p_G for cloud in clouds]),
            np.concatenate([cloud_colours(cloud, ranges) for cloud in clouds]),
            np.concatenate(intensity) if has_intensity else None,
        ),
        path,
    )
