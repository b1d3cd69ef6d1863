"""Every file in flags/: its commands and flags exist, and the scripts do their work on real maps."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from maplab_py.console.lines import split_commands
from maplab_py.console.registry import load_registry
from maplab_py.console.session import Session
from maplab_py.console.settings import Layer
from tests.e2e.support import run_program
from tests.support.data import REPOSITORY, shared_data

FLAGS = REPOSITORY / "flags"
PLACES = ["--maps_folder=maps", "--map_folder=out"]


@pytest.mark.parametrize("script", sorted(FLAGS.glob("*.maplab")), ids=lambda path: path.name)
def test_every_line_of_a_script_is_a_command_with_its_flags(script: Path) -> None:
    session = Session(load_registry())
    session.settings.assign(PLACES, Layer.START_UP, "start-up")
    commands = split_commands(script.read_text())
    assert len(commands) > 5
    for words in commands:
        call = session.parse(words)
        call.arguments()


@pytest.mark.parametrize("path", sorted(FLAGS.glob("*.flags")), ids=lambda path: path.name)
def test_every_flag_of_a_flag_file_exists(path: Path) -> None:
    session = Session(load_registry())
    session.settings.assign_file(path, Layer.START_UP)
    assert session.settings.current()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("script", "maps"),
    [
        ("single_session", "maplab_maps/euroc_v1_01"),
        ("multi_session", "maplab_maps/tango_handheld"),
    ],
)
def test_scripts_on_real_maps(tmp_path: Path, script: str, maps: str) -> None:
    places = [f"--maps_folder={shared_data(maps)}", f"--map_folder={tmp_path / 'out'}"]
    done = run_program(
        tmp_path, "--json", "run", str(FLAGS / f"{script}.maplab"), *places, seconds=600
    )
    assert done.returncode == 0, done.stderr
    reports = [json.loads(line) for line in done.stdout.splitlines()]
    assert [report["command"] for report in reports][-1] == "save"
    again = run_program(tmp_path, "--json", "-c", f"load {tmp_path / 'out'}; check_map_consistency")
    assert again.returncode == 0, again.stderr
