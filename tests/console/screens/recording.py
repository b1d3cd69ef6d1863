"""What a command shows, drawn for several widths, without what differs between machines."""

import dataclasses
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from maplab_py.console.scripts.runner import Runner
from maplab_py.console.terminal.drawing import drawn, folded
from maplab_py.console.terminal.layout import Block, Pairs, Paragraph, blocks_of
from maplab_py.console.terminal.output import ConsoleTerminal
from maplab_py.console.terminal.render import text_with_names, with_names
from maplab_py.progress import Progress, SilentProgress
from maplab_py.report import Report

WIDTHS = (80, 100, 160)

_RUN_TIME = re.compile(r"\S+: (\d+\.?\d* s|\d+ min \d\d s)( \(dry run.*)?")
"""The note with which every command ends."""


class Screen(ConsoleTerminal):
    """A terminal at a prompt that keeps what it shows, to be drawn for any width.

    Attributes:
        shown: Blocks of the reports, and lines of notes, advice and errors.
        steps: How often commands have moved their bar.
    """

    def __init__(self) -> None:
        """Make an empty screen."""
        super().__init__()
        self.is_prompt = True
        self.shown: list[Block | str] = []
        self.steps = 0

    @property
    def is_interactive(self) -> bool:
        """Return True: questions get an answer."""
        return True

    def ask(self, question: str) -> bool:
        """Keep the question and answer yes."""
        self.shown.append(f"{question} [y/N] y")
        return True

    def choose(self, question: str, answers: tuple[str, ...]) -> str:
        """Keep the question and give the first answer."""
        self.shown.append(f"{question} [{'/'.join(answer[0] for answer in answers)}] {answers[0]}")
        return answers[0]

    def show(self, report: Report, command: str, seconds: float | None = None) -> None:
        """Keep the blocks of a report."""
        self.shown += with_names(blocks_of(report), self.mission_names())

    def failed(self, text: str, command: str, status: int) -> None:
        """Keep the line of an error."""
        self.error(text)

    def note(self, text: str) -> None:
        """Keep a note, unless it is the run time."""
        if not _RUN_TIME.fullmatch(text):
            self.shown.append(text)

    def advise(self, text: str) -> None:
        """Keep the advice."""
        self.shown.append(text_with_names(f"next: {text}", self.mission_names()))

    def error(self, text: str) -> None:
        """Keep the line of an error."""
        self.shown.append(text_with_names(f"error: {text}", self.mission_names()))

    def warning(self, text: str) -> None:
        """Keep the line of a warning."""
        self.shown.append(text_with_names(f"warning: {text}", self.mission_names()))

    @contextmanager
    def progress(self, command: str, verbosity: int = 0) -> Iterator[Progress]:
        """Count the steps of the bar."""
        yield _Counting(self)

    def clear(self) -> None:
        """Forget what was shown."""
        self.shown.clear()

    def clear_progress(self) -> None:
        """Do nothing: there are no bars."""

    def tick(self) -> None:
        """Do nothing: there are no bars."""


class _Counting(SilentProgress):
    """Progress that is counted and not shown."""

    def __init__(self, screen: Screen) -> None:
        self._screen = screen

    def step(self, done: float, total: float, what: str = "") -> None:
        """Count a step; a total of 0 is not known."""
        assert total == 0 or 0 <= done <= total, what
        self._screen.steps += 1


def screen_of(runner: Runner, screen: Screen, line: str) -> list[Block | str]:
    """Run a line and return what it shows."""
    screen.shown.clear()
    runner.run_text(line)
    return list(screen.shown)


def text_of(shown: list[Block | str], width: int) -> str:
    """Draw what was shown for a terminal of a width [columns], without colours."""
    texts = [
        folded(item, width) if isinstance(item, str) else drawn(item, width, coloured=False)
        for item in shown
    ]
    return "\n\n".join(texts)


def changed(
    shown: list[Block | str], text: Callable[[str], str], value: Callable[[str, str], str]
) -> list[Block | str]:
    """Apply functions to every text of what was shown, and to every value with its heading."""
    return [text(item) if isinstance(item, str) else _changed(item, text, value) for item in shown]


def _changed(block: Block, text: Callable[[str], str], value: Callable[[str, str], str]) -> Block:
    if isinstance(block, Paragraph):
        return dataclasses.replace(block, text=text(block.text))
    if isinstance(block, Pairs):
        rows = [(name, value(name, cell)) for name, cell in block.rows]
        return Pairs(rows, text(block.title))
    cells = [
        [value(head, cell) for head, cell in zip(block.heads, row, strict=True)]
        for row in block.rows
    ]
    return dataclasses.replace(block, title=text(block.title), rows=cells)
