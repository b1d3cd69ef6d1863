"""The interface of commands to a terminal, a script or a Python program."""

from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Protocol

from maplab_py.errors import UserError
from maplab_py.progress import SILENT, Progress
from maplab_py.report import Report


class Terminal(Protocol):
    """Asks questions and shows reports."""

    @property
    def is_interactive(self) -> bool:
        """Tell whether a user can answer questions."""

    @property
    def is_prompt(self) -> bool:
        """Tell whether a user types the commands and reads the reports at the prompt."""

    def ask(self, question: str) -> bool:
        """Ask a yes-or-no question."""

    def choose(self, question: str, answers: tuple[str, ...]) -> str:
        """Ask until one of the answers, or its first letter, is given; return the answer."""

    def show(self, report: Report, command: str) -> None:
        """Show the report of a command."""

    def note(self, text: str) -> None:
        """Print a note outside the report."""

    def clear(self) -> None:
        """Clear the screen."""

    def progress(self, command: str, verbosity: int = 0) -> AbstractContextManager[Progress]:
        """Return the progress display around one command."""

    def transcribe(self, path: Path | None) -> None:
        """Copy all further output to a file; None ends it."""


class SilentTerminal:
    """Terminal of a Python program: questions are answered with no, nothing is printed."""

    @property
    def is_interactive(self) -> bool:
        """Return False: nobody can answer."""
        return False

    @property
    def is_prompt(self) -> bool:
        """Return False: there is no prompt."""
        return False

    def ask(self, question: str) -> bool:  # noqa: ARG002
        """Answer no."""
        return False

    def choose(self, question: str, answers: tuple[str, ...]) -> str:  # noqa: ARG002
        """Refuse: nobody can choose."""
        raise UserError("nobody is there to answer")

    def show(self, report: Report, command: str) -> None:
        """Show nothing: the program has the report."""

    def note(self, text: str) -> None:
        """Print nothing."""

    def clear(self) -> None:
        """Clear nothing: there is no screen."""

    def progress(
        self,
        command: str,  # noqa: ARG002
        verbosity: int = 0,  # noqa: ARG002
    ) -> AbstractContextManager[Progress]:
        """Return a progress that shows nothing."""
        return nullcontext(SILENT)

    def transcribe(self, path: Path | None) -> None:
        """Do nothing, as there is no output to copy."""
