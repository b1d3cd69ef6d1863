"""The maps in memory: list, select, make, copy, rename, merge, drop."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

from maplab_py.plugin import CommandContext, Message, Report, UserError, command
from maplab_py.vimap import VIMap

if TYPE_CHECKING:
    from maplab_py.vimap.merge import MergeReport


@dataclasses.dataclass(frozen=True)
class MapLine:
    """One map in memory."""

    map_key: str
    state: str
    missions: int
    vertices: int
    landmarks: int
    folder: Path | None


@dataclasses.dataclass(frozen=True)
class MapList(Report):
    """All maps in memory."""

    selected: str
    maps: tuple[MapLine, ...]


@command("list", "ls", "list_maps", needs_map=False)
def list_maps(context: CommandContext) -> MapList | Message:
    """List the maps in memory."""
    if not len(context.maps):
        return Message("no maps in memory")
    lines = tuple(
        MapLine(
            entry.key,
            "saved" if entry.is_saved else "unsaved",
            len(entry.vi_map.missions),
            len(entry.vi_map.vertices),
            len(entry.vi_map.landmarks),
            entry.folder,
        )
        for entry in context.maps
    )
    return MapList(context.maps.selected_key, lines)


@command("select_map", "select", example="select_map v1_01", needs_map=False)
def select_map(context: CommandContext, map_key: str) -> Message:
    """Make a map in memory the one that commands work on.

    Args:
        map_key: Key of the map.
    """
    context.maps.select(map_key)
    return Message(f"map '{map_key}' is selected")


@command("create_new_map", example="create_new_map merged", needs_map=False)
def create_new_map(context: CommandContext, map_key: str) -> Message:
    """Make an empty map and select it.

    Args:
        map_key: Its key: letters, digits, - and _.
    """
    context.maps.add(map_key, VIMap())
    return Message(f"new map '{map_key}' is selected")


@command("delete_map", "delete", example="delete_map --yes", see_also=("clear_storage",))
def delete_map(context: CommandContext, map_key: str = "", *, yes: bool = False) -> Message:
    """Drop a map from memory; its files stay.

    Args:
        map_key: Key of the map; empty = the selected one.
        yes: Do not ask.
    """
    key = map_key or context.map_key
    entry = context.maps.get(key)
    note = "" if entry.is_saved else " with its unsaved changes"
    context.confirm(f"drop map '{key}'{note} from memory?", yes=yes)
    context.maps.remove(key)
    return Message(f"map '{key}' is dropped{_selection(context)}")


@command("clear_storage", example="clear_storage --yes", see_also=("delete_map",), needs_map=False)
def clear_storage(context: CommandContext, *, yes: bool = False) -> Message:
    """Drop all maps from memory; their files stay.

    Args:
        yes: Do not ask.
    """
    count = len(context.maps)
    if not count:
        return Message("no maps in memory")
    unsaved = ", ".join(entry.key for entry in context.maps.unsaved)
    note = f" (unsaved: {unsaved})" if unsaved else ""
    context.confirm(f"drop all {count} maps from memory{note}?", yes=yes)
    for key in context.maps.keys:
        context.maps.remove(key)
    return Message(f"{count} maps are dropped")


@command("rename_map", "rename", example="rename_map --map_key=v1_01")
def rename_map(context: CommandContext, map_key: str) -> Message:
    """Give the selected map another key.

    Args:
        map_key: The new key.
    """
    old = context.map_key
    context.maps.rename(old, map_key)
    return Message(f"map '{old}' is now '{map_key}'")


@command("copy_map", example="copy_map --target_map_key=experiment")
def copy_map(context: CommandContext, target_map_key: str) -> Message:
    """Copy the selected map in memory; the copy is not selected and has no folder of its own.

    Args:
        target_map_key: Key of the copy.
    """
    context.maps.add(target_map_key, context.vi_map, select=False)
    return Message(f"map '{context.map_key}' is copied to '{target_map_key}'")


@command("merge_map", example="merge_map --map_key=v1_02", see_also=("join_all_maps",))
def merge_map(
    context: CommandContext, map_key: str, *, assign_new_ids: bool = False
) -> MergeReport:
    """Merge another map in memory into the selected one; the other stays as it is.

    Args:
        map_key: Key of the map to merge in.
        assign_new_ids: Give the merged-in missions, vertices and landmarks new ids.
    """
    from maplab_py.vimap.merge import merge_maps

    if map_key == context.map_key:
        raise UserError(f"merge_map: '{map_key}' is the selected map; name another one")
    other = context.maps.get(map_key)
    merged, report = merge_maps(context.vi_map, other.vi_map, assign_new_ids=assign_new_ids)
    context.commit(merged)
    return report


@command("join_all_maps", example="join_all_maps --target_map_key=all", needs_map=False)
def join_all_maps(
    context: CommandContext, target_map_key: str, *, assign_new_ids: bool = False
) -> MergeReport:
    """Merge all maps in memory into a new one and drop them.

    Args:
        target_map_key: Key of the new map, which is selected.
        assign_new_ids: Give the merged-in missions, vertices and landmarks new ids.
    """
    from maplab_py.vimap.merge import merge_maps

    entries = list(context.maps)
    if len(entries) < 2:
        raise UserError(f"join_all_maps: two or more maps are wanted, {len(entries)} in memory")
    if target_map_key not in context.maps:
        context.maps.check_new_key(target_map_key)
    joined = entries[0].vi_map
    for done, entry in enumerate(entries[1:], start=1):
        context.progress.step(done, len(entries), f"merge {entry.key}")
        joined, report = merge_maps(joined, entry.vi_map, assign_new_ids=assign_new_ids)
    for entry in entries:
        context.maps.remove(entry.key)
    context.maps.add(target_map_key, joined)
    return report


def _selection(context: CommandContext) -> str:
    key = context.maps.selected_key
    return f"; '{key}' is selected now" if key else ""
