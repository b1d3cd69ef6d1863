"""Ctrl-C in commands of every kind and on a large map: the prompt is back, nothing has changed.

All commands: `python -m benchmarks.interruptions`.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.e2e.support import Console, run_program
from tests.registry.workspace import folder_digest
from tests.support.data import shared_data
from tests.support.interruptions import Interrupter, Workspace
from tests.support.machine import slowness

pytestmark = pytest.mark.slow

CTRL_C = "\x03"
SECONDS_TO_THE_PROMPT = 1.0
ATTEMPTS = 3
"""Other work on the machine may hold one of them up: the fastest counts."""
LARGE = """
name: large
world: {rooms: 2, landmarks_per_room: 10000}
measurement: {frame_rate_hz: 10.0, max_keypoints: 400}
sessions:
  - {kind: room_scan, duration_s: 60.0, turns: 2.0}
"""


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a simulated map of 600 vertices and some 200 000 observations."""
    home = tmp_path_factory.mktemp("large")
    (home / "large.yaml").write_text(LARGE)
    script = (
        "simulate --scenario=large.yaml --map_folder=maps;"
        "load_merge_all_maps maps --target_map_key=big; elq; save --map_folder=map;"
        # compiled kernels are on the disk afterwards: compiling is not what is measured
        "optvi --ba_num_iterations=1; lc; landmark_sparsify --num_landmarks_to_keep=2000"
    )
    done = run_program(home, "-c", script, "--discard", seconds=500)
    assert done.returncode == 0, done.stderr
    return home


LINES = (
    ("optvi", (0.3, 1.0)),
    ("lc", (1.0,)),
    ("landmark_sparsify --num_landmarks_to_keep=2000", (0.5,)),
    ("load --map_folder=map --map_key=again", (0.1,)),
)


def test_ctrl_c(large: Path, tmp_path: Path) -> None:
    console = Console(large)
    console.wait_for_prompt()
    console.enter("load --map_folder=map")
    console.wait_for_prompt("maplab <map>:/$")
    for line, pauses in LINES:
        for pause_s in pauses:
            check_interruption(console, line, pause_s)
    console.enter(f"save --map_folder={tmp_path}/saved")
    console.wait_for(lambda screen: "save: " in screen, 60.0)  # what was left behind still runs
    console.wait_for_prompt("maplab <map>:/$")
    console.enter("quit")
    assert console.status() == 0
    assert folder_digest(tmp_path / "saved") == folder_digest(large / "map")


def check_interruption(console: Console, line: str, pause_s: float) -> None:
    """See the prompt come back in time."""
    passed: list[float] = []
    while not passed or (passed[-1] > SECONDS_TO_THE_PROMPT * slowness()):
        assert len(passed) < ATTEMPTS, f"{line} after {pause_s} s: {passed} s"
        passed.append(interrupt(console, line, pause_s))
        name = line.split(maxsplit=1)[0]
        print(f"{name} interrupted after {pause_s} s: prompt after {passed[-1]:.2f} s")


def interrupt(console: Console, line: str, pause_s: float) -> float:
    """Type a line, press Ctrl-C after a while, return the seconds until the prompt is back."""
    console.enter(line)
    end = time.monotonic() + pause_s
    console.wait_for(lambda _: time.monotonic() >= end)
    start = time.monotonic()
    console.child.send(CTRL_C)
    console.wait_for(lambda _: console.last_line.endswith("<map>:/$"), 20.0)
    passed = time.monotonic() - start
    assert "cancelled; the maps are as before" in console.text, console.text
    console.enter("!clear")
    console.wait_for(lambda screen: screen.startswith("maplab <map>:/$") and "^C" not in screen)
    console.wait_for_prompt("maplab <map>:/$")
    return passed


PROMPT_S = 1.0
NAMES = (
    "csv_export",  # several files
    "load",
    "optimize_visual_inertial",
    "plot_trajectory",  # imports a heavy library
    "save",
    "simulate",
    "stereo_dense_reconstruction",
    "train_projection_matrix",
    "visualize",
)


@pytest.fixture(scope="module")
def interrupter(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Interrupter]:
    tango = shared_data("maplab_maps/tango_handheld")
    console = Interrupter(Workspace(tmp_path_factory.mktemp("interruptions"), tango))
    yield console
    console.close()


@pytest.mark.parametrize("name", NAMES)
def test_the_prompt_is_back_and_nothing_has_changed(interrupter: Interrupter, name: str) -> None:
    presses = interrupter.interrupt(name, at_most_s=3.0)
    assert [press for press in presses if press.harm] == []
    assert {press.outcome for press in presses} <= {"cancelled", "done"}
    # other work on the machine may hold one of them up: the second slowest counts
    assert sorted(press.prompt_s for press in presses)[-2] <= PROMPT_S * slowness(), presses
