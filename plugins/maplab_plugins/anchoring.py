"""Commands that anchor missions of unknown base frame to the known ones."""

import numpy as np

from maplab_py.algorithms.anchoring.absolute import AbsoluteAnchoringOptions
from maplab_py.algorithms.anchoring.options import AnchoringOptions, AnchoringReport
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.array_types import F64
from maplab_py.errors import UserError
from maplab_py.plugin import CommandContext, command


@command(
    "anchor_all_missions",
    "aam",
    example="aam",
    see_also=("set_mission_baseframe_to_known", "anchor_mission", "relax"),
)
def anchor_all_missions(
    context: CommandContext,
    *,
    options: AnchoringOptions = AnchoringOptions(),
    absolute_options: AbsoluteAnchoringOptions = AbsoluteAnchoringOptions(),
    loop_options: LoopClosureOptions = LoopClosureOptions(),
) -> AnchoringReport:
    """Anchor every mission of unknown base frame to the known ones, directly or through other missions.

    Missions with absolute poses are anchored by these first. Places are recognised by descriptors of
    one feature type; keypoints with others are left out.
    """
    from maplab_py.algorithms.anchoring.anchoring import anchor_missions

    return context.apply(anchor_missions, options, loop_options, absolute=absolute_options)


@command("anchor_mission", "am", example="am --map_mission=59f0", see_also=("anchor_all_missions",))
def anchor_mission(
    context: CommandContext,
    *,
    options: AnchoringOptions = AnchoringOptions(),
    absolute_options: AbsoluteAnchoringOptions = AbsoluteAnchoringOptions(),
    loop_options: LoopClosureOptions = LoopClosureOptions(),
    map_mission: str = "",
    to: str = "",
    T_G_M: str = "",
) -> AnchoringReport:
    """Anchor one mission of unknown base frame by its absolute poses, or else to the known ones.

    Places are recognised by descriptors of one feature type; keypoints with others are left out.
    With --T_G_M a person decides where the mission is: the pose is taken as it is, or with --to as
    an approximate one that selects the alignment with another mission.

    Args:
        to: Known mission; the alignment with it that is nearest to --T_G_M is used.
        T_G_M: Pose of the mission's frame in the global frame: x y z [m] and yaw [deg], "1 2 0 90".
    """
    from maplab_py.algorithms.anchoring.anchoring import anchor_missions, choice_near, place_mission

    row = context.mission_row(map_mission)
    choice = None
    if to and not T_G_M:
        raise UserError('--to: give the approximate pose, too: --T_G_M="x y z yaw_deg"')
    if T_G_M:
        pose = _yaw_and_position(T_G_M)
        if not to:
            result, report = place_mission(context.vi_map, row, pose)
            context.commit(result)
            return report
        choice = choice_near(context.vi_map, row, context.mission_row(to), pose)
    return context.apply(
        anchor_missions,
        options,
        loop_options,
        missions=np.array([row]),
        choice=choice,
        absolute=absolute_options,
    )


def _yaw_and_position(text: str) -> F64:
    """Read x y z [m] and yaw [deg]; return position and yaw [rad] (4,)."""
    try:
        values = np.array([float(word) for word in text.replace(",", " ").split()])
    except ValueError:
        values = np.zeros(0)
    if len(values) != 4 or not np.isfinite(values).all():
        raise UserError(f'--T_G_M={text}: four numbers are expected, "x y z yaw_deg"')
    return np.append(values[:3], np.radians(values[3]))
