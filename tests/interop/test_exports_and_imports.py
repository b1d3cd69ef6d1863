"""Every export is read by every import of its kind; values are equal to the precision of the format."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from maplab_py.algorithms.evaluation.localization_evaluation import read_localized
from maplab_py.algorithms.self_calibration.device import device_of
from maplab_py.console.session.session import Session
from maplab_py.frontend.localization.record import _HEADER as LOCALIZED_HEADER
from maplab_py.geometry import se3, so3
from maplab_py.interop import vertex_states
from maplab_py.interop.calibration_export import exported
from maplab_py.interop.csv_dataset import CsvExportOptions, export_csv_dataset
from maplab_py.interop.imu_csv import read_imu_csv
from maplab_py.interop.recordings import reader_choice
from maplab_py.interop.recordings.options import SourceOptions
from maplab_py.interop.trajectories import Trajectory, read_trajectory, write_euroc, write_tum
from maplab_py.sensors import Distortion
from maplab_py.storage.native import save_map
from maplab_py.vimap import VIMap
from tests.algorithms.self_calibration.scenes import scene_map
from tests.algorithms.test_external_trajectories import flat_map
from tests.interop.small_map import VERTICES

Write = Callable[[VIMap, Path], Path]


def states(vi_map: VIMap) -> vertex_states.VertexStates:
    return vertex_states.vertex_states(vi_map, missions=np.array([0]))


def as_asl(vi_map: VIMap, folder: Path) -> Path:
    vertex_states.write_asl(vi_map, states(vi_map), folder / "asl.csv")
    return folder / "asl.csv"


def as_rpg(vi_map: VIMap, folder: Path) -> Path:
    vertex_states.write_rpg(states(vi_map), folder / "rpg.txt")
    return folder / "rpg.txt"


def as_tum(vi_map: VIMap, folder: Path) -> Path:
    write_tum(Trajectory(states(vi_map).time_ns, states(vi_map).T_G_S), folder / "tum.txt")
    return folder / "tum.txt"


def as_euroc(vi_map: VIMap, folder: Path) -> Path:
    write_euroc(Trajectory(states(vi_map).time_ns, states(vi_map).T_G_S), folder / "euroc.csv")
    return folder / "euroc.csv"


def as_localized(vi_map: VIMap, folder: Path) -> Path:
    """rovioli's poses in a map; the second frame was not localised."""
    of = states(vi_map)
    lines = [LOCALIZED_HEADER]
    for row, time_ns in enumerate(of.time_ns.tolist()):
        T_G_I = se3.identity() if row == 1 else of.T_G_S[row]
        poses = [T[[4, 5, 6, 3, 0, 1, 2]] for T in (T_G_I, of.T_M_S[row], vi_map.T_G_M[0])]
        values = np.concatenate([*poses, of.v_M[row], np.zeros(6), [0.1, row != 1, 0]])
        lines.append(f"{time_ns}," + ",".join(f"{v:.17g}" for v in values) + "\n")
    (folder / "localized.csv").write_text("".join(lines))
    return folder / "localized.csv"


def as_table(vi_map: VIMap, folder: Path) -> Path:
    options = CsvExportOptions(absolute_time=True)
    export_csv_dataset(vi_map, folder / "csv", options)
    return next((folder / "csv").glob(f"{vi_map.mission(0).id}*/vertices.csv"))


EXPORTS: dict[str, Write] = {
    "export_trajectory_to_csv": as_asl,
    "export_trajectory_to_csv --csv_export_format=rpg": as_rpg,
    "csv_export": as_table,
    "TUM": as_tum,
    "EuRoC": as_euroc,
    "rovioli --export_localized_poses_to_csv": as_localized,
}
SECONDS = ("TUM", "export_trajectory_to_csv --csv_export_format=rpg")


@pytest.mark.parametrize("name", EXPORTS)
def test_trajectories_are_read_with_their_values(name: str, tmp_path: Path) -> None:
    vi_map = flat_map()
    read = read_trajectory(EXPORTS[name](vi_map, tmp_path))
    rows = np.searchsorted(states(vi_map).time_ns, read.times_ns)
    assert len(read) == VERTICES - (name.startswith("rovioli"))
    np.testing.assert_array_equal(read.times_ns, states(vi_map).time_ns[rows])
    np.testing.assert_allclose(read.T_R_B, states(vi_map).T_G_S[rows], atol=1e-14)
    if read.v_R is not None and name != "csv_export":
        q_G_M = vi_map.T_G_M[0, :4]
        expected = so3.rotate(q_G_M, states(vi_map).v_M[rows])
        np.testing.assert_allclose(read.v_R, expected, atol=1e-12)


@pytest.mark.parametrize("name", EXPORTS)
def test_trajectories_are_read_by_every_command(name: str, tmp_path: Path) -> None:
    vi_map = flat_map()
    path = EXPORTS[name](vi_map, tmp_path)
    (tmp_path / "truth").mkdir()
    truth = as_tum(vi_map, tmp_path / "truth")
    mission = vi_map.mission(0).id[:8]
    with Session() as session:
        session.maps.add("small", vi_map)
        flags: dict[str, Any] = {"map_mission": mission, "trajectory_file": path}
        for kind in ("absolute", "odometry"):
            report: Any = session.run("import_trajectory", **flags, **{"as": kind})
            assert report.added >= VERTICES - 3
            assert report.notes == ()
        report = session.run("evaluate_trajectory", ground_truth=path, map_mission_list=mission)
        assert report.ape_m.rmse < 1e-6
        assert report.ape_deg.rmse < 1e-6
        report = session.run(
            "evaluate_localization",
            ground_truth=truth,
            localization_csv=str(path),
        )
        assert report.files[0].rmse_m < 1e-9
        flags = {"trajectory_file": path, "map_key": "again", "as": "mission"}
        report = session.run("import_trajectory", **flags)
        assert report.added >= VERTICES - 1


def test_poses_of_several_missions_are_read_in_the_order_of_time(tmp_path: Path) -> None:
    vi_map = flat_map()
    every = vertex_states.vertex_states(vi_map)
    vertex_states.write_asl(vi_map, every, tmp_path / "all.csv")
    read = read_trajectory(tmp_path / "all.csv", keep_repeated=True)
    assert len(read) == len(vi_map.vertices)
    assert np.all(np.diff(read.times_ns) >= 0)


def test_frames_that_were_not_localised_are_known(tmp_path: Path) -> None:
    localized = read_localized(as_localized(flat_map(), tmp_path))
    assert localized.is_localized.tolist() == [row != 1 for row in range(VERTICES)]


def test_imu_samples_of_the_table_are_read(tmp_path: Path) -> None:
    vi_map = flat_map()
    export_csv_dataset(vi_map, tmp_path / "csv", CsvExportOptions(absolute_time=True))
    path = next((tmp_path / "csv").glob(f"{vi_map.mission(0).id}*/imu.csv"))
    read = read_imu_csv(path)
    rows = np.searchsorted(vi_map.imu_samples.timestamp_ns, read.times_ns)
    np.testing.assert_array_equal(read.accel_gyro, vi_map.imu_samples.accel_gyro[rows])


def calibrations(vi_map: VIMap, folder: Path, form: str) -> tuple[Path, ...]:
    """Write the device of a map as every command does; return the files, cameras first."""
    if form == "save":
        save_map(vi_map, folder / "map")
        return (next((folder / "map").rglob("sensors.yaml")),)
    if form == "export_ncamera_calibration":
        with Session() as session:
            session.maps.add("small", vi_map)
            session.run(form, ncamera_calibration_export_folder=folder)
        return tuple(folder.glob("ncamera-*.yaml"))
    for name, text in exported(vi_map.sensors, *device_of(vi_map), form, imu_rate_hz=200.0).items():
        (folder / name).write_text(text)
    return tuple(sorted(folder.iterdir(), key=lambda path: "cam" not in path.name))


@pytest.mark.parametrize(
    "form", ["save", "maplab", "kalibr", "openvins", "basalt", "export_ncamera_calibration"]
)
def test_calibrations_are_read_by_the_import_and_by_flags(form: str, tmp_path: Path) -> None:
    vi_map = scene_map(distortion=Distortion.RADTAN)
    device = device_of(vi_map)
    files = calibrations(vi_map, tmp_path, form)
    with Session() as session:
        flags = dict(zip(("calibration_file", "imu_calibration_file"), files, strict=False))
        report: Any = session.run("import_calibration", **flags)
        assert len(report.cameras) == len(vi_map.sensors.camera_rig(device.rig).cameras)
    flags = dict(zip(("sensor_calibration_file", "imu_calibration_file"), files, strict=False))
    read = reader_choice.given_device(SourceOptions(**flags), "a bag")
    expected = vi_map.sensors.camera_rig(device.rig).cameras
    for camera, own in zip(read.cameras, expected, strict=True):
        np.testing.assert_allclose(camera.intrinsics, own.intrinsics, rtol=1e-12)
        np.testing.assert_allclose(camera.distortion_parameters, own.distortion_parameters)
        assert (camera.width_px, camera.height_px) == (own.width_px, own.height_px)
    if form == "export_ncamera_calibration":
        assert not read.imu_id  # a rig alone: its cameras are relative to each other
        return
    np.testing.assert_allclose(read.T_I_C, vi_map.sensors.T_I_C(*device), atol=1e-9)
    imu, own_imu = read.sensors.imu(read.imu_id), vi_map.sensors.imu(device.imu)
    for name in ("T_g", "T_a", "R_A_I"):
        values = (getattr(of.intrinsics, name) for of in (imu, own_imu))
        np.testing.assert_allclose(*values, atol=1e-9, err_msg=name)
    assert imu.acc_noise_density == pytest.approx(own_imu.acc_noise_density, rel=1e-12)
    assert imu.gyro_noise_density == pytest.approx(own_imu.gyro_noise_density, rel=1e-12)
