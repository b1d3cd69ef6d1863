"""Undo, redo and snapshots of the selected map: maps are immutable, so these need little memory."""

from __future__ import annotations

import dataclasses

from maplab_py.plugin import CommandContext, Message, Report, UserError, command


@dataclasses.dataclass(frozen=True)
class HistoryLine:
    """One command that changed the map."""

    command: str
    state: str


@dataclasses.dataclass(frozen=True)
class MapHistory(Report):
    """The commands that led to the present value of a map, then the undone ones."""

    commands: tuple[HistoryLine, ...] = dataclasses.field(metadata={"title": ""})


@dataclasses.dataclass(frozen=True)
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
