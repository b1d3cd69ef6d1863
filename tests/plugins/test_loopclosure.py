"""The loop closure and relaxation commands through the session, of images and of clouds."""

import io
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from maplab_plugins.visualization.following import Following

from maplab_py.algorithms.cloud_registration import registration
from maplab_py.algorithms.loop_closure import closure_record
from maplab_py.console.prompt.completion import complete
from maplab_py.console.session.session import Session
from maplab_py.console.terminal.render import rendered
from maplab_py.errors import FlagError, MapError, UserError
from maplab_py.viewer.scene import Entity
from maplab_py.vimap.ids import to_hex
from tests.algorithms.loop_closure.rooms import Walk, make_map

DRIFT = (0.2, -0.1, 0.05, 0.01)
TWICE = [Walk(room=1), Walk(room=1, start_s=60.0, drift=DRIFT)]
UNRELATED = [Walk(room=1), Walk(room=2, start_s=60.0)]


def session_of(walks: list[Walk]) -> Session:
    session = Session()
    session.maps.add("rooms", make_map(walks)[0])
    return session


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


@pytest.mark.parametrize(("command", "times"), [("lc", 1), ("relax", 1), ("srelax", 1)])
def test_a_search_without_loops_succeeds_and_says_why(command: str, times: int) -> None:
    session = session_of(UNRELATED)
    before = session.vi_map.T_G_I
    report = session.run(command)
    assert report.failure == ""
    assert rendered(report, io.StringIO()).count("no loop closures") == times
    np.testing.assert_array_equal(session.vi_map.T_G_I, before)


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


def test_a_person_accepts_and_refuses_closures() -> None:
    session = session_of(TWICE)
    strict = {"lc_min_inlier_count": 1000}  # refuses all of them
    session.run("lc", **strict)
    before = session.vi_map
    ids = [line.id for line in session.run("lc_report", which="refused").closures]
    report = session.run("judge_closures", accept=ids[0], refuse=f"{ids[1]}, {ids[2]}")
    assert (report.accepted, report.refused, report.edges_added) == ((ids[0],), (ids[1], ids[2]), 1)
    (edge,) = session.vi_map.loop_closure_edges.T_A_B
    closures = closure_record.read_record(session.vi_map).closures
    assert np.array_equal(edge, closures.T_A_B[[to_hex(i)[:8] for i in closures.id].index(ids[0])])
    verdicts = {line.id: line.verdict for line in session.run("lc_report", which="all").closures}
    assert [verdicts[i] for i in ids[:3]] == ["accepted", "removed by hand", "removed by hand"]
    relaxed = session.run("relax", **strict)
    assert relaxed.relaxation.num_loop_closures == 1
    session.run("undo")
    session.run("undo")
    assert session.vi_map is before
    session.run("judge_closures", accept=ids[1])
    with pytest.raises(UserError, match="no closure begins with 'ffff'"):
        session.run("judge_closures", accept="ffff")
    with pytest.raises(UserError, match="both accepted and refused"):
        session.run("judge_closures", accept=ids[0], refuse=ids[0])
    with pytest.raises(UserError, match="give --accept or --refuse"):
        session.run("judge_closures")


def test_verdicts_of_the_page_are_applied() -> None:
    session = session_of(TWICE)
    session.run("lc", lc_min_inlier_count=1000)
    session.run("visualize", viewer_port=0)
    following = session.watchers.find("viewer", Following)
    assert following is not None
    viewer = following.viewer
    with pytest.raises(UserError, match="no verdict was given in the page"):
        session.run("judge_closures")
    page = SimpleNamespace(client=None)
    viewer.court.judge(None, page)
    first = viewer.selection.picked
    assert first is not None
    assert first.entity is Entity.CLOSURE
    viewer.court.judge(True, page)
    assert viewer.selection.picked.row != first.row
    viewer.court.judge(False, page)
    report = session.run("judge_closures")
    assert (len(report.accepted), len(report.refused)) == (1, 1)
    name = to_hex(closure_record.read_record(session.vi_map).closures.id[first.row])[:8]
    assert report.accepted == (name,)
    session.run("viewer_stop")


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


SCENARIO = """
name: lidar
world: {landmarks_per_room: 800}
measurement: {max_keypoints: 60}
drift: {yaw_walk_deg: 0.5, position_walk: 0.03}
lidar: {rate_hz: 0.5, columns: 600}
sessions: [{duration_s: 22.0, turns: 1.7}]
"""


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("lidar")
    (folder / "lidar.yaml").write_text(SCENARIO)
    with Session() as session:
        session.run("simulate", scenario=str(folder / "lidar.yaml"), map_folder=folder / "maps")
    return folder / "maps"


@pytest.fixture
def session(simulated: Path) -> Iterator[Session]:
    with Session() as session:
        session.run("load", map_folder=simulated / "session_1")
        yield session


def test_wrong_values_are_refused(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(FlagError, match="lidar_lc_voxel_size_m"):
        session.run("lc_lidar", lidar_lc_voxel_size_m=0.0)
    with pytest.raises(FlagError, match="exclude each other"):
        session.run("lc_lidar", lidar_lc_global=True, lidar_lc_from_closures=True)
    with pytest.raises(MapError, match="--lidar_lc_voxel_size_m"):
        session.run("lc_lidar", lidar_lc_voxel_size_m=5.0)
    registration.small_gicp.cache_clear()
    monkeypatch.setitem(sys.modules, "small_gicp", None)
    with pytest.raises(UserError, match=r"maplab-py\[lidar\]"):
        session.run("lc_lidar")
    registration.small_gicp.cache_clear()
    session.run("remove_resources", resource_type="21")
    with pytest.raises(UserError, match="import_point_clouds"):
        session.run("lc_lidar")


WALKS = [Walk(room=1), Walk(room=1, mission=1, start_s=60.0, drift=(0.2, -0.1, 0.05, 0.01))]


@pytest.fixture(scope="module")
def closed_rooms() -> Session:
    closed_rooms = Session()
    closed_rooms.maps.add("rooms", make_map(WALKS)[0])
    first, second = (to_hex(words) for words in closed_rooms.vi_map.missions.id)
    closed_rooms.run("rename_mission", "monday", map_mission=first)
    closed_rooms.run("rename_mission", "tuesday", map_mission=second)
    closed_rooms.run("lc", lc_min_inlier_count=1000)
    return closed_rooms


def test_wrong_arguments(closed_rooms: Session) -> None:
    with pytest.raises(UserError, match="no closure, mission or landmark begins with 'xyz'"):
        closed_rooms.run("why", "xyz")
    with pytest.raises(UserError, match="two different missions"):
        closed_rooms.run("why", "monday", "monday")
    with pytest.raises(UserError, match="no mission begins with 'sunday'"):
        closed_rooms.run("why", "monday", "sunday")
    with pytest.raises(UserError, match="no closure, mission or landmark"):
        closed_rooms.run("why", "")


def test_missions_and_closures_are_completed(closed_rooms: Session) -> None:
    candidates = complete("why ", closed_rooms)
    assert {"monday", "tuesday"} <= {candidate.text for candidate in candidates}
    assert any("too few inliers" in candidate.help for candidate in candidates)
    assert [c.text for c in complete("why monday tu", closed_rooms)] == ["tuesday"]
