"""A session: maps, lasting flags, timings, and the running of commands as transactions."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from maplab_py.console.call import Call, call_from_keywords, call_from_words
from maplab_py.console.context import CommandContext
from maplab_py.console.lines import split_commands
from maplab_py.console.maps import MapManager
from maplab_py.console.registry import Registry, load_registry
from maplab_py.console.settings import Layer, Setting, Settings
from maplab_py.console.terminal import SilentTerminal, Terminal
from maplab_py.report import Message, Report
from maplab_py.vimap import VIMap


@dataclasses.dataclass(frozen=True)
class Timing:
    """How long one command took."""

    command: str
    seconds: float


class Session:
    """What the console, a script or a Python program works with.

    From Python::

        with maplab_py.open_map(folder) as session:
            report = session.run("optvi", ba_num_iterations=20)
    """

    def __init__(self, registry: Registry | None = None, terminal: Terminal | None = None) -> None:
        """Start a session without maps.

        Args:
            registry: The commands; those of all installed plugins when not given.
            terminal: Where questions are asked and progress is shown; silent when not given.
        """
        self.registry = load_registry() if registry is None else registry
        self.terminal: Terminal = SilentTerminal() if terminal is None else terminal
        self.maps = MapManager()
        self.settings = Settings(self.registry)
        self.timings: list[Timing] = []
        self.prompt_sign = ""  # put before the prompt

    @property
    def vi_map(self) -> VIMap:
        """The selected map."""
        return self.maps.selected.vi_map

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Forget the maps."""
        self.maps = MapManager()

    def run(self, command: str, *words: str, **flags: Any) -> Report:
        """Run a command from Python and return its report.

        Args:
            command: Name or alias.
            *words: Values by position.
            **flags: Values by flag name, or whole option groups by parameter name.

        Raises:
            UserError: The request cannot be carried out as given; nothing has changed.
            MaplabError: The command failed; nothing has changed.
        """
        found = self.registry.find(command)
        return self.execute(call_from_keywords(found, words, flags, self.settings))

    def parse(self, words: Sequence[str]) -> Call:
        """Read the words of one command line into a call."""
        return call_from_words(words, self.registry, self.settings)

    def run_line(self, text: str, terminal: Terminal) -> None:
        """Run the commands of a typed line inside another command and show their reports.

        Raises:
            MaplabError: The first error of any of them.
        """
        for words in split_commands(text):
            call = self.parse(words)
            terminal.show(self.execute(call), call.command.name)

    def set_flags(self, assignments: Sequence[str]) -> list[Setting]:
        """Give flags values that last for the session, all or none of them.

        Raises:
            FlagError: A flag is unknown, or no command with this flag takes the value.
        """
        return self.settings.assign(assignments, Layer.SET, "set")

    def execute(self, call: Call) -> Report:
        """Run a call as a transaction: if it fails or is cancelled, all maps are as before."""
        command = call.command
        arguments = call.arguments()
        if command.needs_map:
            _ = self.maps.selected
        before = self.maps.state
        start = time.perf_counter()
        try:
            with self.terminal.progress(command.name, call.verbosity) as progress:
                context = CommandContext(self, progress, self.terminal, command.name)
                report = command.function(context, *_by_position(call, arguments), **arguments)
                if context.has_drafts:
                    progress.check()
            context.apply_drafts()
        except BaseException:
            self.maps.state = before
            raise
        finally:
            self.timings.append(Timing(command.name, time.perf_counter() - start))
        if call.keeps_flags:
            self.settings.keep(command, dict(call.given))
        return report if isinstance(report, Report) else Message("" if report is None else report)


def _by_position(call: Call, arguments: dict[str, Any]) -> list[Any]:
    """Take out the arguments that must go before *words."""
    if not call.command.variadic:
        return []
    parameters = [call.command.flags[name].path[0] for name in call.command.positional]
    return [arguments.pop(parameter) for parameter in parameters] + list(call.words)


def open_map(folder: str | Path, **flags: Any) -> Session:
    """Start a session with one map loaded.

    Args:
        folder: Folder of a native map.
        **flags: Further flags of the command `load`.

    Raises:
        UserError: The folder holds no map, or a damaged one.
    """
    session = Session()
    session.run("load", map_folder=Path(folder), **flags)
    return session
