"""Running command lines for a user: reports printed, errors as one line, an honest status."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Sequence
from typing import TextIO

from maplab_py.console.call import Call
from maplab_py.console.interrupt import cancellable
from maplab_py.console.lines import split_commands
from maplab_py.console.log import log_path
from maplab_py.console.render import render, render_json, wants_colour
from maplab_py.console.session import Session
from maplab_py.console.status import Status, status_of
from maplab_py.errors import MaplabError, UserError
from maplab_py.report import Message, Report

LEAVE = ("q", "quit", "exit")

logger = logging.getLogger(__name__)


class Runner:
    """Runs lines in a session and shows what came out.

    Attributes:
        wants_exit: The user has asked to leave.
    """

    def __init__(self, session: Session, *, as_json: bool = False) -> None:
        """Make a runner.

        Args:
            session: Where the commands run.
            as_json: Print reports as JSON on standard output and all else on standard error.
        """
        self.session = session
        self.as_json = as_json
        self.wants_exit = False

    def run_text(self, text: str, *, keep_going: bool = False) -> Status:
        """Run the commands of a text; stop at the first that fails unless told to go on.

        Returns:
            The status of the first command that failed.
        """
        try:
            commands = split_commands(text)
        except UserError as error:
            return self.report_error("", error)
        first = Status.OK
        for words in commands:
            status = self.run_words(words)
            first = first or status
            if self.wants_exit or status == Status.CANCELLED or (status and not keep_going):
                break
        return first

    def run_words(self, words: Sequence[str]) -> Status:
        """Run one command and return its status."""
        if words[0] in LEAVE and len(words) == 1:
            self.wants_exit = True
            return Status.OK
        logger.info("command: %s", " ".join(words))
        start = time.perf_counter()
        try:
            call = self.session.parse(words)
            if call.wants_help:
                call = self.session.parse(["help", call.command.name])
            report = self._execute(call)
        except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001 - logged by report_error
            return self.report_error(words[0], error)
        self.show(report, call.command.name)
        self.note(f"{call.command.name}: {format_seconds(time.perf_counter() - start)}")
        if report.failure:
            self.write_error(f"{call.command.name}: {report.failure}")
            logger.error("%s: %s", call.command.name, report.failure)
            return Status.FAILED
        return Status.OK

    def show(self, report: Report, command: str = "") -> None:
        """Print a report."""
        if self.as_json:
            render_json(report, command, sys.stdout)
        elif not (isinstance(report, Message) and not report.text):
            render(report, sys.stdout)

    def note(self, text: str) -> None:
        """Print a line that is not part of a report."""
        stream = sys.stderr if self.as_json else sys.stdout
        stream.write((f"\x1b[2m{text}\x1b[0m" if wants_colour(stream) else text) + "\n")
        stream.flush()

    def report_error(self, command: str, error: BaseException) -> Status:
        """Print an error as one line, its traceback into the log, and return its status."""
        status = status_of(error)
        name = self._canonical(command)
        if status is Status.CANCELLED:
            self.write_error(f"{name}: cancelled; the maps are as before")
        elif isinstance(error, MaplabError):
            text = str(error)
            self.write_error(text if not name or text.startswith(name) else f"{name}: {text}")
        else:
            reason = f"{type(error).__name__}: {error}".splitlines()[0]
            self.write_error(f"{name}: {reason} (an error of the program; see {log_path()})")
        logger.error("%s ended with status %d", name, status, exc_info=error)
        return status

    def write_error(self, text: str) -> None:
        """Print one line on standard error."""
        mark = "\x1b[31merror:\x1b[0m" if wants_colour(sys.stderr) else "error:"
        write_line(sys.stderr, f"{mark} {text}")

    def _execute(self, call: Call) -> Report:
        progress = self.session.terminal.progress(call.verbosity)
        with cancellable(call.command.name):
            return self.session.execute(call, progress)

    def _canonical(self, command: str) -> str:
        known = command in self.session.registry.names
        return self.session.registry.find(command).name if known else ""


def write_line(stream: TextIO, text: str) -> None:
    """Write one line at once."""
    stream.write(text + "\n")
    stream.flush()


def format_seconds(seconds: float) -> str:
    """Write a duration for people."""
    if seconds < 60:
        return f"{seconds:.2f} s" if seconds < 10 else f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s"
