"""Rate-limited updates of the viewer with the published map."""

from __future__ import annotations

import time
from collections.abc import Callable

from maplab_py.vimap import VIMap


class Display:
    """Shows the latest published map at most every so often; building a scene takes time, too."""

    def __init__(self, watch: Callable[[VIMap], None] | None, interval_s: float) -> None:
        """Show nothing yet.

        Args:
            watch: Gets maps; None = nobody looks.
            interval_s: Shortest time between two maps [s].
        """
        self._watch, self._interval_s = watch, interval_s
        self._waiting: VIMap | None = None
        self._next_s = 0.0

    def offer(self, vi_map: VIMap | None) -> None:
        """Take a map that has just been published, and show it now or later."""
        self._waiting = vi_map
        self.show()

    def show(self, *, at_once: bool = False) -> None:
        """Show the map that waits if its time has come, or at once."""
        is_due = at_once or time.monotonic() >= self._next_s
        if self._watch is None or self._waiting is None or not is_due:
            return
        vi_map, self._waiting = self._waiting, None
        self._watch(vi_map)
        self._next_s = time.monotonic() + self._interval_s
