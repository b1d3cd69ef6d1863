"""Missions of the selected map: removal, and whether their base frames are known."""

from __future__ import annotations

from maplab_py.algorithms.pose_graph.layout import LayoutOptions
from maplab_py.plugin import CommandContext, Message, UserError, command
from maplab_py.vimap.ids import to_hex

_LAYOUT = LayoutOptions()


@command("remove_mission", "rm", example="remove_mission --map_mission=59f0 --yes")
def remove_mission(
    context: CommandContext, map_mission: str = "", *, map_mission_list: str = "", yes: bool = False
) -> Message:
    """Remove missions with their vertices, edges and landmarks; undo brings them back.

    Args:
        map_mission: Mission id or unambiguous prefix.
        map_mission_list: Several, separated by commas.
        yes: Do not ask.
    """
    from maplab_py.vimap.edits import remove_missions

    rows = context.mission_rows(map_mission, map_mission_list)
    if rows is None:
        raise UserError("remove_mission: say which mission, --map_mission=<id or prefix>")
    ids = ", ".join(to_hex(context.vi_map.missions.id[row]) for row in rows)
    context.confirm(f"remove mission {ids}?", yes=yes)
    context.commit(remove_missions(context.vi_map, rows))
    return Message(f"removed mission {ids}")


@command("set_mission_baseframe_to_known", "sbk", example="sbk --map_mission=59f0")
def set_mission_baseframe_to_known(context: CommandContext, map_mission: str = "") -> Message:
    """Declare that a mission's base frame T_G_M is right: others are anchored to it.

    Args:
        map_mission: Mission id or unambiguous prefix; may be empty when the map has one mission,
            otherwise the first mission is taken, as the tutorials do, and named.
    """
    return _set_one(context, map_mission, is_known=True)


@command(
    "set_mission_baseframe_to_unknown",
    example="set_mission_baseframe_to_unknown --map_mission=59f0",
)
def set_mission_baseframe_to_unknown(context: CommandContext, map_mission: str) -> Message:
    """Declare that a mission's base frame T_G_M is not to be relied on.

    Args:
        map_mission: Mission id or unambiguous prefix.
    """
    return _set_one(context, map_mission, is_known=False)


@command("set_all_mission_baseframes_to_known")
def set_all_mission_baseframes_to_known(context: CommandContext) -> Message:
    """Declare that the base frames of all missions are right."""
    return _set_all(context, is_known=True)


@command("set_all_mission_baseframes_to_unknown", "sabu")
def set_all_mission_baseframes_to_unknown(context: CommandContext) -> Message:
    """Declare that no mission's base frame is to be relied on."""
    return _set_all(context, is_known=False)


def _set_one(context: CommandContext, map_mission: str, *, is_known: bool) -> Message:
    vi_map = context.vi_map
    if not len(vi_map.missions):
        raise UserError(f"{context.command}: map '{context.map_key}' has no missions")
    row = context.mission_row(map_mission) if map_mission else 0
    known = vi_map.baseframes.is_known.copy()
    known[vi_map.missions.baseframe[row]] = is_known
    context.commit(vi_map.replace(baseframes=vi_map.baseframes.replace(is_known=known)))
    state = "known" if is_known else "unknown"
    return Message(f"base frame of mission {to_hex(vi_map.missions.id[row])} is {state} now")


def _set_all(context: CommandContext, *, is_known: bool) -> Message:
    vi_map = context.vi_map
    known = vi_map.baseframes.is_known.copy()
    known[vi_map.missions.baseframe] = is_known
    context.commit(vi_map.replace(baseframes=vi_map.baseframes.replace(is_known=known)))
    state = "known" if is_known else "unknown"
    return Message(f"base frames of {len(vi_map.missions)} missions are {state} now")


@command("spatially_distribute_missions", example="spatially_distribute_missions")
def spatially_distribute_missions(
    context: CommandContext, *, options: LayoutOptions = _LAYOUT
) -> Message:
    """Shift missions of unknown base frame apart, so that they can be looked at one by one."""
    from maplab_py.algorithms.pose_graph.layout import distribute_missions

    result, count = distribute_missions(context.vi_map, options)
    context.commit(result)
    if count == 0:
        return Message("the base frames of all missions are known: nothing was moved")
    return Message(f"{count} missions of unknown base frame were moved")
