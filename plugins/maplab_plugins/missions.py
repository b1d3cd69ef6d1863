"""Missions of the selected map: removal, and whether their base frames are known."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

from maplab_py.algorithms.pose_graph_manipulation.layout import LayoutOptions
from maplab_py.plugin import CommandContext, Message, UserError, command
from maplab_py.report import counted
from maplab_py.vimap import VIMap, queries
from maplab_py.vimap.ids import to_hex


@command("remove_mission", "rm", example="remove_mission --map_mission=59f0 --yes")
def remove_mission(
    context: CommandContext, map_mission: str = "", *, map_mission_list: str = "", yes: bool = False
) -> Message:
    """Remove missions with their vertices, edges and landmarks; undo brings them back.

    Args:
        map_mission: Mission id or unambiguous prefix.
        map_mission_list: Several, separated by commas.
    """
    from maplab_py.vimap.edits import remove_missions

    rows = context.mission_rows(map_mission, map_mission_list)
    if rows is None:
        raise UserError("remove_mission: no mission is given; use --map_mission=<id or prefix>")
    labels = queries.mission_labels(context.vi_map)
    ids = ", ".join(labels[row] for row in rows)
    context.confirm(f"remove mission {ids}?", yes=yes)
    context.commit(remove_missions(context.vi_map, rows))
    return Message(f"removed mission {ids}")


@command(
    "remove_mission_interactive", "rmi", example="rmi", see_also=("remove_mission", "visualize")
)
def remove_mission_interactive(context: CommandContext, *, map_mission_list: str = "") -> Message:
    """Go through the missions and ask of each whether to remove it.

    y = remove, n = keep, q = keep this and all further ones. A viewer that is running shows the
    mission that is asked about. The missions are removed after the last question: one `undo` brings
    all of them back, and Ctrl-C at a question removes none.

    Args:
        map_mission_list: Ask about these missions only, separated by commas.
    """
    from maplab_py.vimap.edits import remove_missions

    vi_map = context.vi_map
    rows = context.mission_rows(map_mission_list=map_mission_list)
    asked = np.arange(len(vi_map.missions)) if rows is None else rows
    if context.is_trial:
        return Message(f"would ask about {counted(len(asked), 'mission')}")
    if not context.terminal.is_interactive:
        raise UserError(
            f"{context.command}: nobody is there to answer; in a script use "
            "remove_mission --map_mission_list=ID,ID --yes"
        )
    removed = _missions_to_remove(context, asked.tolist())
    if not removed:
        return Message("no mission is removed")
    labels = queries.mission_labels(vi_map)
    context.commit(remove_missions(vi_map, np.array(removed)))
    names = ", ".join(labels[row] for row in removed)
    return Message(f"removed {counted(len(removed), 'mission')}: {names}")


def _missions_to_remove(context: CommandContext, rows: list[int]) -> list[int]:
    """Ask about each mission (row) and return those to remove."""
    labels, facts = queries.mission_labels(context.vi_map), _mission_facts(context.vi_map)
    removed: list[int] = []
    with _shown_alone(context) as show_mission:
        for place, row in enumerate(rows, start=1):
            show_mission(row)
            context.terminal.note(f"mission {place} of {len(rows)}: {facts[row]}")
            answer = context.terminal.choose(
                f"remove mission {labels[row]}?", ("yes", "no", "quit")
            )
            if answer == "quit":
                break
            if answer == "yes":
                removed.append(row)
    return removed


def _mission_facts(vi_map: VIMap) -> list[str]:
    """Return name, id, length, duration and size of each mission as a line."""
    length_m = queries.mission_distances_m(vi_map)
    duration_s = 1e-9 * np.diff(queries.mission_time_spans_ns(vi_map), axis=1)[:, 0]
    vertices = np.diff(vi_map.vertex_start)
    return [
        f"{name or 'without a name'}, id {to_hex(vi_map.missions.id[row])}, {length_m[row]:.1f} m, "
        f"{duration_s[row]:.1f} s, {counted(int(vertices[row]), 'vertex', 'vertices')}"
        for row, name in enumerate(vi_map.missions.name)
    ]


@contextmanager
def _shown_alone(context: CommandContext) -> Iterator[Callable[[int], None]]:
    """Give a function that shows one mission (row) in the viewer, if one runs and shows the map.

    At the end the viewer shows what it showed before.
    """
    from maplab_plugins.visualization.following import open_viewer
    from maplab_py.viewer.building import Subject
    from maplab_py.vimap.selection import keep_rows

    viewer = open_viewer(context)
    before = None if viewer is None else viewer.wanted
    if viewer is None or before is None or before.title != context.map_key:
        yield lambda _: None
        return
    vi_map = context.vi_map

    def show(row: int) -> None:
        mission = keep_rows(vi_map, missions=np.array([row]))
        if len(mission.vertices):
            viewer.follow(Subject(mission, before.title, before.options))

    try:
        yield show
    finally:
        viewer.follow(before)


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
    old = queries.mission_labels(vi_map)[row]
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
    missions = context.vi_map.missions
    if not len(missions):
        raise UserError(f"{context.command}: map '{context.map_key}' has no missions")
    row = context.mission_row(map_mission) if map_mission else 0
    return _mark(context, row, f"frame of mission {to_hex(missions.id[row])}", is_known=is_known)


def _set_all(context: CommandContext, *, is_known: bool) -> Message:
    frames = f"frames of {counted(len(context.vi_map.missions), 'mission')}"
    return _mark(context, slice(None), frames, is_known=is_known)


def _mark(context: CommandContext, rows: int | slice, frames: str, *, is_known: bool) -> Message:
    vi_map = context.vi_map
    known = vi_map.baseframes.put(vi_map.missions.baseframe[rows], is_known=is_known)
    context.commit(vi_map.replace(baseframes=known))
    return Message(f"base {frames} set to {'known' if is_known else 'unknown'}")


@command("spatially_distribute_missions")
def spatially_distribute_missions(
    context: CommandContext, *, options: LayoutOptions = LayoutOptions()
) -> Message:
    """Shift missions of unknown base frame apart, so that they do not overlap in the viewer."""
    from maplab_py.algorithms.pose_graph_manipulation.layout import distribute_missions

    result, count = distribute_missions(context.vi_map, options)
    context.commit(result)
    if count == 0:
        return Message("the base frames of all missions are known: nothing to move")
    return Message(f"moved {counted(count, 'mission')} of unknown base frame")
