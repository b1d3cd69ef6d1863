"""What lives beside a session and follows its maps, as the viewer does. Watchers never change maps."""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import partial
from typing import Protocol, TypeVar

from maplab_py.console.log import log_path
from maplab_py.console.maps import MapManager
from maplab_py.vimap import VIMap

logger = logging.getLogger(__name__)

WatcherT = TypeVar("WatcherT")


class Watcher(Protocol):
    """Follows the maps of a session."""

    def after_command(self, maps: MapManager) -> None:
        """Look at the maps after a command; called whether or not the command went well."""

    def during_command(self, make_map: Callable[[], VIMap]) -> None:
        """Look at what a running command has so far; `make_map` need not be called."""

    def close(self) -> None:
        """Stop following: the session ends."""


class Watchers:
    """The watchers of a session by name.

    An error of theirs never fails a command: the traceback goes to the log, and the user is told
    once, until the watcher follows again.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        """Start without any; `say` tells the user something in a line."""
        self._watchers: dict[str, Watcher] = {}
        self._say = say
        self._told: set[str] = set()

    def set(self, name: str, watcher: Watcher) -> None:
        """Add a watcher, or exchange the one of this name."""
        self._watchers[name] = watcher

    def find(self, name: str, kind: type[WatcherT]) -> WatcherT | None:
        """Return the watcher of this name, if there is one of this kind."""
        found = self._watchers.get(name)
        return found if isinstance(found, kind) else None

    def remove(self, name: str) -> None:
        """Close a watcher and forget it."""
        watcher = self._watchers.pop(name, None)
        if watcher is not None:
            self._guarded(name, watcher.close)
        self._told.discard(name)

    def after_command(self, maps: MapManager) -> None:
        """Let all look at the maps."""
        for name, watcher in list(self._watchers.items()):
            if self._guarded(name, partial(watcher.after_command, maps)):
                self._told.discard(name)

    def during_command(self, make_map: Callable[[], VIMap]) -> None:
        """Let all look at what a running command has so far."""
        for name, watcher in list(self._watchers.items()):
            self._guarded(name, partial(watcher.during_command, make_map))

    def close(self) -> None:
        """Close all."""
        for name in list(self._watchers):
            self.remove(name)

    def _guarded(self, name: str, action: Callable[[], None]) -> bool:
        try:
            action()
        except Exception:
            logger.exception("the %s failed", name)
            if name not in self._told:
                self._told.add(name)
                self._say(f"the {name} could not follow the map (see {log_path()})")
            return False
        return True
