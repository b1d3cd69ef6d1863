"""The stages of a running pipeline: a table that follows on a terminal, lines elsewhere."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Any, Protocol, Self

from maplab_py.console.terminal.output import ConsoleTerminal
from maplab_py.console.terminal.render import wants_colour

if TYPE_CHECKING:
    from rich.live import Live

_COLUMNS = ("waiting", "running", "done", "kept", "failed")


class StageCounts(Protocol):
    """Tasks of a stage, counted."""

    stage: str
    waiting: int
    running: int
    done: int
    kept: int
    failed: int


class StageTable:
    """Shows how many tasks of each stage wait, run and have ended."""

    def __init__(self, terminal: ConsoleTerminal) -> None:
        """Prepare the table.

        Args:
            terminal: Gets the lines.
        """
        self._terminal = terminal
        self._live: Live | None = None

    def __enter__(self) -> Self:
        """Start to follow, if standard error is a terminal."""
        if wants_colour(sys.stderr):
            from rich.console import Console
            from rich.live import Live

            self._live = Live(console=Console(stderr=True), transient=True, refresh_per_second=4)
            self._live.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Remove the table; the report follows."""
        if self._live is not None:
            self._live.stop()

    def line(self, text: str) -> None:
        """Print a line above the table."""
        if self._live is not None:
            self._live.console.print(text, markup=False, highlight=False)
        else:
            self._terminal.note(text)

    def show(self, stages: Sequence[StageCounts]) -> None:
        """Update the table."""
        if self._live is not None:
            self._live.update(_table(stages))


def _table(stages: Sequence[StageCounts]) -> Any:
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    table.add_column("stage")
    for name in _COLUMNS:
        table.add_column(name, justify="right")
    for stage in stages:
        table.add_row(stage.stage, *(str(getattr(stage, name) or "") for name in _COLUMNS))
    return table
