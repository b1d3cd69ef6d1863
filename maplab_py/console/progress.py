"""Progress on a terminal: a bar with the remaining time for what takes over a second."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, TextIO

from maplab_py.console.interrupt import check_cancelled
from maplab_py.console.render import wants_colour

if TYPE_CHECKING:
    from rich.progress import Progress as RichProgress

SECONDS_BEFORE_BAR = 1.0
SECONDS_BETWEEN_UPDATES = 0.1


class TerminalProgress:
    """Progress of one command. Where the stream is no terminal it is quiet.

    A verbosity above zero prints the lines of intermediate results everywhere.
    """

    def __init__(self, stream: TextIO, verbosity: int = 0) -> None:
        """Start the clock of one command."""
        self._stream = stream
        self._is_live = wants_colour(stream)
        self._prints_lines = stream.isatty() or verbosity > 0
        self._start = time.monotonic()
        self._updated = 0.0
        self._bar: RichProgress | None = None
        self._task: Any = None

    def step(self, done: float, total: float, what: str = "") -> None:
        """Say that `done` of `total` is finished.

        Raises:
            Cancelled: The user has asked to stop.
        """
        check_cancelled()
        now = time.monotonic()
        if not self._is_live or now - self._start < SECONDS_BEFORE_BAR:
            return
        if now - self._updated < SECONDS_BETWEEN_UPDATES and done < total:
            return
        self._updated = now
        self._update(done, total, what)

    def line(self, text: str) -> None:
        """Print one line of intermediate result."""
        if not self._prints_lines:
            return
        if self._bar is not None:
            self._bar.console.print(text, markup=False, highlight=False)
        else:
            self._stream.write(text + "\n")
            self._stream.flush()

    def check(self) -> None:
        """Raise Cancelled when the user has asked to stop."""
        check_cancelled()

    def close(self) -> None:
        """Remove the bar."""
        if self._bar is not None:
            self._bar.stop()
            self._bar = None

    def _update(self, done: float, total: float, what: str) -> None:
        if self._bar is None:
            from rich.console import Console
            from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeRemainingColumn
            from rich.progress import Progress as Bar

            self._bar = Bar(
                TextColumn("{task.description}"),
                BarColumn(),
                TaskProgressColumn(),
                TimeRemainingColumn(),
                console=Console(file=self._stream),
                transient=True,
            )
            self._bar.start()
            self._task = self._bar.add_task(what, total=total)
        self._bar.update(self._task, completed=done, total=total, description=what)
