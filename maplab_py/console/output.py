"""The console's terminal: reports, one-line errors, questions and progress on the standard streams."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from maplab_py.console.interrupt import cancellable, interruptible
from maplab_py.console.layout import blocks_of
from maplab_py.console.progress import TerminalProgress
from maplab_py.console.render import plain_text, render, render_json, wants_colour
from maplab_py.errors import Cancelled, UserError
from maplab_py.progress import Progress
from maplab_py.report import Report


class ConsoleTerminal:
    """Standard input, output and error of the process.

    With `as_json` standard output carries one JSON object per command and nothing else.
    """

    def __init__(self, *, as_json: bool = False) -> None:
        """Make the terminal of this process."""
        self.as_json = as_json
        self._transcript: TextIO | None = None

    @property
    def is_interactive(self) -> bool:
        """Tell whether somebody is there to answer a question."""
        return sys.stdin.isatty() and sys.stderr.isatty()

    def ask(self, question: str) -> bool:
        """Ask a yes-or-no question; anything but yes is no.

        Raises:
            Cancelled: The answer is Ctrl-C.
        """
        sys.stderr.write(f"{question} [y/N] ")
        sys.stderr.flush()
        try:
            with interruptible():
                answer = sys.stdin.readline().strip()
        except KeyboardInterrupt:
            raise Cancelled("cancelled") from None
        self._copy(f"{question} [y/N] {answer}")
        return answer.lower() in ("y", "yes")

    def show(self, report: Report, command: str) -> None:
        """Print a report to standard output."""
        if self.as_json:
            render_json(report, command, sys.stdout)
        elif blocks_of(report):
            render(report, sys.stdout)
        if self._transcript is not None:
            self._copy("\n\n".join(plain_text(block) for block in blocks_of(report)))

    def note(self, text: str) -> None:
        """Print a line that is not part of a report; never into a pipe that wants reports."""
        stream = sys.stdout if sys.stdout.isatty() and not self.as_json else sys.stderr
        _write_line(stream, text, "\x1b[2m")
        self._copy(text)

    def error(self, text: str) -> None:
        """Print one line on standard error."""
        _write_line(sys.stderr, f"error: {text}", "\x1b[31m")
        self._copy(f"error: {text}")

    def warning(self, text: str) -> None:
        """Print one line on standard error."""
        _write_line(sys.stderr, f"warning: {text}", "\x1b[33m")
        self._copy(f"warning: {text}")

    @contextmanager
    def progress(self, command: str, verbosity: int = 0) -> Iterator[Progress]:
        """Show progress on standard error and let Ctrl-C cancel the command."""
        with cancellable(command):
            progress = TerminalProgress(sys.stderr, verbosity)
            try:
                yield progress
            finally:
                progress.close()

    def transcribe(self, path: Path | None) -> None:
        """Copy all further output to a file; None ends it.

        Raises:
            UserError: The file cannot be written.
        """
        if self._transcript is not None:
            self._transcript.close()
            self._transcript = None
        if path is not None:
            try:
                self._transcript = path.open("a", encoding="utf-8")
            except OSError as error:
                raise UserError(f"{path}: cannot be written: {error.strerror}") from None

    def echo_to_transcript(self, text: str) -> None:
        """Copy what the user typed into the transcript."""
        self._copy(text)

    def _copy(self, text: str) -> None:
        if self._transcript is not None:
            self._transcript.write(text + "\n")
            self._transcript.flush()


def _write_line(stream: TextIO, text: str, colour: str) -> None:
    line = f"{colour}{text}\x1b[0m" if wants_colour(stream) else text
    stream.write(line + "\n")
    stream.flush()
