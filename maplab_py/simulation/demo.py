"""The demonstration: three drifting sessions, merged by the usual commands, against the truth."""

import shlex
import tempfile
import time
from pathlib import Path
from typing import Protocol

from maplab_py.simulation.evaluation import MapErrors, evaluate_map
from maplab_py.simulation.raw_data import session_folders
from maplab_py.simulation.reports import DemoMission, DemoReport, DemoStep
from maplab_py.simulation.scenario import Scenario
from maplab_py.simulation.simulate import SimulatedData
from maplab_py.storage.native import save_map
from maplab_py.vimap import VIMap

SCENARIO = "three_sessions"
MAP_KEY = "demo"


class DemoConsole(Protocol):
    """The console that runs the workflow."""

    @property
    def vi_map(self) -> VIMap:
        """The selected map."""

    def simulate(self, scenario: Scenario) -> SimulatedData:
        """Simulate the sessions."""

    def run(self, line: str) -> float:
        """Run a command line; return its seconds, without those that it waits for kernels.

        Raises:
            EstimationError: The command ran but reports a failure.
        """


def demonstrate(
    console: DemoConsole, scenario: Scenario, map_folder: Path, *, overwrite: bool
) -> DemoReport:
    """Simulate the sessions, run the workflow and save the merged map to a folder."""
    start = time.perf_counter()
    data = console.simulate(scenario)
    steps = [DemoStep("simulate", time.perf_counter() - start)]
    with tempfile.TemporaryDirectory() as sessions:
        for folder, vi_map in zip(
            session_folders(Path(sessions), len(data.maps)), data.maps, strict=True
        ):
            save_map(vi_map, folder)
        target = f"--target_map_key={MAP_KEY}"
        seconds = console.run(f"load_merge_all_maps --maps_folder={shlex.quote(sessions)} {target}")
        steps.append(DemoStep(f"load_merge_all_maps {target}", seconds))
    before = evaluate_map(console.vi_map, data.truth)
    workflow = _workflow(before.missions[0].mission, map_folder, overwrite=overwrite)
    steps += [DemoStep(line, console.run(line)) for line in workflow]
    after = evaluate_map(console.vi_map, data.truth)
    return _report(tuple(steps), before, after, map_folder)


def _workflow(first_mission: str, map_folder: Path, *, overwrite: bool) -> tuple[str, ...]:
    """Return the commands of the workflow after the sessions are loaded."""
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


def _report(
    steps: tuple[DemoStep, ...], before: MapErrors, after: MapErrors, map_folder: Path
) -> DemoReport:
    missions = tuple(
        DemoMission(b.mission, b.vertices, b.ate_m, a.ate_m, a.offset_m, a.yaw_deg)
        for b, a in zip(before.missions, after.missions, strict=True)
    )
    return DemoReport(steps, missions, before.ate_each_m, after.ate_m, after.scale, map_folder)
