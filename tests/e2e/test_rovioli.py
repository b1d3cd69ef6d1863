"""rovioli in a terminal: the status line, and Ctrl-C that keeps what is there."""

import re
from pathlib import Path

import pytest

from maplab_py.storage.native import load_map, save_map
from maplab_py.vimap.consistency import check_consistency
from tests.e2e.support import Console, run_program
from tests.frontend.simulated import REST_FIRST, replayed

pytestmark = pytest.mark.slow

CTRL_C = "\x03"
STATUS = re.compile(r"(\d+\.\d) s  (?:\S+ x real time  )?\d+ tracks")
MOVING_S = 3.0
"""By then the device moves, and the window has frames that are vertices."""


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a recording, after a run that has compiled all kernels."""
    home = tmp_path_factory.mktemp("home")
    save_map(replayed(REST_FIRST, 2)[0], home / "walk")
    done = run_program(home, "rovioli", "walk", "--save_map_folder=whole", seconds=600)
    assert done.returncode == 0, done.stderr
    assert "good landmarks" in done.stdout
    return home


def test_ctrl_c_ends_the_recording_and_saves(home: Path) -> None:
    console = Console(home)
    console.wait_for_prompt()
    console.enter("rovioli walk --save_map_folder=part --vio_rosbag_realtime_playback_rate=0.5")
    console.wait_for(lambda screen: any(float(s) > MOVING_S for s in STATUS.findall(screen)))
    console.child.send(CTRL_C)
    console.wait_for_text("of the recording: the map of")
    console.wait_for_prompt("maplab <part>:/$")
    assert "saved to part" in console.unwrapped
    console.enter("quit")
    assert console.status() == 0
    part, whole = load_map(home / "part")[0], load_map(home / "whole")[0]
    assert 2 <= len(part.vertices) < len(whole.vertices)
    assert check_consistency(part).failure == ""


def test_ctrl_c_before_anything_is_estimated_brings_the_prompt_back(home: Path) -> None:
    console = Console(home)
    console.wait_for_prompt()
    console.enter("rovioli walk --vio_rosbag_realtime_playback_rate=0.01")
    console.wait_for(lambda screen: "tracks" in screen)
    console.child.send(CTRL_C)
    console.wait_for_text("the maps are as before")
    console.wait_for_prompt()
    console.enter("quit")
    assert console.status() == 0


def test_a_job_is_ended_and_saves(home: Path) -> None:
    console = Console(home)
    console.wait_for_prompt()
    console.enter("rovioli walk --save_map_folder=job --vio_rosbag_realtime_playback_rate=0.1 &")
    console.wait_for(lambda screen: "[1]" in screen or "job 1" in screen)
    for _ in range(100):
        console.enter("!clear")
        console.wait_until_still()
        console.enter("jobs")
        if STATUS.search(console.wait_until_still()) is not None:
            break
    console.enter("cancel 1")
    console.wait_for(lambda _: (home / "job" / "vi_map" / "vi_map_metadata").exists())
    console.enter("join 1")
    console.wait_for_text("of the recording: the map of")
    console.enter("quit")
    console.close()
    assert check_consistency(load_map(home / "job")[0]).failure == ""
