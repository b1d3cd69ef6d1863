"""Commands that make data with known truth, and show the whole workflow on it."""

from __future__ import annotations

import contextlib
import dataclasses
import shlex
import tempfile
import time
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

from maplab_py.plugin import CommandContext, EstimationError, Report, UserError, command

if TYPE_CHECKING:
    from maplab_py.algorithms.warmup import CompilationAhead
    from maplab_py.simulation.evaluation import MapErrors
    from maplab_py.simulation.scenario import Scenario

TRUTH_FILE = "truth.npz"

_DEMO_SCENARIO = "three_sessions"
_DEMO_KEY = "demo"
_NEEDS = {
    "anchor_all_missions": ("absolute pose by gravity", "descriptor search"),
    "relax": ("relaxation",),
}
"""What another process compiles meanwhile, in this order, and which command waits for it.

The rest is compiled where it is used: both processes then have about as much to do.
"""
_MAX_ATE_RATIO = 0.25
_MAX_OFFSET_M = 0.05
_MAX_YAW_DEG = 0.3


@dataclasses.dataclass(frozen=True)
class ScenarioLine:
    """One scenario."""

    scenario: str
    sessions: int
    seconds: float
    description: str


@dataclasses.dataclass(frozen=True)
class ScenarioList(Report):
    """The scenarios that come with the program."""

    scenarios: tuple[ScenarioLine, ...]


@dataclasses.dataclass(frozen=True)
class SimulatedMap:
    """One session that was written."""

    folder: Path
    vertices: int
    keypoints: int
    landmarks: int


@dataclasses.dataclass(frozen=True)
class SimulatedMaps(Report):
    """All sessions of a scenario, and where the truth is."""

    maps: tuple[SimulatedMap, ...]
    truth: Path
    raw_data: tuple[Path, ...]  # EuRoC folders


@dataclasses.dataclass(frozen=True)
class DemoStep:
    """One command of the workflow."""

    command: str
    seconds: float


@dataclasses.dataclass(frozen=True)
class DemoMission:
    """Errors of one session before and after."""

    mission: str
    vertices: int
    ate_before_m: float
    ate_after_m: float
    anchoring_offset_m: float
    anchoring_yaw_deg: float


@dataclasses.dataclass(frozen=True)
class DemoReport(Report):
    """What the workflow made of three drifting sessions, against the truth."""

    steps: tuple[DemoStep, ...]
    missions: tuple[DemoMission, ...]
    ate_before_m: float  # every session aligned by itself: they have no common frame yet
    ate_after_m: float  # all sessions aligned together
    scale_after: float
    map_folder: Path

    @property
    def failure(self) -> str:
        """Say which promise was not kept."""
        misplaced = [
            line.mission
            for line in self.missions
            if not (
                line.anchoring_offset_m <= _MAX_OFFSET_M and line.anchoring_yaw_deg <= _MAX_YAW_DEG
            )
        ]
        if misplaced:
            return f"wrongly anchored: {', '.join(misplaced)}"
        if not self.ate_after_m <= _MAX_ATE_RATIO * self.ate_before_m:
            return f"the error is not down to {_MAX_ATE_RATIO:g} of what it was"
        return ""


@command("list_scenarios", needs_map=False, see_also=("simulate",))
def list_scenarios(context: CommandContext) -> ScenarioList:  # noqa: ARG001
    """List the scenarios that `simulate` knows by name."""
    from maplab_py.simulation.scenario_file import load_scenario, scenario_names

    lines = []
    for name in scenario_names():
        scenario = load_scenario(name)
        seconds = sum(session.total_s for session in scenario.sessions)
        lines.append(ScenarioLine(name, len(scenario.sessions), seconds, scenario.description))
    return ScenarioList(tuple(lines))


@command(
    "simulate",
    example="simulate --scenario=three_sessions --seed=7 --map_folder=simulated",
    needs_map=False,
    acts_outside=True,
    see_also=("list_scenarios", "evaluate_map", "load_merge_all_maps"),
)
def simulate(
    context: CommandContext,
    *,
    map_folder: Path,
    scenario: str = _DEMO_SCENARIO,
    seed: int | None = None,
    raw_data: bool = False,
    overwrite: bool = False,
) -> SimulatedMaps:
    """Simulate sessions with known truth and write one map per session.

    Args:
        map_folder: Folder that gets the maps session_1, session_2, ... and the file truth.npz.
        scenario: Name of a scenario (see list_scenarios), or a YAML file.
        seed: Seed of everything random; empty = the scenario's own.
        raw_data: Also write EuRoC folders, raw/session_1/mav0, ... with IMU, cameras and, if the
            scenario has `images: {render: true}`, images; their truth goes to the folder truth.
        overwrite: Replace maps that are there already.
    """
    from maplab_py.simulation.scenario_file import load_scenario
    from maplab_py.simulation.simulate import simulate as simulate_maps
    from maplab_py.storage.native import save_map

    description = load_scenario(scenario)
    if seed is not None:
        description = description.with_seed(_checked_seed(seed))
    _refuse_used_folder(map_folder, overwrite=overwrite)
    data = simulate_maps(description, progress=context.progress)
    lines = []
    for folder, vi_map in zip(_session_folders(map_folder, len(data.maps)), data.maps, strict=True):
        context.progress.check()
        save_map(vi_map, folder, overwrite=overwrite)
        counts = len(vi_map.vertices), len(vi_map.keypoints), len(vi_map.landmarks)
        lines.append(SimulatedMap(folder, *counts))
    data.truth.save(map_folder / TRUTH_FILE)
    folders: list[Path] = []
    if raw_data:
        from maplab_py.simulation.raw_data import write_raw_data

        folders = write_raw_data(
            description, data, map_folder, overwrite=overwrite, progress=context.progress
        )
    return SimulatedMaps(tuple(lines), map_folder / TRUTH_FILE, tuple(folders))


@command("evaluate_map", example="evaluate_map --truth=simulated/truth.npz", see_also=("simulate",))
def evaluate_map(context: CommandContext, *, truth: Path) -> MapErrors:
    """Compare the selected map with the truth of its simulation.

    Args:
        truth: The file truth.npz that `simulate` wrote.
    """
    from maplab_py.simulation.evaluation import evaluate_map as evaluate
    from maplab_py.simulation.truth import Truth

    return evaluate(context.vi_map, Truth.load(truth))


@command(
    "demo",
    example="demo --map_folder=maplab_demo",
    needs_map=False,
    acts_outside=True,
    see_also=("simulate",),
)
def demo(
    context: CommandContext,
    *,
    map_folder: Path = Path("maplab_demo"),
    seed: int = 1,
    overwrite: bool = False,
) -> DemoReport:
    """Simulate three drifting sessions, merge them by the usual commands, compare with the truth.

    Args:
        map_folder: Where the merged map is written to.
        seed: Seed of the simulation.
        overwrite: Replace a map that is there already.
    """
    from maplab_py.algorithms.warmup import CompilationAhead
    from maplab_py.simulation.scenario_file import load_scenario

    _refuse_used_folder(map_folder, overwrite=overwrite)
    context.maps.check_new_key(_DEMO_KEY)
    scenario = load_scenario(_DEMO_SCENARIO).with_seed(_checked_seed(seed))
    with contextlib.closing(CompilationAhead(tuple(chain.from_iterable(_NEEDS.values())))) as ahead:
        return _demonstrate(context, scenario, map_folder, ahead, overwrite=overwrite)


def _demonstrate(
    context: CommandContext,
    scenario: Scenario,
    map_folder: Path,
    ahead: CompilationAhead,
    *,
    overwrite: bool,
) -> DemoReport:
    """Run the workflow, each command as soon as its kernels are compiled."""
    from maplab_py.simulation.evaluation import evaluate_map as evaluate
    from maplab_py.simulation.simulate import simulate as simulate_maps
    from maplab_py.storage.native import save_map

    start = time.perf_counter()
    with context.terminal.progress("simulate") as progress:
        data = simulate_maps(scenario, progress=progress)
    steps = [DemoStep("simulate", time.perf_counter() - start)]
    with tempfile.TemporaryDirectory() as sessions:
        for folder, vi_map in zip(
            _session_folders(Path(sessions), len(data.maps)), data.maps, strict=True
        ):
            save_map(vi_map, folder)
        load = f"load_merge_all_maps --maps_folder={shlex.quote(sessions)}"
        steps.append(_run(context, f"{load} --target_map_key={_DEMO_KEY}"))
    before = evaluate(context.session.vi_map, data.truth)
    first = before.missions[0].mission
    workflow = _workflow(first, map_folder, overwrite=overwrite)
    steps += [_run(context, line, ahead) for line in workflow]
    after = evaluate(context.session.vi_map, data.truth)
    return _demo_report(tuple(steps), before, after, map_folder)


def _workflow(first_mission: str, map_folder: Path, *, overwrite: bool) -> tuple[str, ...]:
    """Return what a user would type once the sessions are loaded."""
    return (
        "evaluate_landmark_quality",
        "optimize_visual_inertial",
        f"set_mission_baseframe_to_known --map_mission={first_mission}",
        "anchor_all_missions",
        "relax",
        "loopclosure_all_missions",
        "optimize_visual_inertial",
        f"save --map_folder={shlex.quote(str(map_folder))}{' --overwrite' if overwrite else ''}",
    )


def _run(context: CommandContext, line: str, ahead: CompilationAhead | None = None) -> DemoStep:
    """Run one line of the workflow as if it had been typed; waits for its kernels.

    Raises:
        EstimationError: The command ran but reports a failure.
    """
    context.progress.line(f"> {line}")
    call = context.session.parse(shlex.split(line))
    start = time.perf_counter()
    if ahead is not None:
        for job in _NEEDS.get(call.command.name, ()):
            ahead.wait(job, context.progress)
    report = context.session.execute(call)
    if report.failure:
        raise EstimationError(f"{call.command.name}: {report.failure}")
    shown = " ".join(word for word in line.split() if not word.startswith("--maps_folder"))
    return DemoStep(shown, time.perf_counter() - start)


def _demo_report(
    steps: tuple[DemoStep, ...], before: MapErrors, after: MapErrors, map_folder: Path
) -> DemoReport:
    missions = tuple(
        DemoMission(b.mission, b.vertices, b.ate_m, a.ate_m, a.offset_m, a.yaw_deg)
        for b, a in zip(before.missions, after.missions, strict=True)
    )
    return DemoReport(steps, missions, before.ate_each_m, after.ate_m, after.scale, map_folder)


def _session_folders(folder: Path, count: int) -> list[Path]:
    return [folder / f"session_{number + 1}" for number in range(count)]


def _checked_seed(seed: int) -> int:
    if seed < 0:
        raise UserError(f"--seed={seed}: must be 0 or greater")
    return seed


def _refuse_used_folder(folder: Path, *, overwrite: bool) -> None:
    """Refuse a folder that holds something, before any work is done."""
    if folder.exists() and not folder.is_dir():
        raise UserError(f"--map_folder={folder} is a file")
    if not overwrite and folder.is_dir() and any(folder.iterdir()):
        raise UserError(f"--map_folder={folder} is not empty; give another one or --overwrite")
