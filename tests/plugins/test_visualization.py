"""The visualisation commands, through the session."""

import os
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from maplab_plugins.visualization.following import Following
from maplab_plugins.visualization.output import keep

from maplab_py.cancellation import lasting_effect
from maplab_py.console.session.session import Session
from maplab_py.console.terminal.foreground import SECONDS_OF_GRACE, run_in_foreground
from maplab_py.console.terminal.protocol import SilentTerminal
from maplab_py.errors import MapError, UserError
from maplab_py.geometry import se3
from maplab_py.interop.ply import PlyCloud, parse_ply, write_ply
from maplab_py.interop.trajectories import Trajectory, write_tum
from maplab_py.storage.resources.store import relative_path
from maplab_py.storage.resources.types import RESOURCE_TYPES
from maplab_py.viewer import picking, scene
from maplab_py.viewer.display.viewer import Viewer
from maplab_py.vimap import ResourceOwner, Resources, VIMap, random_ids, to_hex
from tests.vimap.builders import T_I_C, walk_map

TYPES = {kind.name: kind.number for kind in RESOURCE_TYPES}


@pytest.fixture
def session() -> Iterator[Session]:
    with Session() as session:
        session.set_flags(["--viewer_port=0"])
        session.maps.add("walk", walk_map())
        yield session


def _viewer(session: Session) -> Viewer:
    following = session.watchers.find("viewer", Following)
    assert following is not None
    return following.viewer


def _layers(report) -> dict[str, tuple[int, bool]]:
    return {line.layer: (line.in_map, line.visible) for line in report.layers}


def test_the_view_follows_every_command(session: Session) -> None:
    session.run("visualize")
    viewer = _viewer(session)
    session.run("reset_landmark_quality")
    assert viewer.wait(10.0)
    assert viewer.subject is not None
    assert viewer.subject.vi_map is session.vi_map
    session.run("undo")
    assert viewer.wait(10.0)
    assert viewer.subject.vi_map is session.vi_map
    other = walk_map(vertices=7, seed=4)
    session.maps.add("other", other)
    session.run("select_map", "walk")
    session.run("select_map", "other")
    assert viewer.wait(10.0)
    assert viewer.subject.title == "other"
    with pytest.raises(UserError):
        session.run("select_map", "nowhere")
    assert viewer.subject.vi_map is other


def test_the_viewer_ends_with_the_session_and_by_command(session: Session) -> None:
    with pytest.raises(UserError, match="no viewer is running"):
        session.run("viewer_stop")
    session.run("visualize")
    first = _viewer(session)
    assert session.marks["viewer"] == first.url
    assert "was kept for" in session.run("viewer_keep", duration_s=0.2).text
    session.run("viewer_stop")
    assert first.is_stopped
    assert session.marks["viewer"] == ""
    session.run("visualize")
    second = _viewer(session)
    assert second is not first
    session.watchers.close()
    assert second.is_stopped


def test_ctrl_c_while_the_viewer_is_kept_loses_nothing_however_often() -> None:
    kept = []

    def press() -> None:
        for _ in range(3):
            time.sleep(0.02)
            os.kill(os.getpid(), signal.SIGINT)

    def work() -> str:
        thread = threading.Thread(target=press)
        thread.start()
        viewer: Any = SimpleNamespace(url="", is_stopped=False)
        keep(SimpleNamespace(terminal=SilentTerminal()), viewer)  # type: ignore[arg-type]
        thread.join()
        time.sleep(2.0 * SECONDS_OF_GRACE)  # a large map is written
        with lasting_effect():
            kept.append("map")
        return "report"

    assert run_in_foreground("rovioli", work) == "report"
    assert kept == ["map"]


def test_a_pick_is_a_variable_of_the_prompt(session: Session) -> None:
    session.run("visualize")
    viewer, vi_map = _viewer(session), session.vi_map
    name = to_hex(vi_map.landmarks.id[4])
    assert name[:8] in session.run("viewer_go_to", name[:12]).text
    assert viewer.selection.picked is not None
    assert viewer.selection.picked.entity is scene.Entity.LANDMARK
    assert session.variables["pick"] == name
    viewer.select(picking.Pick(scene.Entity.VERTEX, 3, vi_map.T_G_I[3, 4:], 0.0))  # as a click does
    vertex = to_hex(vi_map.vertices.id[3])
    assert session.variables["pick"] == vertex
    with pytest.raises(UserError, match="no vertex, landmark"):
        session.run("viewer_go_to", "f" * 32)
    assert session.variables["pick"] == vertex


def test_difference_to_a_snapshot_and_to_the_state_before(session: Session) -> None:
    with pytest.raises(UserError, match="has not been changed"):
        session.run("visualize_difference")
    session.run("snapshot", "before")
    T = np.array(session.vi_map.vertices.T_M_I)
    T[:, 6] += 0.25
    moved = session.vi_map.replace(vertices=session.vi_map.vertices.replace(T_M_I=T))
    session.maps.update(session.maps.selected.with_value(moved, "moving"))
    for flags in ({}, {"with_snapshot": "before"}, {"side_by_side": True}, {"swipe": True}):
        report = session.run("visualize_difference", **flags)
        assert report.vertices == 12
        assert report.mean_m == pytest.approx(0.25)
        assert report.largest_m == pytest.approx(0.25)
        assert report.not_in_both == 0
        names = _layers(report.view)
        assert ("Displacement" in names) == (not {"side_by_side", "swipe"} & set(flags))
        assert ("Landmarks, left" in names) == ("swipe" in flags)
    with pytest.raises(UserError, match="not both"):
        session.run("visualize_difference", side_by_side=True, swipe=True)
    with pytest.raises(UserError, match=r"no snapshot 'after' .*before"):
        session.run("visualize_difference", with_snapshot="after")
    session.maps.add("stranger", walk_map(seed=9), select=False)
    with pytest.raises(UserError, match=r"no vertex in common; --side_by_side"):
        session.run("visualize_difference", with_map_key="stranger")
    report = session.run("visualize_difference", with_map_key="stranger", side_by_side=True)
    assert report.vertices == 0
    assert np.isnan(report.mean_m)
    assert _layers(report.view)["Names"] == (2, True)


def test_ground_truth_from_a_file(session: Session, tmp_path: Path) -> None:
    vi_map = session.vi_map
    truth = Trajectory(vi_map.vertices.timestamp_ns, vi_map.T_G_I)
    write_tum(truth, tmp_path / "truth.txt")
    layers = _layers(session.run("visualize", ground_truth=tmp_path / "truth.txt"))
    assert layers["Ground truth"][0] == 12
    assert layers["Position errors"] == (12, True)


def test_informative_segments_from_a_file(session: Session, tmp_path: Path) -> None:
    vi_map = session.vi_map
    times = vi_map.vertices.timestamp_ns
    mission = to_hex(vi_map.missions.id[0])[:6]
    path = tmp_path / "segments.csv"
    path.write_text(
        "mission, start_ns, end_ns, information\n"
        f"{mission}, {times[2]}, {times[5]}, 3.5\n{mission}, {times[7]}, {times[9]}, 8\n"
    )
    layers = _layers(session.run("visualize", informative_segments=path))
    assert layers["Informative segments"] == (2, True)
    path.write_text(f"mission,start_ns,end_ns,information\n{mission},1,2,3\n")
    with pytest.raises(MapError, match=r"segments.csv:2: the mission has no vertex"):
        session.run("visualize", informative_segments=path)
    path.write_text("a,b\n1,2\n")
    with pytest.raises(MapError, match="header with mission, start_ns, end_ns, information"):
        session.run("visualize", informative_segments=path)


def test_views_are_exported_and_files_are_not_overwritten(session: Session, tmp_path: Path) -> None:
    target = tmp_path / "view.html"
    report = session.run("export_view", file=target)  # it starts a viewer, and stops it
    assert "12 vertices" in target.read_text()
    assert session.watchers.find("viewer", Following) is None
    session.run("visualize")
    target.unlink()
    report = session.run("export_view", file=target)
    assert report.megabytes == pytest.approx(target.stat().st_size * 1e-6)
    text = target.read_text()
    assert "__VISER_EMBED_DATA__" in text
    assert "12 vertices" in text
    with pytest.raises(UserError, match=r"exists already: .*--overwrite"):
        session.run("export_view", file=target)
    session.run("export_view", file=target, overwrite=True)
    with pytest.raises(UserError, match=r"view\.html is not a folder"):
        session.run("save_view", file=target / "view.png")
    with pytest.raises(UserError, match="--width_px=1"):
        session.run("save_view", file=tmp_path / "view.png", width_px=1)


def test_without_a_browser_save_view_says_what_to_do(
    session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    session.run("visualize")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(UserError, match="no page is open and no Chromium is installed: open http"):
        session.run("save_view", file=tmp_path / "view.png")


@pytest.fixture
def with_resources(session: Session, tmp_path: Path) -> Session:
    """The map with a cloud of a frame, one of a mission, a depth map and images."""
    rng = np.random.default_rng(0)
    vi_map = session.vi_map
    kinds = ["point_cloud", "color_point_cloud", "raw_depth_maps", "raw_images", "raw_images"]
    owners = [ResourceOwner.FRAME, ResourceOwner.MISSION, *[ResourceOwner.FRAME] * 3]
    table = Resources.filled(
        5, id=random_ids(5, rng), type=[TYPES[k] for k in kinds], owner_kind=owners,
        owner=[3, 0, 4, 2, 5],
    )  # fmt: skip
    vi_map = vi_map.replace(resources=table)
    for row in range(5):
        path = tmp_path / "map" / "resources" / relative_path(vi_map, row)
        path.parent.mkdir(parents=True, exist_ok=True)
        _write_resource(path, row)
    session.maps.remove("walk")
    session.maps.add("walk", vi_map, folder=tmp_path / "map")
    return session


POINTS = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 2.0], [0.0, -1.0, 3.0]])


def _write_resource(path: Path, row: int) -> None:
    if row == 0:
        write_ply(PlyCloud(POINTS), path)
    elif row == 1:
        write_ply(PlyCloud(POINTS, np.full((3, 3), 7, dtype=np.uint8)), path)
    elif row == 2:
        depth = np.zeros((480, 640), dtype=np.uint16)
        depth[240, 320] = 2500
        cv2.imwrite(str(path), depth)
    else:
        cv2.imwrite(str(path), np.full((24, 32), 40 * row, dtype=np.uint8))


def _cloud(session: Session) -> np.ndarray:
    subject = _viewer(session).subject
    assert subject is not None
    return np.concatenate([cloud.p_G for cloud in subject.clouds])


def _T_G_C(vi_map: VIMap, vertex: int) -> np.ndarray:
    return se3.compose(vi_map.T_G_I[vertex], T_I_C)


def test_clouds_are_where_their_owners_are(with_resources: Session, tmp_path: Path) -> None:
    vi_map = with_resources.vi_map
    with_resources.run("visualize_xyz_pointclouds")
    np.testing.assert_allclose(
        _cloud(with_resources), se3.transform(_T_G_C(vi_map, 3), POINTS), atol=1e-6
    )
    out = tmp_path / "all.ply"
    report = with_resources.run(
        "visualize_xyzrgbn_pointclouds", vis_pointcloud_export_accumulated_pc_to_ply_path=str(out)
    )
    expected = se3.transform(vi_map.T_G_M[0], POINTS)
    np.testing.assert_allclose(_cloud(with_resources), expected, atol=1e-6)
    assert _layers(report)["color point cloud"] == (3, True)
    written = parse_ply(out.read_bytes(), out.name)
    np.testing.assert_allclose(written.p, expected, atol=1e-5)
    assert written.colours is not None
    assert (written.colours == 7).all()


def test_a_mesh_of_a_file_is_shown_in_the_global_frame(session: Session, tmp_path: Path) -> None:
    file = tmp_path / "mesh.ply"
    write_ply(PlyCloud(POINTS, faces=np.array([[0, 1, 2]], dtype=np.int32)), file)
    report = session.run("visualize_mesh", mesh_file=file)
    assert _layers(report)["mesh.ply"] == (1, True)
    np.testing.assert_array_equal(_cloud(session), POINTS)


def test_wrong_meshes_are_refused(session: Session, tmp_path: Path) -> None:
    file = tmp_path / "mesh.ply"
    with pytest.raises(UserError, match="create_tsdf_from_depth_resource makes one"):
        session.run("visualize_mesh")
    with pytest.raises(UserError, match="cannot be read"):
        session.run("visualize_mesh", mesh_file=file)
    write_ply(PlyCloud(POINTS), file)
    with pytest.raises(UserError, match="no triangles"):
        session.run("visualize_mesh", mesh_file=file)
    write_ply(PlyCloud(POINTS, faces=np.array([[0, 1, 7]], dtype=np.int32)), file)
    with pytest.raises(MapError, match="a vertex that is not there"):
        session.run("visualize_mesh", mesh_file=file)


def test_depth_maps_become_points(with_resources: Session) -> None:
    vi_map = with_resources.vi_map
    with_resources.run("visualize_raw_depth_map_pointclouds")
    # the principal point is at (320, 240): the ray is the optical axis
    expected = se3.transform(_T_G_C(vi_map, 4), np.array([[0.0, 0.0, 2.5]]))
    np.testing.assert_allclose(_cloud(with_resources), expected, atol=1e-6)


def test_resources_that_are_missing_are_named(with_resources: Session, session: Session) -> None:
    with pytest.raises(UserError, match="no resources of type 'disparity_maps'"):
        with_resources.run("visualize_disparity_maps")
    with pytest.raises(UserError, match="no resources of type 'point_cloud_w_intensity'"):
        with_resources.run("visualize_xyzi_pointclouds")
    with_resources.maps.add("unsaved", walk_map(seed=3))
    with pytest.raises(UserError, match="no resources of type 'point_cloud'"):
        with_resources.run("visualize_xyz_pointclouds")
