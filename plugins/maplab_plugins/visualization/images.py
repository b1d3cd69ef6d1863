"""Commands that show image resources: beside the playing map, and for the vertex that is clicked."""

from collections.abc import Callable
from pathlib import Path

from maplab_plugins.visualization.following import ViewerOptions, ViewReport, show
from maplab_py.plugin import CommandContext, command
from maplab_py.viewer.options import PlaybackOptions


def _player(name: str, what: str, example: str = "") -> Callable[..., ViewReport]:
    """Make the command that plays the missions with one type of image resource."""

    resource = name.removeprefix("visualize_")

    def play(
        context: CommandContext,
        *,
        playback: PlaybackOptions = PlaybackOptions(),
        display: ViewerOptions = ViewerOptions(),
    ) -> ViewReport:
        return _show(context, resource, playback, display)

    play.__doc__ = f"Play the missions with {what}."
    return command(name, example=example, guards_effects=True)(play)


visualize_raw_images = _player(
    "visualize_raw_images", "their grey images as recorded", "visualize_raw_images"
)
visualize_raw_color_images = _player(
    "visualize_raw_color_images", "their colour images as recorded"
)
visualize_undistorted_images = _player(
    "visualize_undistorted_images", "their undistorted grey images"
)
visualize_undistorted_color_images = _player(
    "visualize_undistorted_color_images", "their undistorted colour images"
)
visualize_disparity_maps = _player("visualize_disparity_maps", "their disparity maps")
visualize_raw_depth_maps = _player("visualize_raw_depth_maps", "their depth maps as recorded")
visualize_optimized_depth_maps = _player(
    "visualize_optimized_depth_maps", "their optimised depth maps"
)


def _show(
    context: CommandContext, name: str, playback: PlaybackOptions, display: ViewerOptions
) -> ViewReport:
    from maplab_py.viewer import resource_clouds

    resource_clouds.resource_rows(context.vi_map, name)
    images = resource_clouds.VertexImages(context.vi_map, context.map_folder or Path(), name)
    return show(context, display, playback=playback, image_of=images, plays=True)
