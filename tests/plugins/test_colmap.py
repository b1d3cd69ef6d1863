"""COLMAP models and files for dense reconstruction, out and in through the session."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from maplab_py.algorithms.evaluation.reports import MapComparisonReport
from maplab_py.console.session.session import Session
from maplab_py.errors import UserError
from maplab_py.interop.colmap.options import ColmapImportReport
from maplab_py.vimap import ids, queries
from tests.algorithms.loop_closure.rooms import Walk, make_map
from tests.interop.test_mvs import read_by_colmap
from tests.support.scene import Scene
from tests.support.stereo_room import StereoRoom, quarter_size


@pytest.fixture
def session() -> Session:
    session = Session()
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
    session = Session()
    session.maps.add("two", Scene(missions=2, vertices=5, landmarks=60).make())
    name = ids.to_hex(session.vi_map.missions.id[0])
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


def test_maps_that_are_not_there(session: Session) -> None:
    with pytest.raises(UserError, match="neither a map in memory \\(scene\\) nor the folder"):
        session.run("compare_maps", "none")


def test_arbitrary_scale_is_refused_by_optvi_alone(session: Session, tmp_path: Path) -> None:
    session.run("export_colmap", colmap_folder=tmp_path, quality="all")
    (tmp_path / "maplab.npz").unlink()
    session.run("import_colmap", colmap_folder=tmp_path, map_key="model")
    assert not queries.is_metric(session.vi_map, 0)
    with pytest.raises(UserError, match="scale and gravity are arbitrary"):
        session.run("optvi")
    session.run("optv", ba_num_iterations=2)
    assert np.isfinite(session.vi_map.T_G_I).all()


@pytest.mark.slow
def test_the_commands_run_without_imu(tmp_path: Path) -> None:
    session = Session()
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


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> StereoRoom:
    return StereoRoom.simulated(tmp_path_factory.mktemp("stereo"), quarter_size(2.0))


@pytest.fixture
def room_session(room: StereoRoom) -> Iterator[Session]:
    with Session() as room_session:
        room_session.run("load", map_folder=room.map_folder)
        yield room_session


def test_colmap_reads_the_workspace(
    room_session: Session, room: StereoRoom, tmp_path: Path
) -> None:
    pytest.importorskip("pycolmap")
    room_session.run("import_images", dataset_folder=room.recording)
    workspace = tmp_path / "dense"
    report: Any = room_session.run(
        "export_colmap_mvs",
        colmap_workspace=workspace,
        colmap_max_image_size=300,
    )
    frames = len(room_session.vi_map.frames)
    assert report.images == frames
    assert report.points > 50
    assert report.median_error_px < 3.0
    read = read_by_colmap(workspace / "sparse")
    _, width, height, *_ = read["cameras"]["1"]
    assert 250 < max(width, height) <= 300
    names = sorted(path.name for path in (workspace / "images").iterdir())
    assert names == sorted(read["images"])
    image = cv2.imread(str(workspace / "images" / names[0]))
    assert image.shape[:2] == (height, width)
    settings = (workspace / "stereo" / "patch-match.cfg").read_text().splitlines()
    assert sorted(settings[::2]) == names
    assert set(settings[1::2]) == {"__auto__, 20"}
    assert (workspace / "stereo" / "depth_maps").is_dir()
    with pytest.raises(UserError, match="--overwrite"):
        room_session.run("export_colmap_mvs", colmap_workspace=workspace)


def test_wrong_values_are_refused(room_session: Session, room: StereoRoom, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="import_images"):
        room_session.run("export_colmap_mvs", colmap_workspace=tmp_path / "none")
    assert not (tmp_path / "none").exists()
    with pytest.raises(UserError, match="--pmvs_undistortion_alpha=2"):
        room_session.run(
            "export_for_pmvs",
            pmvs_reconstruction_folder=tmp_path / "none",
            pmvs_undistortion_alpha=2.0,
        )
    with pytest.raises(UserError, match="--colmap_max_image_size"):
        room_session.run(
            "export_colmap_mvs", colmap_workspace=tmp_path / "none", colmap_max_image_size=-1
        )
