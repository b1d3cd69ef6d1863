"""Maps that a script leaves unsaved are kept in the user's state folder, where `recover` finds them."""

from __future__ import annotations

import copy
import os
import shutil
import time
import weakref
from pathlib import Path
from typing import TYPE_CHECKING

from maplab_py.console.session import maps, paths
from maplab_py.console.session.session import Session
from maplab_py.console.terminal.protocol import SilentTerminal

if TYPE_CHECKING:
    from maplab_py.vimap import VIMap

_STAMP = "%Y-%m-%d_%H-%M-%S"
MOST_RUNS = 5
"""Older rescued maps are deleted: a script that fails every night must not fill the disk."""


def rescue_folder() -> Path:
    """Return the folder with one sub-folder per script that left maps unsaved."""
    return paths.state_folder() / "rescued"


def rescued_runs() -> list[Path]:
    """Return the folders of scripts that left maps unsaved, the newest last."""
    folder = rescue_folder()
    return sorted(path for path in folder.iterdir() if path.is_dir()) if folder.is_dir() else []


class Rescue:
    """Copies of the unsaved maps of one script: made at its end, and while it runs in case it is killed."""

    def __init__(self, session: Session) -> None:
        """Start without copies.

        Args:
            session: The session of the script; it does not change.
        """
        self._session = session
        self._folder = rescue_folder() / f"{time.strftime(_STAMP, time.gmtime())}_{os.getpid()}"
        self._copies: dict[str, weakref.ref[VIMap]] = {}
        self._time = time.monotonic()
        self._cost_s = 0.0

    def update(self, interval_s: float) -> None:
        """Copy what is unsaved if work of `interval_s`, and of ten copies, would be lost; 0 = always."""
        elapsed_s = time.monotonic() - self._time
        if elapsed_s >= (max(interval_s, 10.0 * self._cost_s) if interval_s > 0.0 else 0.0):
            self.save()

    def save(self) -> Path:
        """Copy the unsaved maps, remove the copies of others, and return their folder.

        Raises:
            MaplabError: A map cannot be written.
        """
        began = time.monotonic()
        unsaved = {entry.key: entry for entry in self._session.maps.unsaved}
        for key in self._copies.keys() - unsaved.keys():
            del self._copies[key]
            shutil.rmtree(self._folder / key, ignore_errors=True)
        draft = copy.copy(self._session)
        draft.maps, draft.terminal = maps.MapManager(draft.maps.state), SilentTerminal()
        for key, entry in unsaved.items():
            if key in self._copies and self._copies[key]() is entry.vi_map:
                continue
            draft.maps.select(key)
            draft.run("save", map_folder=self._folder / key, overwrite=True)
            self._copies[key] = weakref.ref(entry.vi_map)
        if not self._copies:
            shutil.rmtree(self._folder, ignore_errors=True)
        for old in rescued_runs()[:-MOST_RUNS]:
            shutil.rmtree(old, ignore_errors=True)
        self._time = time.monotonic()
        self._cost_s = self._time - began
        return self._folder

    def remove(self) -> None:
        """Remove all copies, as at the end of a script that has saved its maps."""
        if self._copies:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._copies.clear()
