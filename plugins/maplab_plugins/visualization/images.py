"""Commands that show image resources: beside the playing map, and for the vertex that is clicked."""

from __future__ import annotations

from maplab_plugins.visualization.following import ViewerOptions, ViewReport, show
from maplab_py.plugin import CommandContext, UserError, command
from maplab_py.viewer.options import PlaybackOptions

_VIEWER = ViewerOptions()
_PLAYBACK = PlaybackOptions()


@command("visualize_raw_images", example="visualize_raw_images", acts_outside=True)
def visualize_raw_images(
    context: CommandContext,
    *,
    playback: PlaybackOptions = _PLAYBACK,
    viewer: ViewerOptions = _VIEWER,
) -> ViewReport:
    """Play the missions with their grey images as recorded."""
    return _show(context, "raw_images", playback, viewer)


@command("visualize_raw_color_images", acts_outside=True)
def visualize_raw_color_images(
    context: CommandContext,
    *,
    playback: PlaybackOptions = _PLAYBACK,
    viewer: ViewerOptions = _VIEWER,
) -> ViewReport:
    """Play the missions with their colour images as recorded."""
    return _show(context, "raw_color_images", playback, viewer)


@command("visualize_undistorted_images", acts_outside=True)
def visualize_undistorted_images(
    context: CommandContext,
    *,
    playback: PlaybackOptions = _PLAYBACK,
    viewer: ViewerOptions = _VIEWER,
) -> ViewReport:
    """Play the missions with their undistorted grey images."""
    return _show(context, "undistorted_images", playback, viewer)


@command("visualize_undistorted_color_images", acts_outside=True)
def visualize_undistorted_color_images(
    context: CommandContext,
    *,
    playback: PlaybackOptions = _PLAYBACK,
    viewer: ViewerOptions = _VIEWER,
) -> ViewReport:
    """Play the missions with their undistorted colour images."""
    return _show(context, "undistorted_color_images", playback, viewer)


@command("visualize_disparity_maps", acts_outside=True)
def visualize_disparity_maps(
    context: CommandContext,
    *,
    playback: PlaybackOptions = _PLAYBACK,
    viewer: ViewerOptions = _VIEWER,
) -> ViewReport:
    """Play the missions with their disparity maps."""
    return _show(context, "disparity_maps", playback, viewer)


@command("visualize_raw_depth_maps", acts_outside=True)
def visualize_raw_depth_maps(
    context: CommandContext,
    *,
    playback: PlaybackOptions = _PLAYBACK,
    viewer: ViewerOptions = _VIEWER,
) -> ViewReport:
    """Play the missions with their depth maps as recorded."""
    return _show(context, "raw_depth_maps", playback, viewer)


@command("visualize_optimized_depth_maps", acts_outside=True)
def visualize_optimized_depth_maps(
    context: CommandContext,
    *,
    playback: PlaybackOptions = _PLAYBACK,
    viewer: ViewerOptions = _VIEWER,
) -> ViewReport:
    """Play the missions with their optimised depth maps."""
    return _show(context, "optimized_depth_maps", playback, viewer)


def _show(
    context: CommandContext, name: str, playback: PlaybackOptions, viewer: ViewerOptions
) -> ViewReport:
    from maplab_py.viewer.building import Subject
    from maplab_py.viewer.resource_clouds import VertexImages, resource_rows

    if context.map_folder is None:
        raise UserError(
            f"map '{context.map_key}' was never loaded or saved: it has no resource files"
        )
    resource_rows(context.vi_map, name)
    images = VertexImages(context.vi_map, context.map_folder, name)
    subject = Subject(context.vi_map, context.map_key)
    return show(context, subject, viewer, playback=playback, image_of=images, plays=True)
