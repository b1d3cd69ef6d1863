"""Commands that thin out a map."""

from __future__ import annotations

from maplab_py.algorithms.keyframing.options import KeyframingOptions, KeyframingReport
from maplab_py.plugin import CommandContext, command

_KEYFRAMING = KeyframingOptions()


@command("keyframe_heuristic", "kfh", example="kfh --kf_every_nth_vertex=5 --dry_run")
def keyframe_heuristic(
    context: CommandContext,
    *,
    options: KeyframingOptions = _KEYFRAMING,
    map_mission: str = "",
    map_mission_list: str = "",
    dry_run: bool = False,
) -> KeyframingReport:
    """Keep keyframes and remove the vertices between them; IMU and odometry edges are joined.

    Args:
        map_mission: Mission id or unambiguous prefix; empty = all missions.
        map_mission_list: Several missions, separated by commas.
        dry_run: Only report what would go; the map stays as it is.
    """
    from maplab_py.algorithms.keyframing.heuristic import keyframe

    missions = context.mission_rows(map_mission, map_mission_list)
    result, report = keyframe(
        context.vi_map, options, missions=missions, progress=context.progress, dry_run=dry_run
    )
    if not dry_run:
        context.commit(result)
    return report
