"""The commands that read and write files of other programs."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from maplab_py.algorithms.loop_closure.features import map_features
from maplab_py.algorithms.self_calibration.device import device_of
from maplab_py.console.session.session import Session
from maplab_py.errors import EstimationError, UserError
from maplab_py.interop.trajectories import read_trajectory
from maplab_py.sensors import Distortion
from maplab_py.vimap import ids, merge
from maplab_py.vision.projection import DescriptorProjection, save_projection
from tests.algorithms.self_calibration.scenes import scene_map
from tests.interop.recordings.written import make_content, write_folder
from tests.interop.small_map import RIG_ID, make_map
from tests.simulation.small import simulated


@pytest.fixture
def session(tmp_path: Path) -> Session:
    session = Session()
    folder = tmp_path / "map"
    folder.mkdir()
    session.maps.add("small", make_map(), folder=folder)
    return session


def test_projected_descriptors_are_those_of_loop_closure(tmp_path: Path) -> None:
    session = Session()
    session.maps.add("walk", merge.merge_maps(*simulated().maps)[0])
    vi_map = session.vi_map
    session.run("csv_export", csv_export_path=tmp_path / "csv", export_projected_descriptor=True)
    features, projection = map_features(vi_map, np.arange(2))
    mission = vi_map.vertices.mission[vi_map.keypoint_vertex]
    for row, name in enumerate(ids.to_hex_list(vi_map.missions.id)):
        text = (tmp_path / "csv" / name / "descriptors.csv").read_text()
        read = np.array([line.split(", ") for line in text.splitlines()], dtype=np.float32)
        of_mission = np.flatnonzero(mission == row)
        assert read.shape == (len(of_mission), 10)
        chosen = np.isin(features.keypoint, of_mission)
        projected = features.descriptors.projected[chosen]
        assert np.array_equal(read[features.keypoint[chosen] - of_mission[0]], projected)
    save_projection(DescriptorProjection(projection.matrix[:3]), tmp_path / "p.npz")
    session.run(
        "csv_export",
        csv_export_path=tmp_path / "three",
        export_projected_descriptor=True,
        lc_projection_matrix_filename=str(tmp_path / "p.npz"),
    )
    line = (tmp_path / "three" / name / "descriptors.csv").read_text().splitlines()[0]
    assert len(line.split(", ")) == 3


def test_wrong_combinations_with_projected_descriptors(tmp_path: Path, session: Session) -> None:
    for flags, needed in (
        ({"lc_projection_matrix_filename": "p.npz"}, "--export_projected_descriptor"),
        (
            {"export_projected_descriptor": True, "csv_export_descriptors": False},
            "--csv_export_descriptors",
        ),
    ):
        with pytest.raises(UserError, match=f"needs {needed}"):
            session.run("csv_export", csv_export_path=tmp_path / "csv", **flags)
    with pytest.raises(EstimationError, match="do not match each other"):
        session.run(
            "csv_export", csv_export_path=tmp_path / "csv", export_projected_descriptor=True
        )
    assert not (tmp_path / "csv").exists()


def test_trajectory_goes_to_the_map_folder_by_default(session: Session) -> None:
    folder = session.maps.selected.folder
    report = session.run("ettc")
    assert report.files == (folder / "vertex_poses_velocities_biases.csv",)
    assert report.rows == 12
    report = session.run("ettc", csv_export_format="rpg")
    read = read_trajectory(folder / "stamped_traj_estimate.txt")
    assert np.max(np.abs(read.T_R_B - session.vi_map.T_G_I)) < 1e-15
    with pytest.raises(UserError, match="exists already"):
        session.run("ettc")
    assert session.run("ettc", csv_export_format="tum", overwrite=True).files == report.files


def test_trajectory_options(tmp_path: Path, session: Session) -> None:
    report = session.run(
        "export_trajectory_to_csv",
        pose_export_file=tmp_path / "a.csv",
        pose_export_reference_sensor_id=RIG_ID,
        interpolate_to_imu_timestamps=True,
    )
    assert report.rows == 502
    session.maps.add("homeless", make_map())
    with pytest.raises(UserError, match="give --pose_export_file"):
        session.run("ettc")
    with pytest.raises(UserError, match="csv_export_format"):
        session.run("ettc", csv_export_format="kitti")


@pytest.mark.parametrize(
    "command", ["csv_export", "csv_export_vertices_only", "encc", "export_mission_info"]
)
def test_a_place_to_write_to_is_needed(session: Session, command: str) -> None:
    with pytest.raises(UserError, match="needs --"):
        session.run(command)


def test_recording_info(tmp_path: Path) -> None:
    folder = write_folder(make_content(), tmp_path / "room")
    with Session() as session:  # needs no map
        report = session.run("recording_info", recording=folder, check_images=True)
        assert (report.frame_sets, report.checked_images, report.kind) == (8, 16, "EuRoC folder")
        assert report.as_dict()["imu"]["samples"] == len(make_content().imu_ns)
        part = session.run("recording_info", recording=folder, vio_rosbag_start_s=0.1)
        assert part.frame_sets == 6
        tight = session.run("recording_info", recording=folder, vio_nframe_sync_tolerance_ns=10)
        assert [camera.unmatched_images for camera in tight.cameras] == [8, 8]
        assert tight.notes == (
            "8 of 8 images of camera 1 have no partner in camera 0; the nearest is 0.001 ms away at the "
            "median: check the trigger, or raise --vio_nframe_sync_tolerance_ns",
        )
        with pytest.raises(UserError, match="--imu_topic and --camera_topics apply to bags only"):
            session.run("recording_info", recording=folder, imu_topic="/imu0")


def test_a_calibration_is_applied_and_taken_back(tmp_path: Path) -> None:
    vi_map = scene_map(distortion=Distortion.RADTAN)
    device = device_of(vi_map)
    with Session() as session:
        session.maps.add("walk", vi_map)
        folder = tmp_path / "kalibr"
        session.run("export_calibration", folder=folder, format="kalibr")
        chain = folder / "camchain-imucam.yaml"
        before = vi_map.sensors.camera_rig(device.rig).cameras[0].intrinsics
        text = chain.read_text().replace(f"{before[0]}", f"{before[0] + 7.0}")
        chain.write_text(text)
        flags = {"calibration_file": chain, "imu_calibration_file": folder / "imu.yaml"}
        report: Any = session.run("import_calibration", **flags, apply=True)
        changed = {row.parameter: row for row in report.changes if abs(row.difference) > 1e-9}
        assert list(changed) == ["camera focal length u"]
        after = session.vi_map.sensors.camera_rig(device.rig).cameras[0].intrinsics
        np.testing.assert_allclose(after - before, [7.0, 0.0, 0.0, 0.0], atol=1e-9)
        session.run("undo")
        assert session.vi_map is vi_map or session.vi_map.sensors is vi_map.sensors
        chain.write_text(text[: len(text) // 2])
        with pytest.raises(UserError, match="camchain-imucam"):
            session.run("import_calibration", **flags, apply=True)
        assert session.vi_map.sensors is vi_map.sensors
