"""From simulated sessions to a summary map and back to poses, through the session."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from maplab_py.console.commands.registry import load_registry
from maplab_py.console.session.session import Session
from maplab_py.errors import UserError
from tests.simulation.small import simulated

LENIENT = {"elq_min_observers": 3, "elq_min_observation_angle_deg": 1.0}


@pytest.fixture
def session(tmp_path: Path) -> Session:
    session = Session(load_registry())
    data = simulated()
    data.truth.save(tmp_path / "truth.npz")
    session.maps.add("query", data.maps[0])
    session.maps.add("map", data.maps[0])
    session.run("select_map", "map")
    session.run("elq", **LENIENT)
    return session


@pytest.mark.parametrize("kind", ["key", "summary", "folder"])
def test_a_session_is_found_in_its_own_map(session: Session, tmp_path: Path, kind: str) -> None:
    place = {"key": "map", "summary": str(tmp_path / "summary"), "folder": str(tmp_path / "full")}
    if kind == "summary":
        written = session.run("summary_map", summary_map_save_path=tmp_path / "summary")
        shown = session.run("print_summary_map", tmp_path / "summary")
        assert shown.landmarks == written.landmarks
        assert shown.has_projection
        assert shown.cameras == 1
    if kind == "folder":
        session.run("save", map_folder=tmp_path / "full")
    session.run("select_map", "query")
    before = session.vi_map
    table, report_file = tmp_path / "poses.csv", tmp_path / "report.json"
    report = session.run(
        "localize",
        localization_map=place[kind],
        truth=tmp_path / "truth.npz",
        localization_csv=table,
        localization_json=report_file,
    )
    assert session.vi_map is before
    assert report.map_kind == ("summary" if kind == "summary" else "full")
    assert report.success_share > 0.9
    assert report.wrong == 0
    header, *lines = table.read_text().splitlines()
    assert len(lines) == len(before.vertices)
    assert all(len(line.split(",")) == len(header.split(",")) for line in lines)
    assert json.loads(report_file.read_text())["success"] == report.success


def test_other_missions_of_the_same_map_are_searched(session: Session) -> None:
    with pytest.raises(UserError, match="--map_mission"):
        session.run("localize")
    with pytest.raises(UserError, match="neither a map in memory"):
        session.run("localize", localization_map="nowhere")


def test_a_file_is_not_overwritten_unasked(session: Session, tmp_path: Path) -> None:
    session.run("summary_map", summary_map_save_path=tmp_path / "s")
    with pytest.raises(UserError, match="overwrite"):
        session.run("summary_map", summary_map_save_path=tmp_path / "s")
    with pytest.raises(UserError, match="--summary_map_save_path"):
        session.run("summary_map")
    table = tmp_path / "poses.csv"
    table.write_text("mine")
    with pytest.raises(UserError, match="overwrite"):
        session.run("localize", localization_map="map", localization_csv=table)
    assert table.read_text() == "mine"


@pytest.mark.slow
def test_the_workflow_makes_one_localisation_map_of_two_raw_sessions(tmp_path: Path) -> None:
    session = Session(load_registry())
    session.run("simulate", map_folder=tmp_path / "s", scenario="three_sessions")
    session.run("load", map_folder=tmp_path / "s" / "session_1", map_key="raw")
    session.run("load_merge_map", map_folder=tmp_path / "s" / "session_2")
    report = session.run(
        "clsm", num_landmarks_to_keep=800, summary_map_save_path=tmp_path / "summary"
    )
    assert report.missions == 2
    assert report.good_landmarks == len(session.vi_map.landmarks) == 800
    assert session.vi_map.baseframes.is_known.all()
    assert report.vertices < 0.5 * report.steps[0].vertices
    session.run("load", map_folder=tmp_path / "s" / "session_3", map_key="query")
    answer = session.run(
        "localize", localization_map=report.summary_map, truth=tmp_path / "s" / "truth.npz"
    )
    assert answer.success_share > 0.5
    assert answer.wrong <= 0.02 * answer.queries
    assert np.isfinite(answer.position_error_m.median)
