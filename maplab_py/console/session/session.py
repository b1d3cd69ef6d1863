"""A session: maps, lasting flags, timings, and the running of commands as transactions."""

from __future__ import annotations

import copy
import dataclasses
import functools
import html
import threading
import time
from collections import Counter
from collections.abc import Callable, Hashable, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from maplab_py import cancellation, memory, output_files
from maplab_py.console.commands.lines import split_commands
from maplab_py.console.commands.registry import Registry, load_registry
from maplab_py.console.session import jobs, log, provenance, settings
from maplab_py.console.session.call import Call, call_from_keywords, call_from_words
from maplab_py.console.session.context import CommandContext
from maplab_py.console.session.maps import MapEntry, MapManager, MapsState, merge_states
from maplab_py.console.terminal.protocol import SilentTerminal, Terminal
from maplab_py.errors import EstimationError
from maplab_py.report import Message, Report, to_html

if TYPE_CHECKING:
    from maplab_py.vimap import VIMap
import logging
from functools import partial
from typing import TYPE_CHECKING, Protocol, TypeVar, runtime_checkable

MEASURED = "accuracy"
"""Key in `Session.results`, with that of a map: a weak reference to its value, and its accuracy in words."""


@dataclasses.dataclass(frozen=True)
class Timing:
    """Run time of one command."""

    command: str
    seconds: float


@dataclasses.dataclass(frozen=True)
class Refusal:
    """Command line that was refused, and the command line that mends the cause."""

    line: str
    remedy: str


@dataclasses.dataclass(frozen=True)
class Page:
    """A page of the viewer, which a notebook embeds."""

    url: str
    height_px: int

    def _repr_html_(self) -> str:
        """Return the frame that shows the page."""
        style = f"width: 100%; height: {self.height_px}px; border: 0"
        return f'<iframe src="{html.escape(self.url)}" style="{style}"></iframe>'


class Session:
    """Maps, flags, jobs and timings of a console, a script or a Python program.

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
        self.settings = settings.Settings(self.registry)
        self.timings: list[Timing] = []
        self.jobs = jobs.JobBoard()
        self.aliases: dict[str, str] = {}
        self.uses: Counter[str] = Counter()  # how often each command was typed
        self.variables: dict[str, str] = {}  # $NAME in typed lines, before the environment's
        self.marks: dict[str, str] = {}  # shown around the prompt: the sheep, a viewer's address
        self.refusal: Refusal | None = None  # the last one that a command can mend
        self.provenance = provenance.Provenance()
        self.results: dict[Hashable, object] = {}  # what commands compare their next result with
        self.lock = threading.RLock()  # held while a command of the foreground runs
        self._is_draft = False  # what a running command sees of the session
        self.watchers = Watchers(self.terminal.note)  # follow the maps, as the viewer does

    @property
    def vi_map(self) -> VIMap:
        """The selected map."""
        return self.maps.selected.vi_map

    @property
    def mission_names(self) -> dict[str, str]:
        """Labels of all missions in memory by id; those of the selected map take precedence."""
        from maplab_py.console.terminal.render import names_by_id
        from maplab_py.vimap.ids import to_hex_list
        from maplab_py.vimap.queries import mission_labels

        entries = sorted(self.maps, key=lambda entry: entry.key == self.maps.selected_key)
        missions: list[tuple[str, str]] = []
        for vi_map in (entry.vi_map for entry in entries):
            if len(vi_map.missions):
                ids, labels = to_hex_list(vi_map.missions.id), mission_labels(vi_map)
                missions += [
                    pair for pair in zip(ids, labels, strict=True) if pair[1] not in pair[0]
                ]
        return names_by_id(missions)

    def view(self, height_px: int = 600, **flags: Any) -> Page:
        """Show the selected map in the viewer and embed its page in a notebook.

        The page is live: it follows the map as long as this Python process runs.

        Args:
            height_px: Height of the page in the notebook.
            flags: Flags of the command `visualize`.

        Raises:
            UserError: No map is selected, or it has no vertices.
        """
        report = self.run("visualize", **{"viewer_port": 0, **flags})
        return Page(str(report.as_dict()["url"]), height_px)

    def __repr__(self) -> str:
        """Say in one line which maps are in memory."""
        maps = ", ".join(f"{entry.key}: {entry.vi_map!r}" for entry in self.maps)
        return f"Session({maps or 'no map'})"

    def _repr_html_(self) -> str:
        """Return the maps in memory as a table, for notebooks."""
        rows = [
            {
                "map": entry.key + (" (selected)" if entry.key == self.maps.selected_key else ""),
                "missions": len(entry.vi_map.missions),
                "vertices": len(entry.vi_map.vertices),
                "landmarks": len(entry.vi_map.landmarks),
                "saved": "yes" if entry.is_saved else "no",
            }
            for entry in self.maps
        ]
        return to_html(rows) if rows else "no map in memory"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
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
        described = self.registry.find(command)
        with self.lock:
            return self.execute(call_from_keywords(described, words, flags, self.settings))

    def parse(self, words: Sequence[str]) -> Call:
        """Read the words of one command line into a call."""
        return call_from_words(words, self.registry, self.settings)

    def run_line(self, text: str, terminal: Terminal) -> None:
        """Run the commands of a line inside another command, and show their reports.

        Raises:
            MaplabError: The first error of any of them.
        """
        for words in split_commands(text):
            call = self.parse(words)
            report = self.execute(call)
            terminal.show(report, call.command.name)
            if report.failure:
                raise EstimationError(
                    f"{call.command.name}: {report.failure}", remedy=report.remedy
                )

    def set_flags(self, assignments: Sequence[str]) -> list[settings.Setting]:
        """Set flags for the rest of the session, all or none of them.

        Raises:
            FlagError: A flag is unknown, or no command with this flag takes the value.
        """
        return self.settings.assign(assignments, settings.Layer.SET, "set")

    def execute(self, call: Call) -> Report:
        """Run a call as a transaction: if it fails or is cancelled, all maps are as before."""
        base = self.maps.state
        try:
            command = call.command
            is_unguarded = command.acts_outside and not command.guards_effects
            with cancellation.lasting_effect() if is_unguarded else nullcontext():
                report, result = self.compute(call, base, self.terminal)
                with cancellation.lasting_effect(is_last=not self._is_draft):
                    self.maps.state, _ = merge_states(base, result, self.maps.state)
        finally:
            self.watchers.after_command(self.maps)
        return report

    def compute(self, call: Call, base: MapsState, terminal: Terminal) -> tuple[Report, MapsState]:
        """Run a call on a state of the maps; return its report and the resulting state.

        The maps of the session do not change.

        Raises:
            MaplabError: The command failed.
        """
        command, arguments = call.command, call.arguments()
        draft = copy.copy(self)  # on which the command works
        draft._is_draft = True
        draft.maps, draft.terminal, draft.lock = MapManager(base), terminal, threading.RLock()
        if command.needs_map:
            _ = draft.maps.selected
        start = time.perf_counter()
        try:
            with terminal.progress(command.name, call.verbosity) as progress:
                context = CommandContext(
                    draft, progress, terminal, command.name, is_trial=call.is_trial
                )
                with output_files.staging(enabled=not command.acts_outside) as staged:
                    report = _call(call, context, arguments)
                    if context.has_drafts and not cancellation.current_token().has_effects:
                        progress.check()
                    if staged.files:
                        with cancellation.lasting_effect():
                            staged.publish()
            context.apply_drafts()
        finally:
            self.timings.append(Timing(command.name, time.perf_counter() - start))
        if call.keeps_flags:
            self.settings.keep(command, dict(call.given))
        if not isinstance(report, Report):
            report = Message(report or "")
        if call.is_trial:
            return report, base
        self.provenance.record(call, base, draft.maps.state)
        for problem in self.provenance.write_cards(call, base, draft.maps.state, self._accuracy_of):
            terminal.note(problem)
        return report, draft.maps.state

    def _accuracy_of(self, entry: MapEntry) -> str:
        """Return the accuracy of the present value of a map if it was measured; see `MEASURED`."""
        measured = self.results.get((MEASURED, entry.key))
        if not isinstance(measured, tuple) or measured[0]() is not entry.vi_map:
            return ""
        return str(measured[1])

    def start(self, command: str, *words: str, **flags: Any) -> jobs.Job:
        """Start a command in the background; see `run`. The job knows its state and its report."""
        call = call_from_keywords(self.registry.find(command), words, flags, self.settings)
        return self.start_call(call, call.command.name)

    def start_call(self, call: Call, text: str) -> jobs.Job:
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
        if registry is None or name.startswith("_") or not registry.knows(name):
            raise AttributeError(f"a session has no attribute and no command '{name}'")
        return functools.partial(self.run, name)

    def __dir__(self) -> list[str]:
        return sorted({*super().__dir__(), *(n for n in self.registry.names if n.isidentifier())})


def _call(call: Call, context: CommandContext, arguments: dict[str, Any]) -> Any:
    """Call the function; a trial lists the files instead of writing them."""
    words = _by_position(call, arguments)
    with memory.memory_limited(call.max_memory_gb):
        if not call.is_trial:
            return call.command.function(context, *words, **arguments)
        with output_files.planning() as planned:
            report = call.command.function(context, *words, **arguments)
    for file in planned:
        context.terminal.note(str(file))
    return report


def _by_position(call: Call, arguments: dict[str, Any]) -> list[Any]:
    """Remove and return the arguments that precede *words."""
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


# Watchers observe the maps of a session, as the viewer does. They never change maps.

logger = logging.getLogger(__name__)

WatcherT = TypeVar("WatcherT")


class Watcher(Protocol):
    """Observer of the maps of a session."""

    def after_command(self, maps: MapManager) -> None:
        """Observe the maps after a command; also called if the command failed."""

    def during_command(self, make_map: Callable[[], VIMap]) -> None:
        """Observe the intermediate result of a running command; calling `make_map` is optional."""

    def close(self) -> None:
        """Stop observing: the session ends."""


@runtime_checkable
class LineWatcher(Protocol):
    """A watcher that also observes the lines that are typed at the prompt."""

    def after_line(self, line: str, *, succeeded: bool) -> None:
        """Observe a line whose reports have been shown."""


class Watchers:
    """The watchers of a session by name.

    An error in a watcher never fails a command: the traceback goes to the log, and the user sees one
    message until the watcher works again.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        """Start without watchers; `say` prints a line for the user."""
        self._watchers: dict[str, Watcher] = {}
        self._say = say
        self._told: set[str] = set()

    def set(self, name: str, watcher: Watcher) -> None:
        """Add a watcher, or replace the one of this name."""
        self._watchers[name] = watcher

    def find(self, name: str, kind: type[WatcherT]) -> WatcherT | None:
        """Return the watcher of this name and type, None if there is none."""
        watcher = self._watchers.get(name)
        return watcher if isinstance(watcher, kind) else None

    def remove(self, name: str) -> None:
        """Close and remove a watcher."""
        watcher = self._watchers.pop(name, None)
        if watcher is not None:
            self._guard(name, watcher.close)
        self._told.discard(name)

    def after_command(self, maps: MapManager) -> None:
        """Notify all watchers."""
        for name, watcher in list(self._watchers.items()):
            if self._guard(name, partial(watcher.after_command, maps)):
                self._told.discard(name)

    def during_command(self, make_map: Callable[[], VIMap]) -> None:
        """Notify all watchers of an intermediate result."""
        for name, watcher in list(self._watchers.items()):
            self._guard(name, partial(watcher.during_command, make_map))

    def after_line(self, line: str, *, succeeded: bool) -> None:
        """Notify the watchers that observe typed lines."""
        for name, watcher in list(self._watchers.items()):
            if isinstance(watcher, LineWatcher):
                self._guard(name, partial(watcher.after_line, line, succeeded=succeeded))

    def close(self) -> None:
        """Close all."""
        for name in list(self._watchers):
            self.remove(name)

    def _guard(self, name: str, action: Callable[[], None]) -> bool:
        try:
            action()
        except Exception:
            logger.exception("the %s failed", name)
            if name not in self._told:
                self._told.add(name)
                self._say(f"the {name} could not follow the map (see {log.log_path()})")
            return False
        return True
