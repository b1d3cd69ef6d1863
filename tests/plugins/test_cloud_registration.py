"""Loop closures between clouds in the console, from a simulated lidar to a relaxed and saved map."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from maplab_py.algorithms.cloud_registration import registration
from maplab_py.console.commands.registry import load_registry
from maplab_py.console.session.session import Session
from maplab_py.errors import FlagError, MapError, UserError

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
    with Session(load_registry()) as session:
        session.run("simulate", scenario=str(folder / "lidar.yaml"), map_folder=folder / "maps")
    return folder / "maps"


@pytest.fixture
def session(simulated: Path) -> Iterator[Session]:
    with Session(load_registry()) as session:
        session.run("load", map_folder=simulated / "session_1")
        yield session


def test_clouds_straighten_a_map(session: Session, simulated: Path, tmp_path: Path) -> None:
    before: Any = session.run("evaluate_map", truth=simulated / "truth.npz")
    assert session.run("check_map_consistency").failure == ""
    report: Any = session.run("lc_lidar")
    assert report.clouds == 11
    assert report.edges_added == report.accepted > 3
    listed: Any = session.run("lc_report")
    assert listed.accepted == report.accepted
    closure = listed.closures[0].id
    assert session.run("why", subject=closure).failure == ""
    session.run("optvi", ba_include_loop_closure_edges=True, ba_num_iterations=2)
    session.run("undo")
    session.run("relax")
    after: Any = session.run("evaluate_map", truth=simulated / "truth.npz")
    assert after.ate_m < 0.8 * before.ate_m
    assert after.false_loop_edges == 0
    session.run("save", map_folder=tmp_path / "map")
    session.run("load", map_folder=tmp_path / "map")
    assert session.run("lc_report").as_dict()["accepted"] >= 1
    removed: Any = session.run("remove_loopclosure", closures=closure)
    assert removed.edges_removed == 1


def test_undo_takes_the_edges_away(session: Session) -> None:
    before = session.vi_map
    session.run("register_point_clouds", lidar_lc_every_nth=2)
    session.run("undo")
    assert session.vi_map is before


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
