"""A tour of the console: ten minutes at the prompt, every step typed by the user and checked."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Callable, Sequence
from pathlib import Path

from maplab_py.console.commands.lines import split_commands
from maplab_py.console.commands.registry import Registry
from maplab_py.console.session.maps import MapManager
from maplab_py.console.terminal.protocol import Terminal
from maplab_py.errors import MaplabError
from maplab_py.plugin import CommandContext, Message, UserError, command
from maplab_py.report import counted
from maplab_py.vimap import VIMap

_SCENARIO = "three_sessions"
_WELCOME = (
    "Ten minutes at the prompt: you type, the console explains. The recordings are simulated."
)


@command(
    "tour",
    example="tour --folder=maplab_tour",
    needs_map=False,
    guards_effects=True,
    see_also=("demo", "help"),
)
def tour(
    context: CommandContext,
    *,
    folder: Path = Path("maplab_tour"),
    skip: bool = False,
    stop: bool = False,
) -> Message:
    """Learn the console in ten minutes: steps that are typed, checked and explained.

    `maplab tour` starts the console with it. In a running tour the command repeats the step.

    Args:
        folder: Folder for the recordings and what the tour writes; recordings in it are used again.
        skip: Go on to the next step.
        stop: End the tour.
    """
    guide = context.session.watchers.find(NAME, Guide)
    if guide is not None and stop:
        context.session.watchers.remove(NAME)
        return Message("The tour has ended; `tour` starts it again.")
    if guide is not None and not guide.is_over:
        if skip:
            guide.skip()
        return Message(guide.text())
    if skip or stop:
        raise UserError("tour: it is not running; start it with: tour")
    if not context.terminal.is_prompt:
        raise UserError("tour: somebody has to type; start it in a terminal with: maplab tour")
    context.maps.check_new_key(MAP_KEY)
    _simulate(context, folder / "sessions")
    session = context.session
    guide = Guide(session.registry, session.terminal, tour_steps(folder))
    if not context.is_trial:
        session.watchers.set(NAME, guide)
    return Message(f"{_WELCOME}\n\n{guide.text()}")


def _simulate(context: CommandContext, folder: Path) -> None:
    """Write the recordings unless an earlier tour has done so."""
    from maplab_py.simulation.raw_data import refuse_used_folder, write_maps
    from maplab_py.simulation.scenario_file import load_scenario

    if (folder / "truth.npz").is_file():
        return
    refuse_used_folder(folder, overwrite=False)
    scenario = load_scenario(_SCENARIO)
    write_maps(scenario, folder, raw_data=False, overwrite=False, progress=context.progress)


NAME = "tour"
_END = """The tour is over. The map is yours to play with; leave with `quit`.
Next: `help` lists the commands, `demo` runs the whole workflow, docs/tutorial.md has the details."""


class Guide:
    """The tour of one session, a watcher of its lines.

    A step is done when all its commands have succeeded, in one line or several, and its result is
    there. Other commands are welcome in between.
    """

    def __init__(self, registry: Registry, terminal: Terminal, steps: Sequence[Step]) -> None:
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


MAP_KEY = "office"
SESSIONS = 3
PLUGIN = "path_lengths"


def _always(_: MapManager) -> str:
    return ""


@dataclasses.dataclass(frozen=True)
class Step:
    """One step."""

    title: str
    why: str
    line: str  # what the user types
    commands: tuple[str, ...]  # full names of the commands that have to succeed
    learned: str  # shown when the step is done
    problem: Callable[[MapManager], str] = (
        _always  # what is still missing; empty = the step is done
    )


def tour_steps(folder: Path) -> tuple[Step, ...]:
    """Return the steps for the sessions in `folder/sessions`."""
    return (*_first_session(folder), *_all_sessions(folder), *_results(folder))


def _path(folder: Path, name: str) -> str:
    return shlex.quote(str(folder / name))


def _session(folder: Path, number: int) -> str:
    return _path(folder / "sessions", f"session_{number}")


def _first_session(folder: Path) -> tuple[Step, ...]:
    return (
        Step(
            "Load a map",
            "A map is a folder. Tab completes commands, flags and paths: try `lo`, Tab.",
            f"load {_session(folder, 1)} --map_key={MAP_KEY}",
            ("load",),
            "The map is in memory under the key in the prompt. The line at the bottom says what it "
            "holds. The folder on the disk changes only when you save.",
            lambda maps: _missing_missions(maps, 1),
        ),
        Step(
            "See what is in it",
            "One row per mission; a mission is one recording.",
            "map_stats",
            ("map_stats",),
            "Vertices are the poses of the camera and IMU, landmarks the points that it saw. "
            "`help map_stats` explains the command, `help` lists all.",
        ),
        Step(
            "Open the viewer",
            "It runs beside the console and follows the map from now on.",
            "visualize",
            ("visualize",),
            "Open the address in a browser if that has not happened by itself. Drag to turn, click on "
            "a vertex or a landmark to see what is known about it.",
        ),
        Step(
            "Optimise it",
            "Odometry drifts. `optvi` fits poses and landmarks to all images and IMU samples at "
            "once; `elq` first finds the landmarks that are good enough. The `;` separates two "
            "commands. On a new machine the kernels are compiled first, which takes up to a minute.",
            "elq; optvi",
            ("evaluate_landmark_quality", "optimize_visual_inertial"),
            "The cost fell, and the viewer shows the new poses. The `*` in the prompt says that the "
            "map has unsaved changes.",
        ),
        Step(
            "Take it back",
            "Every change of a map can be undone, and redone.",
            "undo; redo",
            ("undo", "redo"),
            "Nothing can go wrong that `undo` does not repair: a command that fails, or that you stop "
            "with Ctrl-C, leaves the map as it was.",
        ),
    )


def _all_sessions(folder: Path) -> tuple[Step, ...]:
    return (
        Step(
            "Add two sessions",
            "Two other people walked through the same room. Where they started is unknown.",
            f"load_merge_map {_session(folder, 2)}; load_merge_map {_session(folder, 3)}",
            ("load_merge_map",),
            "Three missions in one map, each in a frame of its own. In the viewer they lie on top of "
            "one another in the wrong place.",
            lambda maps: _missing_missions(maps, SESSIONS),
        ),
        Step(
            "Bring them into one frame",
            "The first mission defines the global frame; `aam` (anchor_all_missions) recognises "
            "places and aligns the others with it.",
            "set_mission_baseframe_to_known; elq; aam",
            ("set_mission_baseframe_to_known", "anchor_all_missions"),
            "All base frames are known now. In the viewer the three paths fill one room.",
            _unknown_baseframes,
        ),
        Step(
            "Ask why",
            "Nothing is decided in secret. `why` lists each test with its value, its threshold and "
            "the flag that moves it: for two missions, a closure or a landmark.",
            "why session_1 session_2",
            ("why",),
            "If two of your own missions are not joined, this table says which test failed and by "
            "how much.",
        ),
        Step(
            "Close the loops",
            "`relax` pulls the paths together over the loop closures; `lc` merges the landmarks that "
            "are one point; `optvi` fits everything once more.",
            "relax; lc; optvi",
            ("relax", "loopclosure_all_missions", "optimize_visual_inertial"),
            "This is the map that all three sessions agree on.",
        ),
    )


def _results(folder: Path) -> tuple[Step, ...]:
    return (
        Step(
            "Compare with the truth",
            "The sessions are simulated, so the true poses are known.",
            f"evaluate_map {_path(folder / 'sessions', 'truth.npz')}",
            ("evaluate_map",),
            "`ATE [m]` at the top is the error of all sessions together: one map, accurate to millimetres.",
        ),
        Step(
            "Save",
            "The map goes to a new folder; the sessions stay as they are.",
            f"save --map_folder={_path(folder, MAP_KEY)} --overwrite",
            ("save",),
            "The folder is replaced as a whole or not at all, also if the power fails. `history "
            "--as_script` prints the commands that led here as a script for the next recording.",
            lambda maps: "" if maps.selected.is_saved else "the map is not saved yet",
        ),
        Step(
            "Write a command of your own",
            "A plugin is a small Python package; its functions become commands with flags, help and "
            "completion.",
            f"new_plugin {PLUGIN} --folder={_path(folder, PLUGIN)}",
            ("new_plugin",),
            "Install it with the first of the lines above, start the console again, and the command "
            "is there.",
            lambda _: "" if (folder / PLUGIN).is_dir() else f"{folder / PLUGIN} is not there yet",
        ),
    )


def _missing_missions(maps: MapManager, wanted: int) -> str:
    if maps.selected_key != MAP_KEY:
        return f"the map '{MAP_KEY}' is not selected"
    count = len(maps.selected.vi_map.missions)
    return "" if count == wanted else f"the map should have {wanted} missions and has {count}"


def _unknown_baseframes(maps: MapManager) -> str:
    from maplab_py.vimap.queries import mission_labels

    vi_map = maps.selected.vi_map
    labels = mission_labels(vi_map)
    is_known = vi_map.baseframes.is_known[vi_map.missions.baseframe]
    unknown = [label for label, known in zip(labels, is_known, strict=True) if not known]
    return f"not in the global frame yet: {', '.join(unknown)}" if unknown else ""
