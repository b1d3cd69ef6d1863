"""Missions of the selected map: removal, and whether their base frames are known."""

from __future__ import annotations

from maplab_py.algorithms.pose_graph_manipulation.layout import LayoutOptions
from maplab_py.plugin import CommandContext, Message, UserError, command
from maplab_py.report import counted
from maplab_py.vimap.ids import to_hex
from maplab_py.vimap.queries import mission_labels

_LAYOUT = LayoutOptions()


@command("remove_mission", "rm", example="remove_mission --map_mission=59f0 --yes")
def remove_mission(
    context: CommandContext, map_mission: str = "", *, map_mission_list: str = "", yes: bool = False
) -> Message:
    """Remove missions with their vertices, edges and landmarks; undo brings them back.

    Args:
        map_mission: Mission id or unambiguous prefix.
        map_mission_list: Several, separated by commas.
        yes: Do not ask for confirmation.
    """
    from maplab_py.vimap.edits import remove_missions

    rows = context.mission_rows(map_mission, map_mission_list)
    if rows is None:
        raise UserError("remove_mission: no mission is given; use --map_mission=<id or prefix>")
    labels = mission_labels(context.vi_map)
    ids = ", ".join(labels[row] for row in rows)
    context.confirm(f"remove mission {ids}?", yes=yes)
    context.commit(remove_missions(context.vi_map, rows))
    return Message(f"removed mission {ids}")


@command("rename_mission", example="rename_mission monday --map_mission=59f0")
def rename_mission(context: CommandContext, name: str, *, map_mission: str = "") -> Message:
    """Give a mission another name, under which it is shown and can be chosen.

    Names are stored beside the map, in the file mission_names.txt of its folder.

    Args:
        name: The new name: up to 60 characters without commas; no other mission of the map has it.
        map_mission: The mission; may be omitted if the map has only one.
    """
    from maplab_py.storage.mission_names import MAX_NAME_LENGTH, is_name, named

    vi_map = context.vi_map
    row = context.mission_row(map_mission)
    names = [str(other) for other in vi_map.missions.name]
    if not is_name(name):
        raise UserError(
            f"rename_mission: '{name}' cannot be a name: "
            f"use up to {MAX_NAME_LENGTH} printable characters without commas"
        )
    if name in names[:row] + names[row + 1 :]:
        raise UserError(f"rename_mission: another mission is named '{name}'; choose another name")
    old = mission_labels(vi_map)[row]
    names[row] = name
    context.commit(named(vi_map, names))
    return Message(f"renamed mission '{old}' to '{name}'")


@command("set_mission_baseframe_to_known", "sbk", example="sbk --map_mission=59f0")
def set_mission_baseframe_to_known(context: CommandContext, map_mission: str = "") -> Message:
    """Mark a mission's base frame T_G_M as known: other missions are anchored to it.

    Args:
        map_mission: Mission id or unambiguous prefix; may be empty when the map has one mission,
            otherwise the first mission is taken, as the tutorials do, and named.
    """
    return _set_known(context, map_mission, is_known=True)


@command(
    "set_mission_baseframe_to_unknown",
    example="set_mission_baseframe_to_unknown --map_mission=59f0",
)
def set_mission_baseframe_to_unknown(context: CommandContext, map_mission: str) -> Message:
    """Mark a mission's base frame T_G_M as unknown.

    Args:
        map_mission: Mission id or unambiguous prefix.
    """
    return _set_known(context, map_mission, is_known=False)


@command("set_all_mission_baseframes_to_known")
def set_all_mission_baseframes_to_known(context: CommandContext) -> Message:
    """Mark the base frames of all missions as known."""
    return _set_all(context, is_known=True)


@command("set_all_mission_baseframes_to_unknown", "sabu")
def set_all_mission_baseframes_to_unknown(context: CommandContext) -> Message:
    """Mark the base frames of all missions as unknown."""
    return _set_all(context, is_known=False)


def _set_known(context: CommandContext, map_mission: str, *, is_known: bool) -> Message:
    vi_map = context.vi_map
    if not len(vi_map.missions):
        raise UserError(f"{context.command}: map '{context.map_key}' has no missions")
    row = context.mission_row(map_mission) if map_mission else 0
    known = vi_map.baseframes.is_known.copy()
    known[vi_map.missions.baseframe[row]] = is_known
    context.commit(vi_map.replace(baseframes=vi_map.baseframes.replace(is_known=known)))
    state = "known" if is_known else "unknown"
    return Message(f"base frame of mission {to_hex(vi_map.missions.id[row])} set to {state}")


def _set_all(context: CommandContext, *, is_known: bool) -> Message:
    vi_map = context.vi_map
    known = vi_map.baseframes.is_known.copy()
    known[vi_map.missions.baseframe] = is_known
    context.commit(vi_map.replace(baseframes=vi_map.baseframes.replace(is_known=known)))
    state = "known" if is_known else "unknown"
    return Message(f"base frames of {counted(len(vi_map.missions), 'mission')} set to {state}")


@command("spatially_distribute_missions", example="spatially_distribute_missions")
def spatially_distribute_missions(
    context: CommandContext, *, options: LayoutOptions = _LAYOUT
) -> Message:
    """Shift missions of unknown base frame apart, so that they do not overlap in the viewer."""
    from maplab_py.algorithms.pose_graph_manipulation.layout import distribute_missions

    result, count = distribute_missions(context.vi_map, options)
    context.commit(result)
    if count == 0:
        return Message("the base frames of all missions are known: nothing to move")
    return Message(f"moved {counted(count, 'mission')} of unknown base frame")
