"""From stereo images to a mesh in the console, with undo, a new process, and bad input."""

import errno
import gc
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from maplab_py.atomic.files import PendingFile
from maplab_py.console.session.session import Session
from maplab_py.errors import FlagError, UserError
from maplab_py.interop.ply import parse_ply
from maplab_py.storage.native import save_map
from tests.e2e.support import run_program
from tests.support.stereo_room import StereoRoom, quarter_size


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> StereoRoom:
    room = StereoRoom.simulated(tmp_path_factory.mktemp("stereo"), quarter_size(5.0))
    true_map = room.true_map
    shutil.rmtree(room.map_folder)
    save_map(true_map, room.map_folder)
    return room


@pytest.fixture
def session(room: StereoRoom) -> Iterator[Session]:
    with Session() as session:
        session.run("load", map_folder=room.map_folder)
        session.run("import_images", dataset_folder=room.recording)
        yield session


def test_stereo_images_become_a_mesh(session: Session, room: StereoRoom, tmp_path: Path) -> None:
    stereo: Any = session.run(
        "stereo_dense_reconstruction", dense_stereo_sgbm_speckle_window_size=125
    )
    assert stereo.resources == len(session.vi_map.vertices)
    mesh = tmp_path / "room.ply"
    session.run("tsdf", dense_result_mesh_output_file=mesh)
    cloud = parse_ply(mesh.read_bytes(), "room.ply")
    assert cloud.faces is not None
    off_m = room.distances_to_surfaces(cloud.p)
    assert len(cloud.p) > 2000
    # voxels of 10 cm, images of a quarter of the pixels
    assert off_m.mean() < 0.05
    assert np.mean(off_m > 0.1) < 0.1
    view: Any = session.run("visualize_mesh", viewer_port=0)
    assert ("Mesh", len(cloud.faces)) in [(line.layer, line.in_map) for line in view.layers]
    painted = tmp_path / "painted.ply"
    session.run(
        "export_tsdf", dense_result_mesh_output_file=painted, dense_result_mesh_colours=True
    )
    colours = parse_ply(painted.read_bytes(), "painted.ply").colours
    assert colours is not None
    assert len(colours) == len(cloud.p)
    seen = (colours != 128).any(axis=1)
    assert seen.mean() > 0.8
    assert colours[seen].std() > 10.0  # textures, not one grey
    folder = tmp_path / "map"
    session.run("save", map_folder=folder)
    assert session.run("check_map_consistency").failure == ""
    again = tmp_path / "again.ply"
    line = f"load '{folder}'; create_mesh_from_tsdf_grid --dense_result_mesh_output_file='{again}'"
    result = run_program(tmp_path, "-c", line)
    assert result.returncode == 0, result.stderr
    assert again.read_bytes() == mesh.read_bytes()


def test_undo_and_failure_leave_nothing_behind(
    session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    before = session.vi_map
    part = {"dense_stereo_debug_reconstruction_end_fraction_of_trajectory": 0.2}
    session.run("sdr", **part)
    mesh = tmp_path / "mesh.ply"
    with pytest.raises(UserError, match="--dense_max_memory_gb"):
        session.run("tsdf", dense_max_memory_gb=1e-5, dense_result_mesh_output_file=mesh)
    assert not mesh.exists()
    session.run("tsdf")
    for _ in range(2):
        session.run("undo")
    assert session.vi_map is before
    session.run("delete_map", yes=True)
    gc.collect()
    assert [path for path in temporary.rglob("*") if path.is_file()] == []


def test_distances_for_a_planner(session: Session, room: StereoRoom, tmp_path: Path) -> None:
    session.run("import_depth_maps", depth_folder=room.depth())
    file = tmp_path / "voxels.ply"
    report: Any = session.run("esdf", dense_esdf_export_map_for_panning_path=file)
    (field,) = report.fields
    assert field.depth_maps == len(session.vi_map.vertices)
    assert 0.5 < field.free_share < 0.9
    voxels = parse_ply(file.read_bytes(), "voxels.ply")
    assert voxels.intensity is not None
    assert len(voxels.p) == field.known_voxels > 20_000
    truth = room.distances_to_surfaces(voxels.p)
    free = voxels.intensity > 0.0
    # surfaces that no camera has seen are missing, so that distances may be too large, but not too small
    assert np.mean(voxels.intensity[free] < np.minimum(truth[free], 2.0) - 0.1) < 0.005
    assert np.median(np.abs(voxels.intensity[free] - np.minimum(truth[free], 2.0))) < 0.01
    view: Any = session.run("visualize_esdf", viewer_port=0)
    assert "Distance field" in [line.layer for line in view.layers]
    with pytest.raises(UserError, match=r"--dense_esdf_slice_height_m=90.00.*voxels from"):
        session.run("visualize_esdf", dense_esdf_slice_height_m=90.0)
    with pytest.raises(UserError, match="already: give --overwrite"):
        session.run("esdf")
    folder = tmp_path / "map"
    session.run("save", map_folder=folder)
    again: Any = session.run("esdf", overwrite=True)
    assert again.fields == report.fields
    reloaded = tmp_path / "reloaded.ply"
    program = (
        "import sys; from pathlib import Path\n"
        "from maplab_py.algorithms.dense.field import export_voxels\n"
        "from maplab_py.storage.native import load_map\n"
        "folder, file = map(Path, sys.argv[1:]); export_voxels(load_map(folder)[0], folder, file)"
    )
    subprocess.run([sys.executable, "-c", program, str(folder), str(reloaded)], check=True)
    assert reloaded.read_bytes() == file.read_bytes()


def test_distance_fields_are_refused_before_any_work(session: Session, tmp_path: Path) -> None:
    before = session.vi_map
    with pytest.raises(UserError, match="stereo_dense_reconstruction makes depth maps"):
        session.run("esdf")
    with pytest.raises(UserError, match="create_esdf_from_depth_resource makes one"):
        session.run("visualize_esdf")
    with pytest.raises(UserError, match=r"a file named \.ply"):
        session.run("esdf", dense_esdf_export_map_for_panning_path=tmp_path / "voxels.txt")
    (tmp_path / "voxels.ply").write_text("mine")
    with pytest.raises(UserError, match="--overwrite"):
        session.run("esdf", dense_esdf_export_map_for_panning_path=tmp_path / "voxels.ply")
    with pytest.raises(FlagError, match="dense_esdf_max_distance_m"):
        session.run("esdf", dense_esdf_max_distance_m=0.0)
    assert session.vi_map is before


def test_an_update_keeps_the_voxels(session: Session) -> None:
    part = {"dense_stereo_debug_reconstruction_end_fraction_of_trajectory": 0.1}
    session.run("sdr", **part)
    report: Any = session.run("tsdf", dense_tsdf_voxel_size_m=0.2)
    assert report.grids[0].voxel_size_m == 0.2
    before = session.vi_map
    for flags, message in (
        (
            {"dense_tsdf_voxel_size_m": 0.05},
            "voxel_size_m=0.2, and --update keeps that: leave out 0.05",
        ),
        ({"dense_tsdf_weight_depth_power": 2}, "weight_depth_power=4"),
        ({"dense_depth_resource_input_type": "17"}, "is of raw_depth_maps"),
    ):
        with pytest.raises(UserError, match=message) as error:
            session.run("tsdf", update=True, **flags)
        assert "\n" not in str(error.value)
        assert session.vi_map is before
    for kept in ({}, {"dense_tsdf_voxel_size_m": 0.2}):
        assert session.run("tsdf", update=True, **kept).as_dict()["grids"][0]["added"] == 0


def test_a_full_disk_leaves_the_map_as_it_was(
    session: Session, room: StereoRoom, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    session.run("import_depth_maps", depth_folder=room.depth())
    before, files = session.vi_map, sorted(temporary.rglob("*.*"))

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(PendingFile, "complete", full)
        for line in ("tsdf", "esdf", "convert_all_depth_maps_to_point_clouds"):
            with pytest.raises(UserError, match="No space left on device") as error:
                session.run(line)
            assert "\n" not in str(error.value)
            assert session.vi_map is before
    gc.collect()
    assert sorted(temporary.rglob("*.*")) == files


def test_wrong_values_are_refused(session: Session, tmp_path: Path) -> None:
    with pytest.raises(FlagError, match="downscaling_factor"):
        session.run("sdr", dense_stereo_downscaling_factor=0.0)
    with pytest.raises(FlagError, match="dense_tsdf_voxel_size_m"):
        session.run("tsdf", dense_tsdf_voxel_size_m=-1.0)
    with pytest.raises(UserError, match="no such resource type"):
        session.run("tsdf", dense_depth_resource_input_type="stereo")
    with pytest.raises(UserError, match=r"\.ply, \.obj, \.stl, \.glb"):
        session.run("tsdf", dense_result_mesh_output_file=tmp_path / "mesh.txt")
    (tmp_path / "mesh.ply").write_text("mine")
    with pytest.raises(UserError, match="--overwrite"):
        session.run("export_tsdf", dense_result_mesh_output_file=tmp_path / "mesh.ply")
