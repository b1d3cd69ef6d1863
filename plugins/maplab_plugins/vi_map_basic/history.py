"""Undo, redo and snapshots of the selected map: maps are values, so they cost nothing."""

from __future__ import annotations

import dataclasses

from maplab_py.plugin import CommandContext, Message, UserError, command


@command("undo", see_also=("redo", "snapshot"))
def undo(context: CommandContext) -> Message:
    """Take back the last change of the selected map."""
    entry = context.maps.selected
    undone = entry.undone()
    context.maps.update(undone)
    return Message(f"'{entry.past[-1].command}' is undone; {len(undone.past)} more can be")


@command("redo", see_also=("undo",))
def redo(context: CommandContext) -> Message:
    """Bring the last undone change of the selected map back."""
    entry = context.maps.selected
    redone = entry.redone()
    context.maps.update(redone)
    return Message(f"'{entry.future[0].command}' is done again")


@command("snapshot", example="snapshot before_relax", see_also=("restore",))
def snapshot(context: CommandContext, name: str = "") -> Message:
    """Remember the selected map as it is now; without a name list what is remembered.

    Args:
        name: Name of the snapshot; an older one of the same name is replaced.
    """
    entry = context.maps.selected
    if not name:
        return Message("snapshots: " + (", ".join(entry.snapshots) or "none"))
    snapshots = {**entry.snapshots, name: entry.vi_map}
    context.maps.update(dataclasses.replace(entry, snapshots=snapshots))
    return Message(f"snapshot '{name}' of map '{entry.key}'")


@command("restore", example="restore before_relax", see_also=("snapshot", "undo"))
def restore(context: CommandContext, name: str) -> Message:
    """Give the selected map the value that a snapshot remembers; undo takes it back.

    Args:
        name: Name of the snapshot.
    """
    entry = context.maps.selected
    if name not in entry.snapshots:
        known = ", ".join(entry.snapshots) or "none"
        raise UserError(f"restore: map '{entry.key}' has no snapshot '{name}' (there are: {known})")
    context.commit(entry.snapshots[name])
    return Message(f"map '{entry.key}' is as in snapshot '{name}'")
