"""The example distribution of docs/writing_plugins.md, installed and run as a stranger's plugin."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from maplab_py.storage.native import save_map
from tests.simulation.small import simulated
from tests.support.data import REPOSITORY

EXAMPLE = REPOSITORY / "docs" / "examples" / "maplab_hello"


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Install the example beside nothing else and return the folder."""
    folder = tmp_path_factory.mktemp("installed")
    source = tmp_path_factory.mktemp("source") / "maplab_hello"
    shutil.copytree(EXAMPLE, source)
    words = ["install", "--quiet", "--no-deps", "--no-build-isolation", "--target", str(folder)]
    done = subprocess.run(
        [sys.executable, "-m", "pip", *words, str(source)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return folder


def _maplab(installed: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    paths = [str(installed), *filter(None, [os.environ.get("PYTHONPATH", "")])]
    return subprocess.run(
        [sys.executable, "-m", "maplab_py", *arguments],
        capture_output=True,
        text=True,
        check=False,
        cwd=installed,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
    )


def test_the_console_lists_it(installed: Path) -> None:
    done = _maplab(installed, "--json", "plugins")
    assert done.returncode == 0, done.stderr
    plugins = {line["plugin"]: line for line in json.loads(done.stdout)["report"]["plugins"]}
    assert plugins["hello"]["version"] == "1.0.0"
    assert plugins["hello"]["commands"] == 2
    assert plugins["hello"]["problem"] == ""


def test_its_commands_run_on_a_map(installed: Path, tmp_path: Path) -> None:
    save_map(simulated().maps[0], tmp_path / "map")
    script = (
        f"load {tmp_path / 'map'}; cfl --far_distance_m=3; "
        f"rename_description --text='a small room'; save --map_folder={tmp_path / 'renamed'}"
    )
    done = _maplab(installed, "--json", "-c", script)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout.splitlines()[1])["report"]
    assert report["landmarks"] == len(simulated().maps[0].landmarks)
    assert 0 < report["far"] < report["landmarks"]
    assert "a small room" in (tmp_path / "renamed" / "metadata").read_text()


def test_its_options_refuse_nonsense(installed: Path, tmp_path: Path) -> None:
    save_map(simulated().maps[0], tmp_path / "map")
    done = _maplab(installed, "-c", f"load {tmp_path / 'map'}; cfl --far_distance_m=-1")
    assert done.returncode == 2
    assert "--far_distance_m must be greater than 0" in done.stderr
