"""A session: maps, lasting flags, timings, and the running of commands as transactions."""

from __future__ import annotations

import copy
import dataclasses
import functools
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from maplab_py.console.call import Call, call_from_keywords, call_from_words
from maplab_py.console.cancellation import current_token
from maplab_py.console.context import CommandContext
from maplab_py.console.jobs import Job, JobBoard
from maplab_py.console.lines import split_commands
from maplab_py.console.maps import MapManager, MapsState, merge_states
from maplab_py.console.registry import Registry, load_registry
from maplab_py.console.settings import Layer, Setting, Settings
from maplab_py.console.terminal import SilentTerminal, Terminal
from maplab_py.console.watchers import Watchers
from maplab_py.errors import Cancelled
from maplab_py.output_files import planning
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
            report = session.optvi(ba_num_iterations=20)  # or session.run("optvi", ...)
            print(report.cost_after)
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
        self.jobs = JobBoard()
        self.aliases: dict[str, str] = {}
        self.variables: dict[str, str] = {}  # $NAME in typed lines, before the environment's
        self.marks: dict[str, str] = {}  # shown around the prompt: the sheep, a viewer's address
        self.lock = threading.RLock()  # held while a command of the foreground runs
        self.watchers = Watchers(self.terminal.note)  # follow the maps, as the viewer does

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
        self.watchers.close()
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
        with self.lock:
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
        base = self.maps.state
        try:
            report, result = self.compute(call, base, self.terminal)
            if current_token().abandoned:
                raise Cancelled("cancelled")
            self.maps.state, _ = merge_states(base, result, self.maps.state)
        finally:
            self.watchers.after_command(self.maps)
        return report

    def compute(self, call: Call, base: MapsState, terminal: Terminal) -> tuple[Report, MapsState]:
        """Run a call on a state of the maps; return its report and what it made of them.

        The session's own maps stay as they are.

        Raises:
            MaplabError: The command failed.
        """
        command, arguments = call.command, call.arguments()
        draft = self._with_maps(MapManager(base), terminal)
        if command.needs_map:
            _ = draft.maps.selected
        start = time.perf_counter()
        try:
            with terminal.progress(command.name, call.verbosity) as progress:
                context = CommandContext(
                    draft, progress, terminal, command.name, is_trial=call.is_trial
                )
                report = _called(call, context, arguments)
                if context.has_drafts:
                    progress.check()
            context.apply_drafts()
        finally:
            self.timings.append(Timing(command.name, time.perf_counter() - start))
        if call.keeps_flags:
            self.settings.keep(command, dict(call.given))
        found = report if isinstance(report, Report) else Message(report or "")
        return found, base if call.is_trial else draft.maps.state

    def start(self, command: str, *words: str, **flags: Any) -> Job:
        """Start a command in the background; see `run`. The job knows its state and its report."""
        call = call_from_keywords(self.registry.find(command), words, flags, self.settings)
        return self.start_call(call, call.command.name)

    def start_call(self, call: Call, text: str) -> Job:
        """Start a call in the background, on the maps as they are now.

        Raises:
            UserError: The call cannot be carried out as given.
        """
        call.arguments()
        if call.command.needs_map:
            _ = self.maps.selected
        return self.jobs.start(self, call, text)

    def __getattr__(self, name: str) -> Callable[..., Report]:
        """Return a command as a function: `session.optvi(ba_num_iterations=20)`."""
        registry = self.__dict__.get("registry")
        if registry is None or name not in registry.names:
            raise AttributeError(f"a session has no attribute and no command '{name}'")
        return functools.partial(self.run, name)

    def __dir__(self) -> list[str]:
        return sorted({*super().__dir__(), *(n for n in self.registry.names if n.isidentifier())})

    def _with_maps(self, maps: MapManager, terminal: Terminal) -> Session:
        """Return this session as a running command shall see it: with its own draft of the maps."""
        inside = copy.copy(self)
        inside.maps, inside.terminal, inside.lock = maps, terminal, threading.RLock()
        return inside


def _called(call: Call, context: CommandContext, arguments: dict[str, Any]) -> Any:
    """Call the function; a trial writes no files but tells of them."""
    words = _by_position(call, arguments)
    if not call.is_trial:
        return call.command.function(context, *words, **arguments)
    with planning() as planned:
        report = call.command.function(context, *words, **arguments)
    for file in planned:
        context.terminal.note(str(file))
    return report


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
