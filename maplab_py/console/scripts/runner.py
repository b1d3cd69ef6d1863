"""Running command lines for a user: reports printed, errors as one line, an honest status."""

import io
import logging
import os
import shlex
import signal
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path

from maplab_py import atomic, cancellation
from maplab_py.console.commands.flag_types import expand_path
from maplab_py.console.commands.lines import TypedCommand, typed_commands, variable_lookup
from maplab_py.console.scripts import aliases, checking, costs
from maplab_py.console.scripts.recovery import Rescue
from maplab_py.console.session import jobs, paths
from maplab_py.console.session.call import Call
from maplab_py.console.session.session import Refusal, Session
from maplab_py.console.session.status import Status, describe, status_of
from maplab_py.console.terminal import foreground, output
from maplab_py.errors import MaplabError, UserError
from maplab_py.report import Report

FIX = "fix"
"""Command that runs the remedy of a refusal and the refused command again."""
_MAX_ALIAS_DEPTH = 8
_INTERRUPTED = (-signal.SIGINT, 128 + signal.SIGINT)
"""Exit codes of a shell command after Ctrl-C: by the signal, or by a shell that reports it."""

logger = logging.getLogger(__name__)


class Runner:
    """Runs lines in a session and shows what came out."""

    def __init__(self, session: Session, terminal: output.ConsoleTerminal) -> None:
        self.session = session
        self.terminal = terminal
        self.wants_exit = False  # the user has asked to leave
        self._alias_depth = 0
        self._rescue: Rescue | None = None  # of a script
        self._plan: costs.Plan | None = None
        self._folders: set[Path] = set()  # of maps that were used in this session
        terminal.mission_names = lambda: session.mission_names
        terminal.page_of_ids = lambda: session.marks.get("viewer", "")

    def run_text(self, text: str, *, keep_going: bool = False) -> Status:
        """Run the commands of a text; stop at the first that fails unless told to go on.

        Returns:
            The status of the first command that failed.
        """
        try:
            commands = typed_commands(text)
        except UserError as error:
            return self.report_error("", error)
        failed: list[str] = []
        first = Status.OK
        for number, command in enumerate(commands, start=1):
            if not self._alias_depth:
                self.terminal.position = self._position(number, len(commands))
            before = self.session.refusal
            status = self._run_typed(command, keep_going=keep_going)
            refusal = self.session.refusal
            is_new = refusal is not None and refusal is not before
            if is_new and self.session.settings.is_on("auto_fix"):
                status = self.run_words([FIX])
            self._keep_copies()
            first = first or status
            failed += [command.source] if status else []
            if self.wants_exit or status == Status.CANCELLED or (status and not keep_going):
                break
        if keep_going and failed:
            lines = "".join(f"\n  {line}" for line in failed)
            self.terminal.error(f"{len(failed)} of {len(commands)} commands failed:{lines}")
        return first

    def run_script(self, text: str, *, keep_going: bool = False) -> Status:
        """Run the commands of a text as `run_text`, after all of them have been checked.

        A text with an error is not started, unless the commands after a failure shall run anyway.
        """
        problems, steps = ([], []) if keep_going else checking.check_script(text, self.session)
        if not problems and self.terminal.shows_progress:
            self._plan = costs.predict(steps, self.session.maps)
        return self.report_problems(problems) or self.run_checked(text, keep_going=keep_going)

    def run_checked(self, text: str, *, keep_going: bool = False) -> Status:
        """Run the commands of a script that has been checked.

        A request of the system to end the process (SIGTERM, SIGHUP) cancels the command as Ctrl-C does.
        """
        self._rescue = Rescue(self.session)
        try:
            with foreground.terminations_as_interrupts():
                return self.run_text(text, keep_going=keep_going)
        except KeyboardInterrupt:
            return Status.CANCELLED  # between two commands

    def _position(self, number: int, count: int) -> str:
        """Return the place of a command in its script, and the time that those after it take."""
        if self._plan is None or count == 1:
            return ""
        has_all = len(self._plan.steps) == count  # no alias, assignment or shell command
        after_s = self._plan.left_after(number) if has_all else 0.0
        return f"{number}/{count}{f', then {after_s:.0f} s' if after_s >= 1.0 else ''}: "

    def _keep_copies(self) -> None:
        """Keep copies of the unsaved maps of a script where much work would be lost if it were killed."""
        if self._rescue is None or self._alias_depth:
            return
        try:
            self._rescue.update(self.session.settings.value("checkpoint_seconds"))
        except MaplabError as error:
            self._rescue = None
            self.terminal.warning(f"unsaved maps are not kept while the script runs: {error}")

    def report_problems(self, problems: Sequence[str]) -> Status:
        """Print the errors for which commands are not started and return the status."""
        for problem in problems:
            logger.error("not started: %s", problem)
            self.terminal.failed(problem, "", int(Status.USER_ERROR))
        return Status.USER_ERROR if problems else Status.OK

    def run_words(self, words: Sequence[str]) -> Status:
        """Run one command and return its status."""
        return self._run(TypedCommand(" ".join(words), list(words)))

    def finish(self, status: Status = Status.OK, *, discard: bool) -> Status:
        """End a script: wait for its jobs, then keep and name the maps whose changes are on no disk.

        Returns:
            The status, or that of a user's error when a script that went well leaves changes unsaved.
        """
        for job in self.session.jobs.jobs:
            if not status and not job.was_told:
                status = self.run_words(["join", str(job.number)])
        unsaved = ", ".join(entry.key for entry in self.session.maps.unsaved)
        rescue = self._rescue or Rescue(self.session)
        if not unsaved or discard:
            rescue.remove()
            return status
        try:
            run = rescue.save()
        except Exception as error:
            logger.exception("rescue")
            self.terminal.error(f"unsaved changes are lost: {unsaved} ({describe(error)})")
            return status or Status.USER_ERROR
        self.terminal.error(
            f"unsaved changes: {unsaved} (kept in {run}: maplab recover; else save them in the script, "
            "or give --discard)"
        )
        return status or Status.USER_ERROR

    def report_error(
        self, command: str, error: BaseException, *, has_effects: bool = False
    ) -> Status:
        """Print an error as one line and return its status.

        Args:
            command: Name of the command, as it was typed.
            error: What was raised.
            has_effects: The command had written files or changed the session before.
        """
        status = status_of(error)
        known = bool(command) and self.session.registry.knows(command)
        name = self.session.registry.find(command).name if known else command
        if status is Status.CANCELLED:
            remark = ", what it had done outside them remains" if has_effects else ""
            text = f"{name}: cancelled; the maps are as before{remark}"
        else:
            text = describe(error)
            text = text if not known or text.startswith(name) else f"{name}: {text}"
        self.terminal.failed(text, name, int(status))
        return status

    def _keep_refusal(self, words: Sequence[str], remedy: str) -> None:
        """Keep a refusal with a remedy for `fix`, and tell a person at the prompt."""
        if not remedy or words[0] == FIX:
            return
        line = shlex.join(words)
        self.session.refusal = Refusal(line, remedy)
        if self.terminal.is_prompt:
            self.terminal.advise(f"fix runs {remedy}, then {line} again")

    def _run_typed(self, command: TypedCommand, *, keep_going: bool) -> Status:
        """Run what was typed: an assignment, a shell command, an alias or a command."""
        try:
            (command,) = typed_commands(command.source, variable_lookup(self.session.variables))
            if command.assignment is not None:
                name, value = command.assignment
                self.session.variables[name] = value
                return Status.OK
            if not command.words:
                return self._run_shell(command.shell)
            text = aliases.expanded(command, self.session.aliases)
        except UserError as error:
            return self.report_error("", error)
        if text is None:
            return self._run(command)
        if self._alias_depth >= _MAX_ALIAS_DEPTH:
            return self.report_error("", UserError(f"alias '{command.words[0]}' contains itself"))
        self._alias_depth += 1
        try:
            return self.run_text(text, keep_going=keep_going)
        finally:
            self._alias_depth -= 1

    def _run(self, command: TypedCommand) -> Status:
        """Run one command and show its report."""
        words = command.words
        if words[0] in checking.LEAVE and len(words) == 1:
            self.wants_exit = True
            return Status.OK
        logger.info("command: %s", command.source)
        self.session.uses[words[0]] += 1
        self.terminal.echo_to_transcript("> " + command.source)
        start = time.perf_counter()
        token = cancellation.CancelToken()
        is_shown = True
        try:
            call = self.session.parse(words)
            if call.wants_help:
                call = self.session.parse(["help", call.command.name])
            if command.in_background:
                return self._start_job(call, command)
            with (
                self._pipe(command.shell),
                self._write(command),
                self.session.lock,
                costs.measuring(call, self.session),
            ):
                report = foreground.run_in_foreground(
                    call.command.name,
                    lambda: self.session.execute(call),
                    token=token,
                    while_waiting=self.terminal.tick,
                )
                name = call.command.name
                seconds = time.perf_counter() - start
                is_shown = self._show(report, name, seconds, in_shell=bool(command.shell))
        except (Exception, KeyboardInterrupt) as error:
            logger.exception("%s", words[0])
            status = self.report_error(words[0], error, has_effects=token.has_effects)
            self._keep_refusal(words, error.remedy if isinstance(error, MaplabError) else "")
            return status
        self._remember_maps()
        trial = " (dry run: nothing has changed)" if call.is_trial else ""
        self.terminal.note(f"{name}: {format_seconds(seconds)}{trial}")
        if report.advice and self.terminal.is_prompt and self.session.settings.is_on("advice"):
            self.terminal.advise(report.advice)
        if report.failure:
            self.terminal.error(f"{name}: {report.failure}")
            logger.error("%s: %s", name, report.failure)
            self._keep_refusal(words, report.remedy)
            return Status.FAILED
        if name == FIX:
            self.session.refusal = None
        if token.cancelled or not is_shown:
            self.terminal.error(
                f"{name}: finished before Ctrl-C; the following commands are not run"
            )
            return Status.CANCELLED
        return Status.OK

    def _remember_maps(self) -> None:
        """Note the folders of maps that were loaded or saved, for the greeting of the prompt."""
        folders = {entry.folder for entry in self.session.maps if entry.folder is not None}
        if not folders <= self._folders:
            paths.remember_maps(folders - self._folders)
            self._folders |= folders

    def _show(self, report: Report, name: str, seconds: float, *, in_shell: bool) -> bool:
        """Show a report; return whether it was shown to its end and not cut by Ctrl-C."""
        try:
            with nullcontext() if in_shell else foreground.interruptible():
                self.terminal.show(report, name, seconds)
        except KeyboardInterrupt:
            return False
        return True

    def _start_job(self, call: Call, command: TypedCommand) -> Status:
        text = command.source.rstrip("& \t")
        job = self.session.start_call(call, text)
        self.terminal.note(f"[{job.number}] {text} (see: jobs, join, cancel)")
        return Status.OK

    def tell_of_job(self, job: jobs.Job) -> None:
        """Report that a job has finished; called in the thread of the job."""
        name = job.call.command.name
        text = f"[{job.number}] {name}: {job.state} after {format_seconds(job.elapsed_s)}"
        if job.problem:
            text += f": {job.problem}"
        for conflict in job.conflicts:
            text += f"; '{conflict.key}' changed in the meantime: see map '{conflict.kept_as}'"
        self.terminal.note(text)

    def _run_shell(self, line: str) -> Status:
        """Run a line in the shell, which also receives Ctrl-C."""
        if not line:
            return self.report_error("", UserError("no command after '!' (write !ls)"))
        self.terminal.echo_to_transcript("> !" + line)
        try:
            with foreground.terminal_lent():
                child = subprocess.run(line, shell=True, check=False, env=self._environment)
        except KeyboardInterrupt:
            return Status.CANCELLED
        code = child.returncode
        if code in _INTERRUPTED:
            return Status.CANCELLED
        if code:
            self.terminal.error(f"!{line}: exit status {code}")
        return Status.FAILED if code else Status.OK

    @property
    def _environment(self) -> dict[str, str]:
        return {**os.environ, **self.session.variables}

    @contextmanager
    def _write(self, command: TypedCommand) -> Iterator[None]:
        """Write the report of a command to the file behind `>` or `>>`, if it succeeds."""
        if not command.output:
            yield
            return
        try:
            path = expand_path(command.output)
        except ValueError as error:
            raise UserError(f"> {command.output}: {error}") from None
        assert path is not None
        if path.is_dir() or not path.absolute().parent.is_dir():
            raise UserError(f"> {path}: name a file in a folder that exists")
        before = path.read_bytes() if command.appends and path.exists() else b""
        report = io.StringIO()
        with self.terminal.redirected(report):
            yield
        atomic.write_file(path, [before + report.getvalue().encode()])

    @contextmanager
    def _pipe(self, line: str) -> Iterator[None]:
        """Send the report of a command to the standard input of a shell command."""
        if not line:
            yield
            return
        with (
            foreground.terminal_lent(),
            subprocess.Popen(
                line, shell=True, stdin=subprocess.PIPE, text=True, env=self._environment
            ) as child,
        ):
            assert child.stdin is not None
            try:
                with self.terminal.redirected(child.stdin):
                    yield
            except BrokenPipeError:
                pass
            finally:
                _close(child)


def _close(child: subprocess.Popen[str]) -> None:
    """Close the pipe to a shell command; it may have stopped reading before."""
    try:
        if child.stdin is not None:
            child.stdin.close()
    except BrokenPipeError:
        pass


def format_seconds(seconds: float) -> str:
    """Format a duration."""
    if seconds < 60:
        return f"{seconds:.2f} s" if seconds < 10 else f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s"
