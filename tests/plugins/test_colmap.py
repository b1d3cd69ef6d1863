"""COLMAP models through the session: out, in, and the commands on a map without IMU."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from maplab_py.algorithms.evaluation.reports import MapComparisonReport
from maplab_py.console.commands.registry import load_registry
from maplab_py.console.session.session import Session
from maplab_py.errors import UserError
from maplab_py.interop.colmap.options import ColmapImportReport
from maplab_py.vimap.ids import to_hex
from maplab_py.vimap.scale_marks import is_metric
from tests.algorithms.loop_closure.rooms import Walk, make_map
from tests.support.scene import Scene


@pytest.fixture
def session() -> Session:
    session = Session(load_registry())
    session.maps.add("scene", Scene(vertices=8, landmarks=60).make())
    return session


def test_out_in_and_compared(session: Session, tmp_path: Path) -> None:
    folder = tmp_path / "model"
    session.run("export_colmap", colmap_folder=folder, quality="all")
    report = session.run("import_colmap", colmap_folder=folder)
    assert isinstance(report, ColmapImportReport)
    assert (report.map_key, report.vertices) == ("model", 8)
    compared = session.run("compare_maps", "scene")
    assert isinstance(compared, MapComparisonReport)
    assert compared.position_m.largest < 1e-9
    assert not compared.is_identical  # the IMU stays behind
    session.run("check_map_consistency")
    session.run("save", map_folder=tmp_path / "map")
    again = session.run("compare_maps", str(tmp_path / "map"))
    assert isinstance(again, MapComparisonReport)
    assert all(row.only_in_first == row.only_in_second == 0 for row in again.rows)
    assert (again.position_m.largest, again.sensors_differing) == (0.0, ())


def test_missions_are_chosen(tmp_path: Path) -> None:
    session = Session(load_registry())
    session.maps.add("two", Scene(missions=2, vertices=5, landmarks=60).make())
    name = to_hex(session.vi_map.missions.id[0])
    session.run("export_colmap", colmap_folder=tmp_path, missions=name)
    session.run("import_colmap", colmap_folder=tmp_path, map_key="part")
    assert len(session.vi_map.missions) == 1


def test_a_failed_import_changes_nothing(session: Session, tmp_path: Path) -> None:
    folder = tmp_path / "model"
    session.run("export_colmap", colmap_folder=folder)
    before = session.maps.keys
    (folder / "points3D.bin").write_bytes(b"")
    for flags, reason in (
        ({"colmap_folder": folder}, "ends too early"),
        ({"colmap_folder": tmp_path / "none"}, "no such folder"),
        ({}, "give --colmap_folder"),
        ({"colmap_folder": folder, "map_key": "scene"}, "in use"),
    ):
        with pytest.raises(Exception, match=reason):
            session.run("import_colmap", **flags)
    assert session.maps.keys == before
    assert session.maps.selected_key == "scene"


def test_a_dry_run_writes_nothing(session: Session, tmp_path: Path) -> None:
    session.run("export_colmap", colmap_folder=tmp_path / "model", dry_run=True)
    assert not (tmp_path / "model").exists()


def test_maps_that_are_not_there(session: Session) -> None:
    with pytest.raises(UserError, match="neither a map in memory \\(scene\\) nor the folder"):
        session.run("compare_maps", "none")


def test_arbitrary_scale_is_refused_by_optvi_alone(session: Session, tmp_path: Path) -> None:
    session.run("export_colmap", colmap_folder=tmp_path, quality="all")
    (tmp_path / "maplab.npz").unlink()
    session.run("import_colmap", colmap_folder=tmp_path, map_key="model")
    assert not is_metric(session.vi_map, 0)
    with pytest.raises(UserError, match="scale and gravity are arbitrary"):
        session.run("optvi")
    session.run("optv", ba_num_iterations=2)
    assert np.isfinite(session.vi_map.T_G_I).all()


@pytest.mark.slow
def test_the_commands_run_without_imu(tmp_path: Path) -> None:
    session = Session(load_registry())
    walks = [Walk(room=1), Walk(room=1, start_s=60.0, drift=(0.2, -0.1, 0.05, 0.01))]
    session.maps.add("rooms", make_map(walks)[0])
    folder = tmp_path / "model"
    session.run("export_colmap", colmap_folder=folder, quality="all", colmap_database=True)
    session.run("import_colmap", colmap_folder=folder, database=folder / "database.db")
    assert not len(session.vi_map.imu_edges)
    for command in ("elq", "kfh", "lc", "itl"):
        session.run(command)
    summary = tmp_path / "summary"
    session.run("generate_summary_map_and_save_to_disk", summary_map_save_path=summary)
    session.run("localize", localization_map=str(summary))
