"""Progress on a terminal: a bar with the remaining time after one second."""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING, Any, TextIO

from maplab_py.cancellation import current_token
from maplab_py.console.terminal.render import wants_colour
from maplab_py.console.terminal.streams import write_message

if TYPE_CHECKING:
    from rich.progress import Progress as RichProgress

SECONDS_BEFORE_BAR = 1.0
SECONDS_BETWEEN_UPDATES = 0.1
_COLUMNS_OF_BAR = 38
"""Width of the bar with its times where it is shortest."""


class TerminalProgress:
    """Progress of one command. It is quiet if the stream is no terminal.

    A verbosity above zero prints the lines of intermediate results everywhere.
    """

    def __init__(self, stream: TextIO, verbosity: int = 0, what: str = "") -> None:
        """Start the clock of one command.

        Args:
            stream: Where the bar goes.
            verbosity: Above zero: print lines of intermediate results everywhere.
            what: Shown until the command names its current step.
        """
        self._stream = stream
        self._token = current_token()
        self._what = what
        self._is_live = wants_colour(stream)
        self._prints_lines = stream.isatty() or verbosity > 0
        self._start = time.monotonic()
        self._updated = 0.0
        self._lock = threading.Lock()
        self._bar: RichProgress | None = None
        self._task: Any = None
        self._is_closed = False

    def step(self, done: float, total: float, what: str = "") -> None:
        """Say that `done` of `total` is finished; a total of 0 is not known.

        Raises:
            Cancelled: The user has asked to stop.
        """
        self._token.check()
        now = time.monotonic()
        if not self._is_live or now - self._start < SECONDS_BEFORE_BAR:
            return
        is_end = 0.0 < total <= done
        if now - self._updated < SECONDS_BETWEEN_UPDATES and not is_end:
            return
        self._updated = now
        self._update(done, total or None, what or self._what)

    def tick(self) -> None:
        """Show that a silent command is running; any thread may call this."""
        is_late = time.monotonic() - self._start > SECONDS_BEFORE_BAR
        if self._is_live and self._bar is None and is_late:
            self._update(0, None, self._what)

    def line(self, text: str) -> None:
        """Print one line of intermediate result."""
        if not self._prints_lines or self._token.abandoned:
            return
        with self._lock:
            if self._bar is not None:
                self._bar.console.print(text, markup=False, highlight=False)
            else:
                write_message(self._stream, text)

    def check(self) -> None:
        """Raise Cancelled when the user has asked to stop."""
        self._token.check()

    def hide(self) -> None:
        """Remove the bar before other output; it may reappear later."""
        with self._lock:
            self._start = time.monotonic()
            if self._bar is not None:
                self._bar.stop()
                self._bar = None

    def close(self) -> None:
        """Remove the bar for good."""
        with self._lock:
            self._is_closed = True
            if self._bar is not None:
                self._bar.stop()
                self._bar = None

    def _update(self, done: float, total: float | None, what: str) -> None:
        with self._lock:
            if self._is_closed:
                return
            if self._bar is None:
                self._bar = _make_bar(self._stream)
                self._bar.start()
                self._task = self._bar.add_task(self._cut(self._bar, what), total=total)
            text = self._cut(self._bar, what)
            self._bar.update(self._task, completed=done, total=total, description=text)

    @staticmethod
    def _cut(bar: RichProgress, what: str) -> str:
        """Return the name of a step as long as the line has room for."""
        width = max(bar.console.width - _COLUMNS_OF_BAR, 1)
        return what if len(what) <= width else f"{what[: width - 1]}…"


def _make_bar(stream: TextIO) -> RichProgress:
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        Task,
        TaskProgressColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )
    from rich.table import Column
    from rich.text import Text

    class RemainingColumn(TimeRemainingColumn):
        """The time that is left; empty until it can be estimated."""

        def render(self, task: Task) -> Text:
            if task.total is None or task.time_remaining is None:
                return Text()
            return super().render(task).append(" left", "dim")

    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TaskProgressColumn(table_column=Column(no_wrap=True)),
        RemainingColumn(table_column=Column(no_wrap=True)),
        TimeElapsedColumn(table_column=Column(no_wrap=True)),
        TextColumn("elapsed", style="dim"),
        console=Console(file=stream),
        transient=True,
        redirect_stdout=False,  # the streams are swapped by the prompt too, in its own order
        redirect_stderr=False,
    )
