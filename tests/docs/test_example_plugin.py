"""The example distribution of docs/writing_plugins.md, installed and run as a stranger's plugin."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from maplab_py.storage.native import save_map
from maplab_py.vimap.ids import to_hex_list
from tests.simulation.small import simulated
from tests.support.data import REPOSITORY

EXAMPLE = REPOSITORY / "docs" / "examples" / "maplab_hello"


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return install_example(EXAMPLE, tmp_path_factory)


def install_example(example: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Install an example beside nothing else and return the folder."""
    folder = tmp_path_factory.mktemp("installed")
    source = tmp_path_factory.mktemp("source") / example.name
    shutil.copytree(example, source)
    words = ["install", "--quiet", "--no-deps", "--no-build-isolation", "--target", str(folder)]
    done = subprocess.run(
        [sys.executable, "-m", "pip", *words, str(source)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return folder


def run_maplab(installed: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
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
    done = run_maplab(installed, "--json", "plugins")
    assert done.returncode == 0, done.stderr
    plugins = {line["plugin"]: line for line in json.loads(done.stdout)["report"]["plugins"]}
    assert plugins["hello"]["version"] == "1.0.0"
    assert plugins["hello"]["commands"] == 3
    assert plugins["hello"]["problem"] == ""


def test_its_commands_run_on_a_map(installed: Path, tmp_path: Path) -> None:
    save_map(simulated().maps[0], tmp_path / "map")
    script = (
        f"load {tmp_path / 'map'}; cfl --far_distance_m=3; "
        f"rename_description --text='a small room'; save --map_folder={tmp_path / 'renamed'}"
    )
    done = run_maplab(installed, "--json", "-c", script)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout.splitlines()[1])["report"]
    assert report["landmarks"] == len(simulated().maps[0].landmarks)
    assert 0 < report["far"] < report["landmarks"]
    assert "a small room" in (tmp_path / "renamed" / "metadata").read_text()


def test_its_options_refuse_nonsense(installed: Path, tmp_path: Path) -> None:
    save_map(simulated().maps[0], tmp_path / "map")
    done = run_maplab(installed, "-c", f"load {tmp_path / 'map'}; cfl --far_distance_m=-1")
    assert done.returncode == 2
    assert "--far_distance_m=-1: must be above 0" in done.stderr


def test_its_residual_takes_part_in_optvi(installed: Path, tmp_path: Path) -> None:
    save_map(simulated().maps[0], tmp_path / "map")
    script = f"load {tmp_path / 'map'}; optvi --ba_residuals=flat_floor --ba_num_iterations=3"
    done = run_maplab(installed, "--json", "--discard", "-c", script)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout.splitlines()[1])["report"]
    terms = {term["term"]: term for term in report["terms"]}
    assert terms["flat_floor"]["count"] == len(simulated().maps[0].vertices)
    assert terms["flat_floor"]["cost_after"] < terms["flat_floor"]["cost_before"]


def test_a_residual_that_no_plugin_has_is_refused(installed: Path, tmp_path: Path) -> None:
    save_map(simulated().maps[0], tmp_path / "map")
    done = run_maplab(installed, "-c", f"load {tmp_path / 'map'}; optvi --ba_residuals=flat_flor")
    assert done.returncode == 2
    assert "no plugin has a residual 'flat_flor'; there are: flat_floor" in done.stderr


def test_its_importer_makes_a_map(installed: Path, tmp_path: Path) -> None:
    rows = "0,0,0\n1,0,0\n1,2,0\n"
    (tmp_path / "a walk.csv").write_text(rows)
    script = f"import_positions '{tmp_path / 'a walk.csv'}' --period_s=0.5; check_map_consistency"
    done = run_maplab(installed, "--json", "--discard", "-c", f"{script}; map_stats")
    assert done.returncode == 0, done.stderr
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert lines[0]["report"]["map_key"] == "a_walk"
    assert lines[0]["report"]["vertices"] == 3
    assert lines[2]["report"]["missions"][0]["distance_m"] == pytest.approx(3.0)
    assert lines[2]["report"]["missions"][0]["duration_s"] == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("import_positions nowhere.csv", "nowhere.csv: no such file or folder"),
        ("import_positions bad.csv", "bad.csv: could not convert string"),
        ("import_positions two.csv", "two.csv: two or more rows of three numbers are expected"),
        ("import_positions good.csv --map_key=a/b", "'a/b' cannot be a map key"),
        ("import_positions good.csv --period=1", "--period_s"),
    ],
)
def test_its_importer_refuses_what_is_no_path(installed: Path, line: str, message: str) -> None:
    (installed / "bad.csv").write_text("x,y,z\n")
    (installed / "two.csv").write_text("1,2\n3,4\n")
    (installed / "good.csv").write_text("1,2,3\n3,4,5\n")
    done = run_maplab(installed, "-c", line)
    assert done.returncode == 2
    assert message in done.stderr


def test_its_layer_is_in_the_pictures(installed: Path, tmp_path: Path) -> None:
    save_map(simulated().maps[0], tmp_path / "map")
    code = f"""
import maplab_py
from maplab_py.viewer.building import Subject, build_scene
with maplab_py.open_map({str(tmp_path / "map")!r}) as session:
    scene = build_scene(Subject(session.vi_map.replace(landmarks=session.vi_map.landmarks.replace(
        p_I=10.0 * session.vi_map.landmarks.p_I))))
layer = scene.layer("far_landmarks")
print(layer.title, layer.is_visible, layer.total, layer.drawn, sorted(layer.parts))
"""
    paths = [str(installed), *filter(None, [os.environ.get("PYTHONPATH", "")])]
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
    )
    assert done.returncode == 0, done.stderr
    vi_map = simulated().maps[0]
    far = int((np.linalg.norm(10.0 * vi_map.landmarks.p_I, axis=1) > 20.0).sum())
    assert far > 10
    ids = to_hex_list(vi_map.missions.id)
    assert done.stdout.strip() == f"Far landmarks False {far} {far} {ids}"
