"""What commands see of the place where they run: a terminal, a script, or a Python program."""

from __future__ import annotations

from typing import Protocol

from maplab_py.progress import SILENT, Progress
from maplab_py.report import Report


class Terminal(Protocol):
    """Where questions are asked and reports are shown."""

    @property
    def is_interactive(self) -> bool:
        """Tell whether somebody is there to answer a question."""

    def ask(self, question: str) -> bool:
        """Ask a yes-or-no question."""

    def show(self, report: Report) -> None:
        """Show a report in the middle of a command."""

    def clear(self) -> None:
        """Begin a fresh screen, if there is one."""

    def progress(self, verbosity: int = 0) -> Progress:
        """Return the progress display for one command."""


class SilentTerminal:
    """The terminal of a Python program: nobody answers, nothing is printed."""

    @property
    def is_interactive(self) -> bool:
        """Nobody is there."""
        return False

    def ask(self, question: str) -> bool:  # noqa: ARG002
        """Answer no."""
        return False

    def show(self, report: Report) -> None:
        """Show nothing."""

    def clear(self) -> None:
        """Do nothing."""

    def progress(self, verbosity: int = 0) -> Progress:  # noqa: ARG002
        """Return the progress that nobody watches."""
        return SILENT
