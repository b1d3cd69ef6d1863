"""Maps in memory, and their history."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

from maplab_py.plugin import CommandContext, Message, Report, UserError, command
from maplab_py.report import counted, view
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


class MapList(Report):
    """All maps in memory."""

    selected: str
    maps: tuple[MapLine, ...]

    def display(self) -> Any:
        """Return one table in which the selected map is marked."""
        lines = tuple(
            dataclasses.replace(map_, state=f"selected, {map_.state}")
            if map_.map_key == self.selected
            else map_
            for map_ in self.maps
        )
        return view({"maps": ""}, maps=lines)


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


@command("select_map", "select", example="select_map v1_01", needs_map=False, reads=("map_key",))
def select_map(context: CommandContext, map_key: str) -> Message:
    """Make a map in memory the one that commands work on.

    Args:
        map_key: Key of the map.
    """
    context.maps.select(map_key)
    return Message(f"selected map '{map_key}'")


@command("create_new_map", example="create_new_map merged", needs_map=False)
def create_new_map(context: CommandContext, map_key: str) -> Message:
    """Create an empty map and select it.

    Args:
        map_key: Key of the new map: letters, digits, - and _.
    """
    context.maps.add(map_key, VIMap())
    return Message(f"created and selected map '{map_key}'")


@command("delete_map", "delete", example="delete_map --yes", see_also=("clear_storage",))
def delete_map(context: CommandContext, map_key: str = "", *, yes: bool = False) -> Message:
    """Remove a map from memory; its files stay.

    Args:
        map_key: Key of the map; empty = the selected one.
    """
    key = map_key or context.map_key
    entry = context.maps.get(key)
    note = "" if entry.is_saved else " with its unsaved changes"
    context.confirm(f"remove map '{key}'{note} from memory?", yes=yes)
    context.maps.remove(key)
    return Message(f"removed map '{key}' from memory{_selection(context)}")


@command("clear_storage", example="clear_storage --yes", see_also=("delete_map",), needs_map=False)
def clear_storage(context: CommandContext, *, yes: bool = False) -> Message:
    """Remove all maps from memory; their files stay."""
    count = len(context.maps)
    if not count:
        return Message("no maps in memory")
    unsaved = ", ".join(entry.key for entry in context.maps.unsaved)
    note = f" (unsaved: {unsaved})" if unsaved else ""
    context.confirm(f"remove {counted(count, 'map')} from memory{note}?", yes=yes)
    for key in context.maps.keys:
        context.maps.remove(key)
    return Message(f"removed {counted(count, 'map')} from memory")


@command("rename_map", "rename", example="rename_map --map_key=v1_01")
def rename_map(context: CommandContext, map_key: str) -> Message:
    """Give the selected map another key.

    Args:
        map_key: The new key.
    """
    old = context.map_key
    context.maps.rename(old, map_key)
    return Message(f"renamed map '{old}' to '{map_key}'")


@command("copy_map", example="copy_map --target_map_key=experiment")
def copy_map(context: CommandContext, target_map_key: str) -> Message:
    """Copy the selected map in memory; the copy is not selected and has no folder.

    Args:
        target_map_key: Key of the copy.
    """
    context.maps.add(target_map_key, context.vi_map, select=False)
    return Message(f"copied map '{context.map_key}' to '{target_map_key}'")


@command(
    "merge_map",
    example="merge_map --map_key=v1_02",
    see_also=("join_all_maps",),
    reads=("map_key",),
)
def merge_map(
    context: CommandContext, map_key: str, *, assign_new_ids: bool = False
) -> MergeReport:
    """Merge another map in memory into the selected one; the other stays as it is.

    Args:
        map_key: Key of the map to merge in.
        assign_new_ids: Give the merged-in missions, vertices and landmarks new ids.
    """
    from maplab_py.vimap.merge import at_folder, merge_maps

    if map_key == context.map_key:
        raise UserError(f"merge_map: '{map_key}' is the selected map; name another one")
    entry = context.maps.get(map_key)
    other = at_folder(entry.vi_map, entry.folder)
    return context.apply(merge_maps, other, assign_new_ids=assign_new_ids)


@command("join_all_maps", example="join_all_maps --target_map_key=all", needs_map=False)
def join_all_maps(
    context: CommandContext, target_map_key: str, *, assign_new_ids: bool = False
) -> MergeReport:
    """Merge all maps in memory into a new map and remove the originals from memory.

    Args:
        target_map_key: Key of the new map, which is selected.
        assign_new_ids: Give the merged-in missions, vertices and landmarks new ids.
    """
    from maplab_py.vimap.merge import merge_maps, without_folder

    entries = list(context.maps)
    if len(entries) < 2:
        raise UserError(f"join_all_maps: needs two or more maps, {len(entries)} in memory")
    if target_map_key not in context.maps:
        context.maps.check_new_key(target_map_key)
    joined = without_folder(entries[0].vi_map, entries[0].folder)
    for done, entry in enumerate(entries[1:], start=1):
        context.progress.step(done, len(entries), f"merge {entry.key}")
        other = without_folder(entry.vi_map, entry.folder)
        joined, report = merge_maps(joined, other, assign_new_ids=assign_new_ids)
    for entry in entries:
        context.maps.remove(entry.key)
    context.maps.add(target_map_key, joined)
    return report


def _selection(context: CommandContext) -> str:
    key = context.maps.selected_key
    return f"; selected: '{key}'" if key else ""


@dataclasses.dataclass(frozen=True)
class HistoryLine:
    """One command that changed the map."""

    command: str
    state: str


class MapHistory(Report):
    """The commands that led to the present value of a map, then the undone ones."""

    commands: tuple[HistoryLine, ...] = dataclasses.field(metadata={"title": ""})


class MapScript(Report):
    """The commands that lead to the present value of a map, in a new session."""

    commands: tuple[str, ...]

    @property
    def is_verbatim(self) -> bool:
        """Return True: lines of a script are copied."""
        return True

    def as_text(self) -> str:
        """Return the script."""
        return "\n".join(self.commands)


@command("history", example="history --as_script", see_also=("undo", "snapshot"))
def history(context: CommandContext, *, as_script: bool = False) -> MapHistory | MapScript:
    """Show the commands that led to the present value of the selected map, and the undone ones.

    Args:
        as_script: Write them as a script for `maplab run`, undone ones left out, with all flags
            that were in force: `history --as_script > steps.maplab`.
    """
    from maplab_py.console.session.provenance import script_text

    entry = context.maps.selected
    script = context.session.provenance.script_of(entry)
    if not script:
        raise UserError(
            f"history: how map '{entry.key}' came about is not known: it was made from Python"
        )
    if as_script:
        return MapScript(tuple(script_text(script)))
    undone = tuple(HistoryLine(step.command, "undone") for step in entry.future)
    return MapHistory(tuple(HistoryLine(line, "") for line in script_text(script)) + undone)


@command("undo", see_also=("redo", "snapshot"))
def undo(context: CommandContext) -> Message:
    """Undo the last change of the selected map."""
    entry = context.maps.selected
    undone = entry.undone()
    context.maps.update(undone)
    return Message(f"'{entry.past[-1].command}' undone; {len(undone.past)} more can be undone")


@command("redo", see_also=("undo",))
def redo(context: CommandContext) -> Message:
    """Redo the last undone change of the selected map."""
    entry = context.maps.selected
    redone = entry.redone()
    context.maps.update(redone)
    return Message(f"'{entry.future[0].command}' redone")


@command("snapshot", example="snapshot before_relax", see_also=("restore",))
def snapshot(context: CommandContext, name: str = "") -> Message:
    """Store the present state of the selected map; without a name list the snapshots.

    Args:
        name: Name of the snapshot; an older one of the same name is replaced.
    """
    entry = context.maps.selected
    if not name:
        return Message("snapshots: " + (", ".join(entry.snapshots) or "none"))
    snapshots = {**entry.snapshots, name: entry.vi_map}
    context.maps.update(dataclasses.replace(entry, snapshots=snapshots))
    return Message(f"stored snapshot '{name}' of map '{entry.key}'")


@command(
    "restore",
    example="restore before_relax",
    see_also=("snapshot", "undo"),
    completes={"name": "snapshot"},
)
def restore(context: CommandContext, name: str) -> Message:
    """Restore the selected map from a snapshot; undo reverts this.

    Args:
        name: Name of the snapshot.
    """
    context.commit(context.snapshot(name))
    return Message(f"restored map '{context.map_key}' from snapshot '{name}'")
