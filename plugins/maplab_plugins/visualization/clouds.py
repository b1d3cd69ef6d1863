"""Commands that show dense clouds and depth maps, which a map keeps as resources."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from maplab_plugins.visualization.following import ViewerOptions, ViewReport, show
from maplab_py.plugin import CommandContext, command
from maplab_py.viewer.options import PlaybackOptions, PointCloudOptions, VisualizationOptions

if TYPE_CHECKING:
    from maplab_py.viewer.layers.clouds import Cloud


_INTENSITIES = "point_cloud_w_intensity"


def _viewer(name: str, resource: str, what: str) -> Callable[..., ViewReport]:
    """Make the command that shows the clouds of one type of resource."""

    def view(
        context: CommandContext,
        *,
        clouds: PointCloudOptions = PointCloudOptions(),
        options: VisualizationOptions = VisualizationOptions(),
        display: ViewerOptions = ViewerOptions(),
    ) -> ViewReport:
        return _show(context, resource, clouds, options, display)

    view.__doc__ = f"Show the {what}."
    return command(name, guards_effects=True)(view)


visualize_xyz_pointclouds = _viewer(
    "visualize_xyz_pointclouds", "point_cloud", "clouds of plain points, coloured by height"
)
visualize_xyzi_pointclouds = _viewer(
    "visualize_xyzi_pointclouds",
    _INTENSITIES,
    "clouds whose points have intensities, as those of a lidar",
)
visualize_xyzrgbn_pointclouds = _viewer(
    "visualize_xyzrgbn_pointclouds", "color_point_cloud", "coloured clouds and meshes"
)
visualize_raw_depth_map_pointclouds = _viewer(
    "visualize_raw_depth_map_pointclouds", "raw_depth_maps", "raw depth maps as points in space"
)
visualize_optimized_depth_map_pointclouds = _viewer(
    "visualize_optimized_depth_map_pointclouds",
    "optimized_depth_maps",
    "optimised depth maps as points in space",
)


@command("visualize_xyzi_pointclouds_from_mission", guards_effects=True)
def visualize_xyzi_pointclouds_from_mission(
    context: CommandContext,
    *,
    map_mission: str = "",
    clouds: PointCloudOptions = PointCloudOptions(),
    options: VisualizationOptions = VisualizationOptions(),
    display: ViewerOptions = ViewerOptions(),
) -> ViewReport:
    """Show the clouds with intensities of one mission."""
    row = context.mission_row(map_mission)
    return _show(context, _INTENSITIES, clouds, options, display, np.array([row]))


@command("visualize_xyzi_pointclouds_sequentially", guards_effects=True)
def visualize_xyzi_pointclouds_sequentially(
    context: CommandContext,
    *,
    clouds: PointCloudOptions = PointCloudOptions(),
    options: VisualizationOptions = VisualizationOptions(),
    playback: PlaybackOptions = PlaybackOptions(),
    display: ViewerOptions = ViewerOptions(),
) -> ViewReport:
    """Play the missions with their clouds with intensities."""
    return _show(context, _INTENSITIES, clouds, options, display, playback=playback)


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
    from maplab_py.viewer import resource_clouds

    folder = context.map_folder or Path()
    loaded = resource_clouds.load_clouds(
        context.vi_map, folder, name, clouds, missions=missions, progress=context.progress
    )
    if clouds.export_accumulated_pc_to_ply_path:
        _write(loaded, Path(clouds.export_accumulated_pc_to_ply_path))
    plays = playback is not None
    return show(context, display, options, playback=playback, plays=plays, clouds=loaded)


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
