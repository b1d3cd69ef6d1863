"""What commands see of the place where they run: a terminal, a script, or a Python program."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
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

    def show(self, report: Report, command: str) -> None:
        """Show the report of a command."""

    def note(self, text: str) -> None:
        """Say something beside the report."""

    def progress(self, command: str, verbosity: int = 0) -> AbstractContextManager[Progress]:
        """Return the progress display around one command."""

    def transcribe(self, path: Path | None) -> None:
        """Copy all further output to a file; None ends it."""


class SilentTerminal:
    """The terminal of a Python program: nobody answers, nothing is printed."""

    @property
    def is_interactive(self) -> bool:
        """Nobody is there."""
        return False

    def ask(self, question: str) -> bool:  # noqa: ARG002
        """Answer no."""
        return False

    def show(self, report: Report, command: str) -> None:
        """Show nothing: the program has the report."""

    def note(self, text: str) -> None:
        """Say nothing."""

    def progress(
        self,
        command: str,  # noqa: ARG002
        verbosity: int = 0,  # noqa: ARG002
    ) -> AbstractContextManager[Progress]:
        """Return the progress that nobody watches."""
        return nullcontext(SILENT)

    def transcribe(self, path: Path | None) -> None:
        """Do nothing, as there is no output to copy."""
