"""The commands simulate, list_scenarios, evaluate_map and demo, as they are typed."""

import json
from pathlib import Path

import pytest

from maplab_py.console.session.session import Session
from maplab_py.errors import UserError
from maplab_py.simulation.truth import Truth
from maplab_py.storage.native import load_map
from tests.e2e.support import run_program

SCENARIO = """
name: tiny
world: {landmarks_per_room: 800}
measurement: {frame_rate_hz: 4.0, max_keypoints: 80}
sessions: [{duration_s: 4.0, turns: 0.2}, {duration_s: 3.0, turns: 0.2, start_turn: 0.1}]
"""


@pytest.fixture
def scenario(tmp_path: Path) -> Path:
    path = tmp_path / "tiny.yaml"
    path.write_text(SCENARIO)
    return path


def test_simulate_writes_maps_and_truth(tmp_path: Path, scenario: Path) -> None:
    session = Session()
    report = session.run("simulate", scenario=str(scenario), map_folder=tmp_path / "out")
    assert [line.folder.name for line in report.maps] == ["session_1", "session_2"]
    vi_map, _ = load_map(tmp_path / "out" / "session_1")
    assert len(vi_map.vertices) == report.maps[0].vertices == 17
    truth = Truth.load(report.truth)
    assert len(truth.vertex_id) == 17 + 13


def test_simulated_maps_are_evaluated_against_their_truth(tmp_path: Path, scenario: Path) -> None:
    session = Session()
    report = session.run("simulate", scenario=str(scenario), map_folder=tmp_path / "out")
    session.run("load_merge_all_maps", maps_folder=tmp_path / "out")
    assert session.run("check_map_consistency").failure == ""
    errors = session.run("evaluate_map", truth=report.truth)
    assert len(errors.missions) == 2
    assert errors.ate_m > errors.ate_each_m > 0.0
    session.run("load", map_folder=tmp_path / "out" / "session_2")
    errors = session.run("evaluate_map", truth=report.truth)
    trajectory = session.run("evaluate_trajectory", ground_truth=report.truth)
    assert trajectory.matched == 13
    assert trajectory.ape_m.rmse == pytest.approx(errors.ate_m, rel=1e-6)
    assert trajectory.scale is not None


def test_simulate_refuses_a_folder_in_use(tmp_path: Path, scenario: Path) -> None:
    session = Session()
    (tmp_path / "used").mkdir()
    (tmp_path / "used" / "thesis.txt").write_text("years of work")
    with pytest.raises(UserError, match=r"used is not empty.*--overwrite"):
        session.run("simulate", scenario=str(scenario), map_folder=tmp_path / "used")
    with pytest.raises(UserError, match="is a file"):
        session.run("simulate", scenario=str(scenario), map_folder=tmp_path / "used" / "thesis.txt")
    with pytest.raises(UserError, match="--seed=-1"):
        session.run("simulate", scenario=str(scenario), seed=-1, map_folder=tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_demo_refuses_a_folder_in_use(tmp_path: Path) -> None:
    (tmp_path / "maplab_demo").mkdir()
    (tmp_path / "maplab_demo" / "file").write_text("")
    done = run_program(tmp_path, "demo")
    assert done.returncode == 2
    assert "maplab_demo is not empty" in done.stderr


@pytest.mark.slow
def test_demo_keeps_its_promises(tmp_path: Path) -> None:
    done = run_program(tmp_path, "--json", "demo", "--seed=2", seconds=300)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout.splitlines()[-1])["report"]
    assert report["ate_after_m"] <= 0.25 * report["ate_before_m"]
    assert len(report["missions"]) == 3
    for mission in report["missions"]:
        assert mission["anchoring_offset_m"] <= 0.05
        assert mission["anchoring_yaw_deg"] <= 0.3
    merged, _ = load_map(tmp_path / "maplab_demo")
    assert len(merged.missions) == 3
