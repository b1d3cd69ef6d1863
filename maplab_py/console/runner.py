"""Running command lines for a user: reports printed, errors as one line, an honest status."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence

from maplab_py.console.lines import split_commands
from maplab_py.console.log import log_path
from maplab_py.console.output import ConsoleTerminal
from maplab_py.console.session import Session
from maplab_py.console.status import Status, status_of
from maplab_py.errors import MaplabError, UserError

LEAVE = ("q", "quit", "exit")

logger = logging.getLogger(__name__)


class Runner:
    """Runs lines in a session and shows what came out.

    Attributes:
        wants_exit: The user has asked to leave.
    """

    def __init__(self, session: Session, terminal: ConsoleTerminal) -> None:
        """Make a runner.

        Args:
            session: Where the commands run.
            terminal: Where their reports go.
        """
        self.session = session
        self.terminal = terminal
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
        failed: list[str] = []
        first = Status.OK
        for words in commands:
            status = self.run_words(words)
            first = first or status
            failed += [" ".join(words)] if status else []
            if self.wants_exit or status == Status.CANCELLED or (status and not keep_going):
                break
        if keep_going and failed:
            lines = "".join(f"\n  {line}" for line in failed)
            self.terminal.error(f"{len(failed)} of {len(commands)} commands failed:{lines}")
        return first

    def run_words(self, words: Sequence[str]) -> Status:
        """Run one command and return its status."""
        if words[0] in LEAVE and len(words) == 1:
            self.wants_exit = True
            return Status.OK
        logger.info("command: %s", " ".join(words))
        self.terminal.echo_to_transcript("> " + " ".join(words))
        start = time.perf_counter()
        try:
            call = self.session.parse(words)
            if call.wants_help:
                call = self.session.parse(["help", call.command.name])
            report = self.session.execute(call)
        except (Exception, KeyboardInterrupt) as error:
            logger.exception("%s", words[0])
            return self.report_error(words[0], error)
        name = call.command.name
        self.terminal.show(report, name)
        self.terminal.note(f"{name}: {format_seconds(time.perf_counter() - start)}")
        if report.failure:
            self.terminal.error(f"{name}: {report.failure}")
            logger.error("%s: %s", name, report.failure)
            return Status.FAILED
        return Status.OK

    def report_error(self, command: str, error: BaseException) -> Status:
        """Print an error as one line and return its status."""
        status = status_of(error)
        known = command in self.session.registry.names
        name = self.session.registry.find(command).name if known else command
        if status is Status.CANCELLED:
            self.terminal.error(f"{name}: cancelled; the maps are as before")
        elif isinstance(error, MaplabError):
            text = " ".join(str(error).split("\n"))
            prefixed = not known or text.startswith(name)
            self.terminal.error(text if prefixed else f"{name}: {text}")
        else:
            reason = (f"{type(error).__name__}: {error}".splitlines() or [""])[0]
            self.terminal.error(f"{name}: {reason} (an error of the program; see {log_path()})")
        return status

    def check_unsaved(self, *, discard: bool) -> Status:
        """Say at the end of a script which maps have changes that are on no disk."""
        unsaved = ", ".join(entry.key for entry in self.session.maps.unsaved)
        if not unsaved or discard:
            return Status.OK
        self.terminal.error(f"unsaved changes are lost: {unsaved} (save them, or give --discard)")
        return Status.USER_ERROR


def format_seconds(seconds: float) -> str:
    """Write a duration for people."""
    if seconds < 60:
        return f"{seconds:.2f} s" if seconds < 10 else f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s"
