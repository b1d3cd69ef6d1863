"""Watchers observe the maps of a session, as the viewer does. They never change maps."""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Protocol, TypeVar, runtime_checkable

from maplab_py.console.session.log import log_path
from maplab_py.console.session.maps import MapManager

if TYPE_CHECKING:
    from maplab_py.vimap import VIMap

logger = logging.getLogger(__name__)

WatcherT = TypeVar("WatcherT")


class Watcher(Protocol):
    """Observer of the maps of a session."""

    def after_command(self, maps: MapManager) -> None:
        """Observe the maps after a command; also called if the command failed."""

    def during_command(self, make_map: Callable[[], VIMap]) -> None:
        """Observe the intermediate result of a running command; calling `make_map` is optional."""

    def close(self) -> None:
        """Stop observing: the session ends."""


@runtime_checkable
class LineWatcher(Protocol):
    """A watcher that also observes the lines that are typed at the prompt."""

    def after_line(self, line: str, *, succeeded: bool) -> None:
        """Observe a line whose reports have been shown."""


class Watchers:
    """The watchers of a session by name.

    An error in a watcher never fails a command: the traceback goes to the log, and the user sees one
    message until the watcher works again.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        """Start without watchers; `say` prints a line for the user."""
        self._watchers: dict[str, Watcher] = {}
        self._say = say
        self._told: set[str] = set()

    def set(self, name: str, watcher: Watcher) -> None:
        """Add a watcher, or replace the one of this name."""
        self._watchers[name] = watcher

    def find(self, name: str, kind: type[WatcherT]) -> WatcherT | None:
        """Return the watcher of this name and type, None if there is none."""
        watcher = self._watchers.get(name)
        return watcher if isinstance(watcher, kind) else None

    def remove(self, name: str) -> None:
        """Close and remove a watcher."""
        watcher = self._watchers.pop(name, None)
        if watcher is not None:
            self._guard(name, watcher.close)
        self._told.discard(name)

    def after_command(self, maps: MapManager) -> None:
        """Notify all watchers."""
        for name, watcher in list(self._watchers.items()):
            if self._guard(name, partial(watcher.after_command, maps)):
                self._told.discard(name)

    def during_command(self, make_map: Callable[[], VIMap]) -> None:
        """Notify all watchers of an intermediate result."""
        for name, watcher in list(self._watchers.items()):
            self._guard(name, partial(watcher.during_command, make_map))

    def after_line(self, line: str, *, succeeded: bool) -> None:
        """Notify the watchers that observe typed lines."""
        for name, watcher in list(self._watchers.items()):
            if isinstance(watcher, LineWatcher):
                self._guard(name, partial(watcher.after_line, line, succeeded=succeeded))

    def close(self) -> None:
        """Close all."""
        for name in list(self._watchers):
            self.remove(name)

    def _guard(self, name: str, action: Callable[[], None]) -> bool:
        try:
            action()
        except Exception:
            logger.exception("the %s failed", name)
            if name not in self._told:
                self._told.add(name)
                self._say(f"the {name} could not follow the map (see {log_path()})")
            return False
        return True
