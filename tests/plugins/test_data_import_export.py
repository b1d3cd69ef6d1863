"""The commands that read and write files of other programs."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from maplab_plugins import data_import_export

from maplab_py.algorithms.loop_closure.features import map_features
from maplab_py.algorithms.self_calibration.device import device_of
from maplab_py.console.session.session import Session
from maplab_py.errors import EstimationError, UserError
from maplab_py.interop.trajectories import read_trajectory
from maplab_py.sensors import Distortion, sensors_yaml, yaml_text
from maplab_py.vimap import VIMap, ids, merge
from maplab_py.vision.projection import DescriptorProjection, save_projection
from tests.algorithms.self_calibration.scenes import scene_map
from tests.interop.recordings.written import make_content, write_folder
from tests.interop.small_map import RIG_ID, make_map
from tests.interop.test_calibration_import import CAMCHAIN, IMU, basalt, written
from tests.simulation.small import simulated


@pytest.fixture
def session(tmp_path: Path) -> Session:
    session = Session()
    folder = tmp_path / "map"
    folder.mkdir()
    session.maps.add("small", make_map(), folder=folder)
    return session


def test_csv_export(tmp_path: Path, session: Session) -> None:
    path = tmp_path / "csv"
    report = session.run("csv_export", csv_export_path=path, csv_export_descriptors=False)
    assert (report.missions, report.files) == (2, 10)
    mission = ids.to_hex(session.vi_map.missions.id[1])
    assert not (path / mission / "descriptors.csv").exists()
    with pytest.raises(UserError, match="exists already: give --overwrite"):
        session.run("csv_export", csv_export_path=path)
    session.run("csv_export", csv_export_path=path, overwrite=True)
    assert (path / mission / "descriptors.csv").exists()


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


def test_csv_export_vertices_only(tmp_path: Path, session: Session) -> None:
    path = tmp_path / "csv"
    mission = ids.to_hex(session.vi_map.missions.id[0])
    report = session.run("csv_export_vertices_only", csv_export_path=path, map_mission=mission[:6])
    assert report.vertices == 6
    assert [file.name for file in path.rglob("*.csv")] == ["vertices.csv"]


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


def test_ncamera_calibration_reads_back(tmp_path: Path, session: Session) -> None:
    report = session.run("encc", ncamera_calibration_export_folder=tmp_path / "calibration")
    rig = sensors_yaml.read_sensors(report.files[0]).camera_rig(RIG_ID)
    expected = session.vi_map.sensors.camera_rig(RIG_ID)
    assert np.array_equal(rig.cameras[0].intrinsics, expected.cameras[0].intrinsics)
    assert np.allclose(rig.T_B_C, expected.T_B_C, atol=1e-15)
    with pytest.raises(UserError, match="exists already"):
        session.run("encc", ncamera_calibration_export_folder=tmp_path / "calibration")
    session.maps.add("empty", VIMap())
    with pytest.raises(UserError, match="no camera rig"):
        session.run("encc", ncamera_calibration_export_folder=tmp_path / "other")


def test_mission_info_lists_every_map(tmp_path: Path, session: Session) -> None:
    session.maps.add("other", VIMap(), select=False)
    path = tmp_path / "info.yaml"
    report = session.run("export_mission_info", mission_info_export_path=path)
    missions = ids.to_hex_list(session.vi_map.missions.id)
    assert yaml_text.parse_yaml(path.read_text(), "info") == {"small": missions, "other": []}
    assert report.rows == 2


@pytest.mark.parametrize(
    "command", ["csv_export", "csv_export_vertices_only", "encc", "export_mission_info"]
)
def test_a_place_to_write_to_is_needed(session: Session, command: str) -> None:
    with pytest.raises(UserError, match="needs --"):
        session.run(command)


def test_help_is_complete() -> None:
    for name in ("csv_export", "csv_export_vertices_only", "export_trajectory_to_csv"):
        described = getattr(data_import_export, name).maplab_command
        assert all(flag.help for flag in described.flags.values())
        assert "overwrite" in described.flags


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


def test_a_calibration_is_looked_at_and_written(tmp_path: Path) -> None:
    with Session() as session:
        report: Any = session.run("import_calibration", calibration_file=basalt(tmp_path))
        assert (report.format, len(report.cameras), report.has_imu) == ("Basalt", 2, True)
        assert "--apply" in report.advice
        chain, imu = written(tmp_path, "chain.yaml", CAMCHAIN), written(tmp_path, "imu.yaml", IMU)
        sensors = tmp_path / "sensors.yaml"
        flags = {"calibration_file": chain, "imu_calibration_file": imu, "sensors_file": sensors}
        report = session.run("import_calibration", **flags)
        assert report.cameras[0].time_shift_s == pytest.approx(0.004)
        assert len(sensors_yaml.read_sensors(sensors).sensors) == 2
        with pytest.raises(UserError, match=r"sensors\.yaml"):
            session.run("import_calibration", **flags)
        session.run("import_calibration", **flags, overwrite=True)


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
