"""Follows what the user types and shows the next step of the tour."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from maplab_plugins.tour.steps import Step
from maplab_py.console.commands.lines import split_commands
from maplab_py.console.session.maps import MapManager
from maplab_py.errors import MaplabError
from maplab_py.report import Message, counted

if TYPE_CHECKING:
    from maplab_py.console.commands.registry import Registry
    from maplab_py.console.terminal.protocol import Terminal
    from maplab_py.vimap import VIMap

NAME = "tour"
_END = """The tour is over. The map is yours to play with; leave with `quit`.
Next: `help` lists the commands, `demo` runs the whole workflow, docs/tutorial.md has the details."""


class Guide:
    """The tour of one session, a watcher of its lines.

    A step is done when all its commands have succeeded, in one line or several, and its result is
    there. Other commands are welcome in between.
    """

    def __init__(self, registry: Registry, terminal: Terminal, steps: Sequence[Step]) -> None:
        """Start at the first step.

        Args:
            registry: The commands that can be typed.
            terminal: Where the steps are shown.
            steps: The steps of the tour.
        """
        self._registry, self._terminal = registry, terminal
        self._maps = MapManager()  # as the last command has left them
        self._steps = steps
        self._succeeded: set[str] = set()
        self.index = 0

    @property
    def is_over(self) -> bool:
        """Tell whether all steps are done."""
        return self.index >= len(self._steps)

    def text(self) -> str:
        """Return what the user has to do now."""
        if self.is_over:
            return _END
        step, number = self._steps[self.index], self.index + 1
        return (
            f"Step {number} of {len(self._steps)}: {step.title}\n{step.why}\n\n"
            f"    {step.line}\n\n"
            "Type it. `tour --skip` goes on without it, `tour --stop` ends the tour."
        )

    def skip(self) -> None:
        """Go on to the next step."""
        self.index += 1
        self._succeeded.clear()

    def after_line(self, line: str, *, succeeded: bool) -> None:
        """Check a line that has been run, and say what comes next."""
        names = self._commands(line)
        if self.is_over or not names or "tour" in names:
            return
        step = self._steps[self.index]
        if not succeeded:
            self._say(f"Tour: that did not work; the line `error: ...` says why. Type: {step.line}")
            return
        self._succeeded |= names
        missing = [name for name in step.commands if name not in self._succeeded]
        problem = "" if missing else self._problem(step)
        if missing or problem:
            reason = problem or f"{counted(len(missing), 'command')} to go: {', '.join(missing)}"
            self._say(f"Tour: step {self.index + 1} is still open, {reason}. Type: {step.line}")
            return
        self.skip()
        self._say(f"{step.learned}\n\n{self.text()}")

    def after_command(self, maps: MapManager) -> None:
        """Remember the maps: lines are checked when their reports have been shown."""
        self._maps = maps

    def during_command(self, make_map: Callable[[], VIMap]) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing: the tour ends with the session."""

    def _commands(self, line: str) -> set[str]:
        """Return the full names of the commands of a line."""
        try:
            words = [words[0] for words in split_commands(line)]
            return {self._registry.find(word).name for word in words}
        except MaplabError:
            return {line}  # an unknown command, an alias or a shell command

    def _problem(self, step: Step) -> str:
        try:
            return step.problem(self._maps)
        except MaplabError as error:
            return str(error)

    def _say(self, text: str) -> None:
        self._terminal.show(Message(f"\n{text}"), NAME)
