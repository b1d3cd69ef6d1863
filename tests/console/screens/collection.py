"""The screens of all commands: the example of each, in the folder of `tests.registry.workspace`."""

import os
import shutil
from contextlib import chdir
from pathlib import Path

import pytest

from maplab_py.console.commands.registry import Registry, load_registry
from maplab_py.console.scripts.runner import Runner
from maplab_py.console.session.maps import MapsState
from maplab_py.console.session.session import Session
from maplab_py.console.session.status import Status
from maplab_py.vimap import MissionSensor
from maplab_py.vimap.ids import to_hex
from tests.console.screens.recording import WIDTHS, Screen, changed, screen_of, text_of
from tests.console.screens.stable import Stable
from tests.registry.workspace import (
    MERGED,
    OTHER_EXAMPLES,
    SERVED,
    SLOW,
    WITH_ROBOT,
    lines_before,
    make_workspace,
)

GOLDEN = Path(__file__).with_name("golden")
NOT_RECORDED = {
    **dict.fromkeys((*SERVED, "get_dense_map_in_range"), "asks a server: tests/server"),
    **dict.fromkeys(WITH_ROBOT, "waits for a robot: tests/interop/live"),
    "install_features": "writes into the user's data folder: tests/vision/features/learned",
    "recover": "loads what a failed script left: tests/console/scripts/test_typed_lines.py",
    "resource_cache_statistics": "counts what the whole process has read",
    "save_view": "needs a browser: tests/viewer",
    "tour": "is typed by a person: tests/e2e/test_tour.py",
    "warmup": "compiles for minutes",
}
LONG = {
    *SLOW,
    "convert_all_depth_maps_to_point_clouds",
    "create_esdf_from_depth_resource",
    "create_localization_summary_map",
    "create_mesh_from_tsdf_grid",
    "create_tsdf_from_depth_resource",
    "export_colmap_mvs",
    "export_for_pmvs_reconstruction",
    "export_segments",
    "extract_features",
    "plot_coobservability",
    "prune_segments",
    "register_point_clouds",
    "rovioli",
    "stereo_dense_reconstruction",
    "suggest_motion",
    "track_features",
    "visualize_esdf",
    "visualize_mesh",
}
"""Commands that take more than half a second with what precedes them."""


_CLOSED = f"{MERGED}; sbk --map_mission=59f0; lc"
FURTHER = {
    "evaluate_trajectory_again": (
        f"{MERGED}; evaluate_trajectory V1_01_easy.csv",
        "evaluate_trajectory V1_01_easy.csv",
    ),
    "help_of_a_plugin": ("", "help --plugin=vi_map_basic"),
    "history_of_a_map": (f"{MERGED}; rlq; undo", "history"),
    "lc_report_accepted": (_CLOSED, "lc_report --which=accepted --limit=3"),
    "lc_report_refused": (_CLOSED, "lc_report --which=refused --sort_by=near_miss --limit=3"),
    "load_without_map": ("", "load maps"),
    "map_stats_of_a_mission": (MERGED, "map_stats --map_mission=59f0"),
    "mission_coobservability_stats_of_joined": (_CLOSED, "mission_coobservability_stats"),
    "save_dry_run": (MERGED, "save --map_folder=maps/v1_01 --overwrite --dry_run"),
    "set_wrong_value": ("", "set --ba_loss=hubert"),
    "snapshots": (f"{MERGED}; snapshot before; snapshot after", "snapshot"),
    "timing": ("list", "timing"),  # more commands would be sorted by their times
    "unknown_mission": (MERGED, "sbk --map_mission=nosuch"),
    "why_closure": (_CLOSED, "why {closure}"),
    "why_landmark": (MERGED, "why {landmark}"),
    "why_pair": (_CLOSED, "why 59f0 a1b2"),
}
"""Further reports by a name, or other lines for a command: what is typed first, and the line."""


def recorded_commands(registry: Registry) -> list[str]:
    """Return the names of the commands, and of the further reports, that have a golden screen."""
    names = [command.name for command in registry.commands if registry.is_built_in(command)]
    return sorted({*FURTHER, *(name for name in names if name not in NOT_RECORDED)})


class Collection:
    """Runs the examples of commands and draws what they show."""

    def __init__(self, folder: Path) -> None:
        """Write the files that examples name.

        Args:
            folder: An empty folder.
        """
        self._registry = load_registry()
        self._original, self._copies = folder / "original", folder / "copies"
        self._original.mkdir()
        self._copies.mkdir()
        make_workspace(self._original)
        self._merged: MapsState | None = None

    def screens(self, name: str) -> str:
        """Return the golden text of a command: its example, once for widths at which it is the same."""
        here = self._copies / name
        shutil.copytree(self._original, here, copy_function=os.link)
        try:
            with chdir(here):
                line, shown = self._shown(name)
        finally:
            shutil.rmtree(here)
        widths: dict[str, list[str]] = {}
        for width in WIDTHS:
            widths.setdefault(text_of(shown, width), []).append(str(width))
        parts = [f"== {', '.join(at)} columns: {line}\n\n{text}\n" for text, at in widths.items()]
        return "\n".join(parts)

    def _shown(self, name: str) -> tuple[str, list[object]]:
        screen = Screen()
        session = Session(self._registry, screen)
        runner = Runner(session, screen)
        try:
            before, line = FURTHER.get(name) or (
                lines_before(name),
                OTHER_EXAMPLES.get(name, self._registry.find(name).example),
            )
            self._prepare(runner, name, before)
            shown = screen_of(runner, screen, self._completed(session, name, line))
        finally:
            screen.transcribe(None)
            session.watchers.close()
        stable = Stable(name)
        return line, changed(shown, stable.text, stable.value)

    def _prepare(self, runner: Runner, name: str, lines: str) -> None:
        """Run the lines that precede a line; those that most lines need only once."""
        if lines.startswith(MERGED) and not name.startswith(("history", "undo", "reproduce")):
            if self._merged is None:
                _run(runner, MERGED)
                self._merged = runner.session.maps.state
            runner.session.maps.state = self._merged
            lines = lines.removeprefix(MERGED).lstrip("; ")
        _run(runner, lines)

    def _completed(self, session: Session, name: str, line: str) -> str:
        """Return an example with the ids that nobody knows beforehand."""
        if name in ("remove_loopclosure", "judge_closures"):
            closures = session.run("lc_report").as_dict()["closures"]
            return line.replace("59f0a1b2", closures[0]["id"])
        if name == "import_point_clouds":
            imu_id = to_hex(session.vi_map.missions.sensor_id[0, MissionSensor.IMU])
            return line.replace("5c1a", imu_id)
        if "{closure}" in line:
            closures = session.run("lc_report", which="refused", sort_by="near_miss").as_dict()
            return line.format(closure=closures["closures"][0]["id"])
        if "{landmark}" in line:
            return line.format(landmark=to_hex(session.vi_map.landmarks.id[0]))
        return line


def _run(runner: Runner, lines: str) -> None:
    status = runner.run_text(lines)
    assert status == Status.OK, f"{lines}: {runner.terminal.__dict__.get('shown')}"


def parameters(registry: Registry) -> list[object]:
    """Return the parameters of the test of each command."""
    return [
        pytest.param(name, marks=pytest.mark.slow if name in LONG else ())
        for name in recorded_commands(registry)
    ]
