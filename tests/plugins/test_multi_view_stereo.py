"""Export of a simulated stereo session for COLMAP and PMVS in the console."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from maplab_py.console.commands.registry import load_registry
from maplab_py.console.session.session import Session
from maplab_py.errors import UserError
from tests.interop.test_mvs import read_by_colmap
from tests.support.stereo_room import StereoRoom, quarter_size


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> StereoRoom:
    return StereoRoom.simulated(tmp_path_factory.mktemp("stereo"), quarter_size(2.0))


@pytest.fixture
def session(room: StereoRoom) -> Iterator[Session]:
    with Session(load_registry()) as session:
        session.run("load", map_folder=room.map_folder)
        yield session


def test_colmap_reads_the_workspace(session: Session, room: StereoRoom, tmp_path: Path) -> None:
    pytest.importorskip("pycolmap")
    session.run("import_images", dataset_folder=room.recording)
    workspace = tmp_path / "dense"
    report: Any = session.run(
        "export_colmap_mvs",
        colmap_workspace=workspace,
        colmap_max_image_size=300,
    )
    frames = len(session.vi_map.frames)
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
        session.run("export_colmap_mvs", colmap_workspace=workspace)


def test_undistorted_images_are_straight_and_poses_are_those_of_the_map(
    session: Session, room: StereoRoom, tmp_path: Path
) -> None:
    """Landmarks projected by the matrices of PMVS lie where their keypoints are."""
    session.run("import_images", dataset_folder=room.recording)
    folder = tmp_path / "pmvs"
    report: Any = session.run(
        "export_for_pmvs",
        pmvs_reconstruction_folder=folder,
        pmvs_undistortion_alpha=1.0,
        pmvs_export_data_for_nth_vertex=2,
        cmvs_use_only_good_landmarks=False,
    )
    assert report.images == 2 * -(-len(session.vi_map.vertices) // 2)
    images = sorted((folder / "visualize").iterdir())
    assert len(images) == report.images == len(list((folder / "txt").iterdir()))
    assert f"timages -1 0 {report.images}" in (folder / "option-all").read_text()
    lines = (folder / "bundle.rd.out").read_text().splitlines()
    cameras, points = map(int, lines[1].split())
    assert (cameras, points) == (report.images, report.points)
    first = 2 + 5 * cameras
    error = []
    height, width = cv2.imread(str(images[0])).shape[:2]
    for point in range(min(points, 30)):
        p_G = np.array(lines[first + 3 * point].split(), dtype=float)
        track = np.array(lines[first + 3 * point + 2].split()[1:], dtype=float).reshape(-1, 4)
        for view, _, x, y in track:
            P = np.loadtxt(folder / "txt" / f"{int(view):08d}.txt", skiprows=1)
            p = P @ np.append(p_G, 1.0)
            centre = P[:, :3] @ P[2, :3]  # K R r3 = K e3: the principal point
            error.append(p[:2] / p[2] - centre[:2] - np.array([x, -y]))
            assert 0.0 <= p[0] / p[2] + 3.0 <= width + 5.0
            assert 0.0 <= p[1] / p[2] + 3.0 <= height + 5.0
    assert np.median(np.linalg.norm(error, axis=1)) < 2.0


def test_wrong_values_are_refused(session: Session, room: StereoRoom, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="import_images"):
        session.run("export_colmap_mvs", colmap_workspace=tmp_path / "none")
    assert not (tmp_path / "none").exists()
    with pytest.raises(UserError, match="--pmvs_undistortion_alpha=2"):
        session.run(
            "export_for_pmvs",
            pmvs_reconstruction_folder=tmp_path / "none",
            pmvs_undistortion_alpha=2.0,
        )
    with pytest.raises(UserError, match="--colmap_max_image_size"):
        session.run(
            "export_colmap_mvs", colmap_workspace=tmp_path / "none", colmap_max_image_size=-1
        )
