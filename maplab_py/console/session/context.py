"""The context that the console passes to a command."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Concatenate, ParamSpec, TypeVar

import numpy as np

from maplab_py.array_types import I64
from maplab_py.console.session.maps import MapManager
from maplab_py.console.terminal.protocol import Terminal
from maplab_py.errors import UserError
from maplab_py.options import Options
from maplab_py.progress import Progress

if TYPE_CHECKING:
    from maplab_py.console.session.session import Session
    from maplab_py.storage.native import DiskCopy
    from maplab_py.vimap import VIMap


ArgumentsT = ParamSpec("ArgumentsT")
ReportT = TypeVar("ReportT")


class CommandContext:
    """The selected map, progress, and the session around one running command.

    `commit` sets a new value of the selected map. It takes effect when the command succeeds, and never
    if it fails or is cancelled.
    """

    def __init__(
        self,
        session: Session,
        progress: Progress,
        terminal: Terminal,
        command: str = "",
        *,
        is_trial: bool = False,
    ) -> None:
        """Make the context of one call.

        Args:
            session: The session that runs the command.
            terminal: Asks questions.
            command: Name of the command, for messages and the undo history.
            is_trial: Everything that the command does is discarded (--dry_run).
        """
        self.session = session
        self.progress = progress
        self.terminal = terminal
        self.command = command
        self.is_trial = is_trial
        self._drafts: dict[str, VIMap] = {}

    @property
    def maps(self) -> MapManager:
        """All maps in memory by key."""
        return self.session.maps

    @property
    def map_key(self) -> str:
        """Key of the selected map; raises UserError when none is selected."""
        return self.maps.selected.key

    @property
    def vi_map(self) -> VIMap:
        """The selected map, or what this command has committed for it so far.

        Raises:
            UserError: No map is selected.
        """
        entry = self.maps.selected
        return self._drafts.get(entry.key, entry.vi_map)

    @property
    def map_folder(self) -> Path | None:
        """The folder of the selected map; None when it was never loaded or saved."""
        return self.maps.selected.folder

    def commit(self, vi_map: VIMap, key: str = "") -> None:
        """Set the new value of the selected map, or of that of a key."""
        self._drafts[key or self.maps.selected.key] = vi_map

    def apply(
        self,
        edit: Callable[Concatenate[VIMap, ArgumentsT], tuple[VIMap, ReportT]],
        *arguments: ArgumentsT.args,
        **named: ArgumentsT.kwargs,
    ) -> ReportT:
        """Commit what an edit of the selected map returns, and return its report.

        An edit that reports its progress reports that of the command.
        """
        if "progress" in inspect.signature(edit).parameters:
            named.setdefault("progress", self.progress)
        vi_map, report = edit(self.vi_map, *arguments, **named)
        self.commit(vi_map)
        return report

    @property
    def has_drafts(self) -> bool:
        """Tell whether the command has committed anything."""
        return bool(self._drafts)

    def apply_drafts(self) -> None:
        """Apply the committed values to the maps; called by the session when the command succeeds."""
        from maplab_py.console.session.maps import UndoOptions, bounded

        for key, vi_map in self._drafts.items():
            if key in self.maps:
                entry = self.maps.get(key).with_value(vi_map, self.command)
                self.maps.update(bounded(entry, UndoOptions.of(self.session.settings)))
        self._drafts.clear()

    def mark_saved(self, key: str, folder: Path, disk_copy: DiskCopy) -> None:
        """Record that the present value of a map is on disk."""
        entry = self.maps.get(key)
        self.maps.update(
            dataclasses.replace(entry, saved=entry.vi_map, folder=folder, disk_copy=disk_copy)
        )

    def mission_rows(self, map_mission: str = "", map_mission_list: str = "") -> I64 | None:
        """Return the rows of the missions that the user chose, None when he chose none (all).

        Args:
            map_mission: Id or unambiguous prefix of one mission.
            map_mission_list: Several, separated by commas.

        Raises:
            UserError: An id is unknown or ambiguous; the message lists the candidates.
        """
        return MissionChoice(map_mission, map_mission_list).rows(self.vi_map)

    def mission_row(self, map_mission: str) -> int:
        """Return the row of one mission; without an id the map must have just one.

        Raises:
            UserError: The id is unknown or ambiguous, or it is empty and the map has not exactly
                one mission.
        """
        from maplab_py.vimap.queries import find_mission

        if map_mission or len(self.vi_map.missions) != 1:
            return int(find_mission(self.vi_map, map_mission))
        return 0

    def snapshot(self, name: str) -> VIMap:
        """Return a snapshot of the selected map.

        Raises:
            UserError: The map has no snapshot of this name; the message lists those that it has.
        """
        entry = self.maps.selected
        if name not in entry.snapshots:
            known = ", ".join(entry.snapshots) or "none"
            raise UserError(
                f"{self.command}: map '{entry.key}' has no snapshot '{name}' (there are: {known})"
            )
        return entry.snapshots[name]

    def announce(self, topic: str, text: str) -> None:
        """Show a short text in the toolbar of the prompt until it is announced empty.

        Args:
            topic: What it is about, such as "viewer"; a later text of the topic replaces it.
            text: What to show, such as an address; empty = remove it.
        """
        self.session.marks[topic] = text

    def confirm(self, question: str, *, yes: bool) -> None:
        """Ask for confirmation before data are removed.

        Args:
            question: What will happen, as a question.
            yes: The user has already agreed (the command's flag --yes).

        Raises:
            UserError: The answer is no, or nobody is there to answer.
        """
        if yes or self.is_trial:
            return
        if not self.terminal.is_interactive:
            raise UserError(
                f"{self.command}: confirmation is needed: {question} (give --yes to agree)"
            )
        if not self.terminal.ask(question):
            raise UserError(f"{self.command}: not confirmed")


class MissionChoice(Options):
    """Missions to work on; all if none is given."""

    map_mission: str = ""
    """Mission id or unambiguous prefix; empty = all missions"""
    map_mission_list: str = ""
    """Several missions, separated by commas"""

    def rows(self, vi_map: VIMap) -> I64 | None:
        """Return the rows of the chosen missions in ascending order, None if none is given (all).

        Raises:
            UserError: An id is unknown or ambiguous; the message lists the candidates.
        """
        from maplab_py.vimap.queries import find_mission

        prefixes = [
            part.strip() for part in f"{self.map_mission},{self.map_mission_list}".split(",")
        ]
        chosen = [prefix for prefix in prefixes if prefix]
        if not chosen:
            return None
        rows = [find_mission(vi_map, prefix) for prefix in chosen]
        return np.array(sorted(set(rows)), dtype=np.int64)


ALL_MISSIONS = MissionChoice()
