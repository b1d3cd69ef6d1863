"""Distributions and size of the selected map."""

from __future__ import annotations

from typing import TYPE_CHECKING

from maplab_py.algorithms.keyframing.options import KeyframingOptions
from maplab_py.plugin import CommandContext, command

if TYPE_CHECKING:
    from maplab_py.algorithms.statistics.statistics import MapDistributions, MapSize


@command("statistics", "stat", see_also=("map_stats", "map_size"))
def statistics(context: CommandContext) -> MapDistributions:
    """Show how tracks, landmarks, distances and samples of the selected map are distributed."""
    from maplab_py.algorithms.statistics.statistics import map_distributions

    return map_distributions(context.vi_map)


@command(
    "map_size",
    see_also=("keyframe_heuristic", "landmark_sparsify", "generate_summary_map_and_save_to_disk"),
)
def map_size(
    context: CommandContext, *, keyframing: KeyframingOptions = KeyframingOptions()
) -> MapSize:
    """Show the size of each part of the map and what each maintenance command would save."""
    from maplab_py.algorithms.statistics.statistics import map_size as measure

    return measure(
        context.vi_map,
        folder=context.map_folder,
        keyframing=keyframing,
        progress=context.progress,
    )
