"""Commands that simulate data with known truth and demonstrate the workflow on them."""

from __future__ import annotations

import dataclasses
import shlex
import time
from pathlib import Path
from typing import TYPE_CHECKING

from maplab_py.plugin import CommandContext, EstimationError, command

if TYPE_CHECKING:
    from maplab_py.simulation import evaluation, reports
    from maplab_py.simulation.scenario import Scenario
    from maplab_py.simulation.simulate import SimulatedData
    from maplab_py.vimap import VIMap

_DEFAULT_SCENARIO = "three_sessions"


@command("list_scenarios", needs_map=False, see_also=("simulate",))
def list_scenarios(_: CommandContext) -> reports.ScenarioList:
    """List the scenarios that `simulate` knows by name."""
    from maplab_py.simulation.scenario_file import list_scenarios as listed

    return listed()


@command(
    "simulate",
    example="simulate --scenario=three_sessions --seed=7 --map_folder=simulated",
    needs_map=False,
    guards_effects=True,
    see_also=("list_scenarios", "evaluate_map", "load_merge_all_maps"),
)
def simulate(
    context: CommandContext,
    *,
    map_folder: Path,
    scenario: str = _DEFAULT_SCENARIO,
    seed: int | None = None,
    raw_data: bool = False,
    overwrite: bool = False,
) -> reports.SimulatedMaps:
    """Simulate sessions with known truth and write one map per session.

    Args:
        map_folder: Folder that gets the maps session_1, session_2, ... and the file truth.npz.
        scenario: Name of a scenario (see list_scenarios), or a YAML file.
        seed: Seed of all random numbers; empty = the seed of the scenario.
        raw_data: Also write EuRoC folders, raw/session_1/mav0, ... with IMU, cameras and, if the
            scenario has `images: {render: true}`, images; their truth goes to the folder truth.
        overwrite: Replace maps that are there already.
    """
    from maplab_py.simulation.raw_data import refuse_used_folder, write_maps
    from maplab_py.simulation.scenario_file import load_scenario

    description = load_scenario(scenario, seed)
    refuse_used_folder(map_folder, overwrite=overwrite)
    return write_maps(
        description, map_folder, raw_data=raw_data, overwrite=overwrite, progress=context.progress
    )


@command(
    "evaluate_map",
    example="evaluate_map --truth=simulated/truth.npz",
    see_also=("simulate",),
    reads=("truth",),
)
def evaluate_map(context: CommandContext, *, truth: Path) -> evaluation.MapErrors:
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
    guards_effects=True,
    see_also=("simulate",),
)
def demo(
    context: CommandContext,
    *,
    map_folder: Path = Path("maplab_demo"),
    seed: int = 1,
    overwrite: bool = False,
) -> reports.DemoReport:
    """Simulate three drifting sessions, merge them by the usual commands, compare with the truth.

    Args:
        map_folder: Where the merged map is written to.
        seed: Seed of the simulation.
        overwrite: Replace a map that is there already.
    """
    from maplab_py.simulation.demo import MAP_KEY, SCENARIO, demonstrate
    from maplab_py.simulation.raw_data import refuse_used_folder
    from maplab_py.simulation.scenario_file import load_scenario

    refuse_used_folder(map_folder, overwrite=overwrite)
    context.maps.check_new_key(MAP_KEY)
    scenario = load_scenario(SCENARIO, seed)
    return demonstrate(_DemoConsole(context), scenario, map_folder, overwrite=overwrite)


@dataclasses.dataclass(frozen=True)
class _DemoConsole:
    """Runs commands in the session."""

    context: CommandContext

    @property
    def vi_map(self) -> VIMap:
        return self.context.session.vi_map

    def simulate(self, scenario: Scenario) -> SimulatedData:
        from maplab_py.simulation.simulate import simulate as simulate_maps

        with self.context.terminal.progress("simulate") as progress:
            return simulate_maps(scenario, progress=progress)

    def run(self, line: str) -> float:
        self.context.progress.line(f"> {line}")
        call = self.context.session.parse(shlex.split(line))
        start = time.perf_counter()
        report = self.context.session.execute(call)
        if report.failure:
            raise EstimationError(f"{call.command.name}: {report.failure}")
        return time.perf_counter() - start
