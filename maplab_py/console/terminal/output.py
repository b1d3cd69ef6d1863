"""The console's terminal: reports, one-line errors, questions and progress on the standard streams."""

from __future__ import annotations

import array
import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, TextIO

from maplab_py import cancellation, kernel_cache
from maplab_py.console.terminal import drawing, foreground, layout, render, streams
from maplab_py.errors import Cancelled, UserError
from maplab_py.progress import Progress
from maplab_py.report import Report

if TYPE_CHECKING:
    from rich.progress import Progress as RichProgress

SECONDS_BEFORE_BAR = 1.0
SECONDS_BETWEEN_UPDATES = 0.1
_COLUMNS_OF_BAR = 26
"""Width of the bar with its time where it is shortest."""
_COMPILATION = "compiling kernels, once"


class TerminalProgress:
    """Progress of one command. It is quiet if the stream is no terminal.

    A verbosity above zero prints the lines of intermediate results everywhere.
    """

    def __init__(
        self, stream: TextIO, verbosity: int = 0, what: str = "", position: str = ""
    ) -> None:
        """Start the clock of one command.

        Args:
            stream: Where the bar goes.
            verbosity: Above zero: print lines of intermediate results everywhere.
            what: Shown until the command names its current step.
            position: Shown before it and all steps.
        """
        self._position = position
        self._stream = stream
        self._token = cancellation.current_token()
        self._what = what
        self._is_live = render.wants_colour(stream)
        self._prints_lines = stream.isatty() or verbosity > 0
        self._start = time.monotonic()
        self._updated = 0.0
        self._done: tuple[float, float | None] = 0.0, None
        self._tells_compilation = False
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
        self._updated, self._tells_compilation = now, False
        self._done, self._what = (done, total or None), what or self._what
        self._update(*self._done, self._what)

    def tick(self) -> None:
        """Show that a silent command runs, or waits for a compilation; any thread may call this."""
        is_late = time.monotonic() - self._start > SECONDS_BEFORE_BAR
        tells = kernel_cache.is_compiling.is_set()
        if self._is_live and is_late and (self._bar is None or tells != self._tells_compilation):
            self._tells_compilation = tells
            self._update(*self._done, _COMPILATION if tells else self._what)

    def line(self, text: str) -> None:
        """Print one line of intermediate result."""
        if not self._prints_lines or self._token.abandoned:
            return
        with self._lock:
            if self._bar is not None:
                self._bar.console.print(text, markup=False, highlight=False)
            else:
                streams.write_message(self._stream, text)

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
            text = self._cut(self._bar, self._position + what)
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

    class TimeColumn(TimeRemainingColumn):
        """The time that is left; until it can be estimated, the time that has passed."""

        def render(self, task: Task) -> Text:
            if task.total is None or task.time_remaining is None:
                return TimeElapsedColumn().render(task).append(" elapsed", "dim")
            return super().render(task).append(" left", "dim")

    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TaskProgressColumn(table_column=Column(no_wrap=True)),
        TimeColumn(table_column=Column(no_wrap=True)),
        console=Console(file=stream),
        transient=True,
        redirect_stdout=False,  # the streams are swapped by the prompt too, in its own order
        redirect_stderr=False,
    )


_CLEARED = "\x1b[H\x1b[2J\x1b[3J"


class ConsoleTerminal:
    """Standard input, output and error of the process.

    With `as_json` standard output carries one JSON object per command and nothing else.
    """

    def __init__(self, *, as_json: bool = False) -> None:
        self.as_json = as_json
        self.is_prompt = False  # a user reads the output directly
        self.position = ""  # of the running command in its script, before its name in the bar
        self.mission_names: Callable[[], Mapping[str, str]] = dict  # by id
        self.page_of_ids: Callable[[], str] = str  # address of the viewer; empty = none runs
        self._transcript: TextIO | None = None
        self._out: IO[str] | None = None  # instead of standard output
        self._progresses: list[TerminalProgress] = []  # of the running command and inner ones

    @property
    def shows_progress(self) -> bool:
        """Tell whether bars are drawn."""
        return render.wants_colour(sys.stderr)

    @property
    def is_interactive(self) -> bool:
        """Tell whether somebody is there to answer a question."""
        return sys.stdin.isatty() and sys.stderr.isatty()

    def ask(self, question: str) -> bool:
        """Ask a yes-or-no question; anything but yes is no.

        Raises:
            Cancelled: The answer is Ctrl-C.
        """
        self._hide_progress()
        answer = foreground.in_waiting_thread(lambda: self._answer(f"{question} [y/N] "))
        return answer.strip().lower() in ("y", "yes")

    def choose(self, question: str, answers: tuple[str, ...]) -> str:
        """Ask until one of the answers, or its first letter, is given; return the answer.

        Raises:
            Cancelled: The answer is Ctrl-C, or the input has ended.
        """
        self._hide_progress()
        letters = "/".join(answer[0] for answer in answers)
        while True:
            text = foreground.in_waiting_thread(lambda: self._answer(f"{question} [{letters}] "))
            if not text:
                raise Cancelled("cancelled: the input has ended")
            given = text.strip().lower()
            for answer in answers:
                if given in (answer, answer[0]):
                    return answer

    def _answer(self, prompt: str) -> str:
        """Return the line that the user types behind a prompt, empty at the end of the input."""
        sys.stderr.write(prompt)
        sys.stderr.flush()
        try:
            with foreground.interruptible():
                text = sys.stdin.readline()
        except KeyboardInterrupt:
            raise Cancelled("cancelled") from None
        self._copy(f"{prompt}{text.strip()}")
        return text

    def show(self, report: Report, command: str, seconds: float | None = None) -> None:
        """Print a report to standard output."""
        self._hide_progress()
        with self._output() as out:
            if self.as_json:
                render.render_json(report, command, seconds, out)
            elif layout.blocks_of(report) and not self._page(report):
                render.render(report, out, self.mission_names(), self.page_of_ids())
        if self._transcript is not None:
            blocks = render.with_names(layout.blocks_of(report), self.mission_names())
            self._copy("\n\n".join(drawing.plain_text(block) for block in blocks))

    def failed(self, text: str, command: str, status: int) -> None:
        """Report that a command failed: a line on standard error, with --json also an object."""
        self.clear_progress()
        if self.as_json:
            with self._output() as out:
                render.render_json_error(text, command, status, out)
        self.error(text)

    @contextmanager
    def _output(self) -> Iterator[IO[str]]:
        """Give the stream for reports."""
        if self._out is not None:
            yield self._out
            return
        with streams.writing_output():
            yield sys.stdout

    def tick(self) -> None:
        """Show that a silent command is running."""
        for progress in self._progresses[-1:]:
            progress.tick()

    @contextmanager
    def redirected(self, stream: IO[str]) -> Iterator[None]:
        """Redirect reports to another stream."""
        self._out = stream
        try:
            yield
        finally:
            self._out = None

    def note(self, text: str) -> None:
        """Print a line that is not part of a report; never into a pipe that wants reports."""
        stream = sys.stdout if sys.stdout.isatty() and not self.as_json else sys.stderr
        self._hide_progress()
        _write_line(stream, text, "\x1b[2m")
        self._copy(text)

    def clear(self) -> None:
        """Clear the screen and what the terminal has scrolled off it; a pipe gets nothing."""
        if sys.stdout.isatty() and os.environ.get("TERM") != "dumb":
            sys.stdout.write(_CLEARED)
            sys.stdout.flush()

    def advise(self, text: str) -> None:
        """Print one line on what to do next."""
        line = render.text_with_names(f"next: {text}", self.mission_names())
        _write_line(sys.stdout, line, "\x1b[36m")
        self._copy(line)

    def error(self, text: str) -> None:
        """Print one line on standard error."""
        text = text if self.as_json else render.text_with_names(text, self.mission_names())
        _write_line(sys.stderr, f"error: {text}", "\x1b[31m")
        self._copy(f"error: {text}")

    def warning(self, text: str) -> None:
        """Print one line on standard error."""
        self._hide_progress()
        _write_line(sys.stderr, f"warning: {text}", "\x1b[33m")
        self._copy(f"warning: {text}")

    @contextmanager
    def progress(self, command: str, verbosity: int = 0) -> Iterator[Progress]:
        """Show progress on standard error."""
        self._hide_progress()
        progress = TerminalProgress(sys.stderr, verbosity, command, self.position)
        self._progresses.append(progress)
        try:
            yield progress
        finally:
            progress.close()
            if progress in self._progresses:  # not so when the command was left behind
                self._progresses.remove(progress)

    def clear_progress(self) -> None:
        """Remove all bars for good, also those of an abandoned command."""
        for progress in self._progresses:
            progress.close()
        self._progresses.clear()

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

    def _page(self, report: Report) -> bool:
        if not self.is_prompt or self._out is not None:
            return False
        return page(render.rendered(report, sys.stdout, self.mission_names(), self.page_of_ids()))

    def _hide_progress(self) -> None:
        for progress in self._progresses:
            progress.hide()

    def _copy(self, text: str) -> None:
        if self._transcript is not None:
            self._transcript.write(text + "\n")
            self._transcript.flush()


def _write_line(stream: TextIO, text: str, colour: str) -> None:
    if stream.isatty():
        text = drawing.folded(text, shutil.get_terminal_size().columns)
    line = f"{colour}{text}\x1b[0m" if render.wants_colour(stream) else text
    streams.write_message(stream, line)


PAGER_VARIABLE = "MAPLAB_PAGER"
_DEFAULT = "less -FRXK"
"""Short text is only printed, colours are kept, the text stays, Ctrl-C leaves."""


_SCREENS = 2
"""Longer reports are paged."""


def pager_command() -> str:
    """Return the pager: $MAPLAB_PAGER, else less; empty when there is none or it is `cat`."""
    configured = os.environ.get(PAGER_VARIABLE)
    if configured is not None:
        return "" if configured.strip() == "cat" else configured.strip()
    return _DEFAULT if shutil.which("less") else ""


def page(text: str) -> bool:
    """Show text by the pager if it is longer than two screens; return whether it was shown.

    If keys have been typed meanwhile, they are for the prompt: the pager would take them.
    """
    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        return False
    pager = pager_command()
    if not pager or text.count("\n") <= _SCREENS * shutil.get_terminal_size().lines:
        return False
    if keys_are_waiting():
        return False
    sys.stdout.flush()
    with foreground.terminal_lent():
        subprocess.run(pager, shell=True, input=text, text=True, check=False)
    return True


def keys_are_waiting() -> bool:
    """Tell whether keys have been typed that no program has read yet, with or without Enter."""
    try:
        import fcntl
        import termios
    except ImportError:  # not a POSIX system
        return False
    try:
        number = sys.stdin.fileno()
        settings = termios.tcgetattr(number)
        immediate = list(settings)
        immediate[3] &= ~termios.ICANON  # otherwise an unfinished line is not counted
        count = array.array("i", [0])
        termios.tcsetattr(number, termios.TCSANOW, immediate)
        try:
            fcntl.ioctl(number, termios.FIONREAD, count)
        finally:
            termios.tcsetattr(number, termios.TCSANOW, settings)
    except (AttributeError, OSError, ValueError, termios.error):
        return False
    return count[0] > 0
