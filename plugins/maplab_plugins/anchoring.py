"""Commands that place missions of unknown base frame among the known ones."""

from __future__ import annotations

import numpy as np

from maplab_py.algorithms.anchoring.options import AnchoringOptions, AnchoringReport
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.plugin import CommandContext, command

_ANCHORING = AnchoringOptions()
_LOOPS = LoopClosureOptions()


@command(
    "anchor_all_missions",
    "aam",
    example="aam",
    see_also=("set_mission_baseframe_to_known", "anchor_mission", "relax"),
)
def anchor_all_missions(
    context: CommandContext,
    *,
    options: AnchoringOptions = _ANCHORING,
    loop_options: LoopClosureOptions = _LOOPS,
) -> AnchoringReport:
    """Anchor every mission of unknown base frame to the known ones, directly or over others."""
    from maplab_py.algorithms.anchoring.anchoring import anchor_missions

    result, report = anchor_missions(
        context.vi_map, options, loop_options, progress=context.progress
    )
    context.commit(result)
    return report


@command("anchor_mission", "am", example="am --map_mission=59f0", see_also=("anchor_all_missions",))
def anchor_mission(
    context: CommandContext,
    *,
    options: AnchoringOptions = _ANCHORING,
    loop_options: LoopClosureOptions = _LOOPS,
    map_mission: str = "",
) -> AnchoringReport:
    """Anchor one mission of unknown base frame to the known ones.

    Args:
        map_mission: Mission id or unambiguous prefix; may be left out when there is only one.
    """
    from maplab_py.algorithms.anchoring.anchoring import anchor_missions

    missions = np.array([context.mission_row(map_mission)])
    result, report = anchor_missions(
        context.vi_map, options, loop_options, missions=missions, progress=context.progress
    )
    context.commit(result)
    return report
