"""Every file in flags/: its commands and flags exist, and the scripts do their work on real maps."""

import json
import shutil
from pathlib import Path

import pytest

from maplab_py.algorithms.self_calibration.device import device_of
from maplab_py.console.commands.lines import typed_commands
from maplab_py.console.scripts.batch import read_stages
from maplab_py.console.session.session import Session
from maplab_py.console.session.settings import Layer
from maplab_py.pipeline.plan import Pipeline, ordered
from maplab_py.sensors.yaml_text import parse_yaml
from maplab_py.simulation.scenario import Scenario
from maplab_py.storage.native import save_map
from maplab_py.vimap.tables import LandmarkQuality
from tests.e2e.support import run_program
from tests.registry.workspace import ROUND
from tests.simulation.small import SMALL, simulated
from tests.support.data import REPOSITORY, shared_data

FLAGS = REPOSITORY / "flags"
PLACES = ["--maps_folder=maps", "--map_folder=out"]


@pytest.mark.parametrize("script", sorted(FLAGS.glob("*.maplab")), ids=lambda path: path.name)
def test_every_line_of_a_script_is_a_command_with_its_flags(script: Path) -> None:
    session = Session()
    session.settings.assign(PLACES, Layer.START_UP, "start-up")
    commands = typed_commands(script.read_text(), lambda name: f"value_of_{name}")
    assert len(commands) > 5
    for command in commands:
        call = session.parse(command.words)
        call.arguments()


@pytest.mark.parametrize("path", sorted(FLAGS.glob("*.flags")), ids=lambda path: path.name)
def test_every_flag_of_a_flag_file_exists(path: Path) -> None:
    session = Session()
    session.settings.assign_file(path, Layer.START_UP)
    assert session.settings.current()


def test_every_line_of_the_pipeline_is_a_command_with_its_flags() -> None:
    path = FLAGS / "city.yaml"
    stages = read_stages(parse_yaml(path.read_text(), path.name)["stages"], path)
    assert [stage.name for stage in ordered(Pipeline(path.name, (), stages))] == [
        stage.name for stage in stages
    ]
    session = Session()
    for stage in stages:
        for command in typed_commands("\n".join(stage.commands)):
            session.parse(command.words).arguments()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("script", "maps"),
    [
        ("single_session", "euroc_v1_01/euroc_v1_01_submap_[0-3]"),
        ("multi_session", "tango_handheld"),
    ],
)
def test_scripts_on_real_maps(tmp_path: Path, script: str, maps: str) -> None:
    for folder in shared_data("maplab_maps").glob(maps):
        shutil.copytree(folder, tmp_path / "maps" / folder.name)
    places = ["--maps_folder=maps", f"--map_folder={tmp_path / 'out'}"]
    done = run_program(
        tmp_path, "--json", "run", str(FLAGS / f"{script}.maplab"), *places, seconds=600
    )
    assert done.returncode == 0, done.stderr
    reports = [json.loads(line) for line in done.stdout.splitlines()]
    assert [report["command"] for report in reports][-1] == "save"
    again = run_program(tmp_path, "--json", "-c", f"load {tmp_path / 'out'}; check_map_consistency")
    assert again.returncode == 0, again.stderr


def simulated_maps(folder: Path, scenario: Scenario = SMALL) -> None:
    """Write two small maps below a folder."""
    for number, vi_map in enumerate(simulated(scenario).maps):
        save_map(vi_map, folder / f"walk_{number}")


@pytest.mark.slow
def test_localization_map(tmp_path: Path) -> None:
    simulated_maps(tmp_path / "maps", ROUND)
    places = ["--maps_folder=maps/walk_0", "--map_folder=small"]
    script = str(FLAGS / "localization_map.maplab")
    done = run_program(tmp_path, "--json", "run", script, *places, seconds=300)
    assert done.returncode == 0, done.stderr
    with Session() as session:
        session.run("load", map_folder=tmp_path / "maps" / "walk_0")
        before = session.vi_map
        session.run("load", map_folder=tmp_path / "small")
        after = session.vi_map
    assert 0 < len(after.vertices) < len(before.vertices)
    assert (after.landmarks.quality == LandmarkQuality.GOOD).all()


@pytest.mark.slow
def test_calibration(tmp_path: Path) -> None:
    simulated_maps(tmp_path / "maps", ROUND)
    # a short walk shows no accelerometer scale
    words = ["--maps_folder=maps/walk_0", "--map_folder=calibrated", "--sc_states=intrinsics"]
    script = str(FLAGS / "calibration.maplab")
    done = run_program(tmp_path, "--json", "run", script, *words, seconds=300)
    assert done.returncode == 0, done.stderr
    reports = {
        line["command"]: line["report"] for line in map(json.loads, done.stdout.splitlines())
    }
    found = {one["parameter"]: one for one in reports["self_calibrate"]["parameters"]}
    focal = found["camera focal length u"]
    assert focal["before"] != focal["after"]
    again = run_program(tmp_path, "--json", "-c", "load calibrated; check_map_consistency")
    assert again.returncode == 0, again.stderr
    with Session() as session:
        session.run("load", map_folder=tmp_path / "calibrated")
        rig_id = device_of(session.vi_map)[1]
        camera = session.vi_map.sensors.camera_rig(rig_id).cameras[0]
    assert camera.intrinsics[0] == pytest.approx(focal["after"], abs=1e-6)


@pytest.mark.slow
def test_batch_over_a_folder(tmp_path: Path) -> None:
    simulated_maps(tmp_path / "maps")
    batch = str(FLAGS / "batch.yaml")
    done = run_program(tmp_path, "batch", batch, "--json", "--maps_folder=maps", seconds=300)
    assert done.returncode == 0, done.stderr
    reports = [json.loads(line) for line in done.stdout.splitlines()]
    assert [report["command"] for report in reports].count("save") == 2
    assert len(list(tmp_path.glob("maps/*/vertex_poses_velocities_biases.csv"))) == 2
    done = run_program(tmp_path, "batch", batch, "--maps_folder=nowhere")
    assert done.returncode == 2
    assert "there is no map in it or below it" in done.stderr


@pytest.mark.slow
def test_city_pipeline(tmp_path: Path) -> None:
    simulated_maps(tmp_path / "maps", ROUND)
    words = ("batch", str(FLAGS / "city.yaml"), "--maps_folder=maps", "--json")
    done = run_program(tmp_path, *words, seconds=600)
    assert done.returncode == 0, done.stderr
    stages = json.loads(done.stdout)["report"]["stages"]
    assert [stage["done"] for stage in stages] == [2, 1, 1, 4]
    results = tmp_path / "city_results" / "summaries"
    assert len(list(results.glob("*/summary_map/*"))) == 4
    assert len(list(results.glob("*/map/metadata"))) == 4
