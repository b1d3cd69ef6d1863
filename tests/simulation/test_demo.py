"""The demonstration with a console that only writes down what it is asked for."""

from __future__ import annotations

from pathlib import Path

from maplab_py.simulation.demo import demonstrate
from maplab_py.simulation.scenario import Scenario
from maplab_py.simulation.simulate import SimulatedData
from maplab_py.vimap import VIMap
from tests.simulation.small import simulated


class RecordingConsole:
    def __init__(self) -> None:
        self.data = simulated()
        self.lines: list[str] = []

    @property
    def vi_map(self) -> VIMap:
        return self.data.maps[0]

    def simulate(self, _: Scenario) -> SimulatedData:
        return self.data

    def run(self, line: str) -> float:
        self.lines.append(line)
        return 1.0


def test_the_usual_commands_are_run_in_order(tmp_path: Path) -> None:
    console = RecordingConsole()
    report = demonstrate(console, Scenario(), tmp_path / "my demo", overwrite=False)
    first = report.missions[0].mission
    load, *workflow = console.lines
    assert load.startswith("load_merge_all_maps --maps_folder=")
    assert workflow == [
        "evaluate_landmark_quality",
        "optimize_visual_inertial",
        f"set_mission_baseframe_to_known --map_mission={first}",
        "anchor_all_missions",
        "relax",
        "loopclosure_all_missions",
        "optimize_visual_inertial",
        f"save --map_folder='{tmp_path}/my demo'",
    ]
    shown = [step.command for step in report.steps]
    assert shown == ["simulate", "load_merge_all_maps --target_map_key=demo", *workflow]


def test_a_map_that_stays_as_it_was_has_missed_the_goal(tmp_path: Path) -> None:
    report = demonstrate(RecordingConsole(), Scenario(), tmp_path, overwrite=True)
    assert report.ate_after_m == report.ate_before_m > 0.0
    assert "initial error" in report.failure or "wrongly anchored" in report.failure
