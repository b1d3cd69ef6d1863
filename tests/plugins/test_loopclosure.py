"""The loop closure and relaxation commands, through the session."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest

from maplab_py.console.commands.registry import load_registry
from maplab_py.console.session.session import Session
from maplab_py.console.terminal.render import rendered
from tests.algorithms.loop_closure.rooms import Walk, make_map

DRIFT = (0.2, -0.1, 0.05, 0.01)
TWICE = [Walk(room=1), Walk(room=1, start_s=60.0, drift=DRIFT)]
UNRELATED = [Walk(room=1), Walk(room=2, start_s=60.0)]


def session_of(walks: list[Walk]) -> Session:
    session = Session(load_registry())
    session.maps.add("rooms", make_map(walks)[0])
    return session


@pytest.mark.parametrize("command", ["lc", "lcom", "loopclosure_all_missions"])
def test_loops_are_closed_by_merging(command: str) -> None:
    session = session_of(TWICE)
    before = len(session.vi_map.landmarks)
    report = session.run(command)
    assert report.failure == ""
    assert len(session.vi_map.landmarks) == before - report.landmarks_merged < before


def test_edges_instead_of_merging_and_their_removal() -> None:
    session = session_of(TWICE)
    report = session.run("lc", lc_insert_lc_edge_instead_of_merging=True)
    assert len(session.vi_map.loop_closure_edges) == report.edges_added > 0
    assert report.landmarks_merged == 0
    removed = session.run("dlc")
    assert f"removed {report.edges_added}" in removed.text
    assert len(session.vi_map.loop_closure_edges) == 0


@pytest.mark.parametrize("command", ["relax", "srelax"])
def test_relaxing_brings_the_two_walks_together(command: str) -> None:
    session = session_of(TWICE)
    truth = make_map(TWICE)[1]
    before = np.linalg.norm(session.vi_map.T_G_I[:, 4:] - truth[:, 4:], axis=1).max()
    report = session.run(command)
    assert report.failure == ""
    after = np.linalg.norm(session.vi_map.T_G_I[:, 4:] - truth[:, 4:], axis=1).max()
    assert after < 0.4 * before
    assert len(session.vi_map.loop_closure_edges) == 0


def test_relaxing_may_merge_too() -> None:
    session = session_of(TWICE)
    report = session.run("relax", lc_relax_merge_landmarks=True)
    assert report.merging.landmarks_merged > 100


@pytest.mark.parametrize(("command", "times"), [("lc", 1), ("relax", 1), ("srelax", 1)])
def test_a_search_without_loops_succeeds_and_says_why(command: str, times: int) -> None:
    session = session_of(UNRELATED)
    before = session.vi_map.T_G_I
    report = session.run(command)
    assert report.failure == ""
    assert rendered(report, io.StringIO()).count("no loop closures") == times
    np.testing.assert_array_equal(session.vi_map.T_G_I, before)


def test_seed_and_gates_are_flags() -> None:
    session = session_of(TWICE)
    report = session.run("lc", lc_seed=7, lc_min_inlier_count=1000)
    assert "needed 1000" in report.reason


def test_closures_are_listed_removed_and_forgotten(tmp_path: Path) -> None:
    session = session_of(TWICE)
    assert "lc" in session.run("lc_report").notes[0]
    report = session.run("lc")
    listed = session.run("lc_report", limit=5, file=tmp_path / "closures.csv")
    assert listed.recorded == report.candidates
    assert len(listed.closures) == listed.shown == 5
    assert len((tmp_path / "closures.csv").read_text().splitlines()) == 1 + report.accepted
    before = len(session.vi_map.landmarks)
    name = listed.closures[0].id
    removed = session.run("remove_loopclosure", closures=name, neighbors_s=60.0)
    assert name in removed.closures
    assert len(session.vi_map.landmarks) == before + removed.landmarks_restored > before
    session.run("undo")
    assert len(session.vi_map.landmarks) == before
    session.run("delete_loopclosure_record")
    assert session.run("lc_report").recorded == 0


def test_a_projection_is_trained_and_used(tmp_path: Path) -> None:
    session = session_of(TWICE)
    report = session.run("train_projection_matrix", file=tmp_path / "projection.npz")
    assert (report.descriptor_size, report.dimensions) == (48, 10)
    assert report.same_distance < 0.5 * report.other_distance
    plain = session.run("lc", lc_insert_lc_edge_instead_of_merging=True)
    trained = session.run(
        "lc",
        lc_insert_lc_edge_instead_of_merging=True,
        lc_projection_matrix_filename=str(tmp_path / "projection.npz"),
    )
    assert trained.accepted == plain.accepted
    session.run("train_projection_matrix", file=tmp_path / "6.npz", lc_target_dimensionality=6)
    coarse = session.run("lc", lc_projection_matrix_filename=str(tmp_path / "6.npz"))
    assert coarse.accepted > 0.8 * plain.accepted


def test_a_projection_for_other_descriptors_is_told(tmp_path: Path) -> None:
    np.savez(tmp_path / "short.npz", matrix=np.ones((10, 64)))
    session = session_of(TWICE)
    report = session.run("lc", lc_projection_matrix_filename=str(tmp_path / "short.npz"))
    assert report.accepted > 0
    assert "learned a projection from the map" in report.notes[0]
