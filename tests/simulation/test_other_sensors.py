"""Absolute poses, odometry, wheels and loop closure edges: right mean, right size, right share."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from maplab_py.errors import UserError
from maplab_py.geometry import se3
from maplab_py.geometry.interpolation import interpolate_poses
from maplab_py.interop.wheel_odometry import read_wheel_odometry
from maplab_py.simulation.raw_data import write_raw_data
from maplab_py.simulation.scenario import OtherSensorOptions, SessionOptions
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.simulation.simulate import SimulatedData, simulate
from maplab_py.storage.native import load_map, save_map
from maplab_py.vimap import MissionSensor, TransformationKind
from maplab_py.vimap.consistency import check_consistency
from maplab_py.vimap.ids import to_hex
from tests.simulation.small import SMALL, simulated

OPTIONS = OtherSensorOptions(
    absolute_pose_every_s=0.2, odometry=True, wheel_odometry=True, loop_edges=40,
    loop_edge_false_share=0.25, loop_edge_min_gap_s=8.0, loop_edge_max_distance_m=1.5,
)  # fmt: skip
SCENARIO = dataclasses.replace(
    SMALL,
    other_sensors=OPTIONS,
    sessions=(SessionOptions(duration_s=40.0, turns=2.0),),
)


@pytest.fixture(scope="module")
def data() -> SimulatedData:
    return simulate(SCENARIO)


def _scatter(error: np.ndarray, covariance: np.ndarray) -> float:
    """Return the mean squared error in sigmas per degree of freedom."""
    return float(np.mean(error**2 / np.diagonal(covariance, axis1=1, axis2=2)))


def test_maps_with_other_sensors_are_consistent_and_survive_their_files(
    data: SimulatedData, tmp_path: Path
) -> None:
    vi_map = data.maps[0]
    report = check_consistency(vi_map)
    assert report.errors == ()
    assert report.warnings == ()
    folder = tmp_path / "map"
    save_map(vi_map, folder)
    back, _ = load_map(folder)
    np.testing.assert_array_equal(back.absolute_poses.T_G_S, vi_map.absolute_poses.T_G_S)
    assert len(back.transformation_edges) == len(vi_map.transformation_edges)
    assert len(back.loop_closure_edges) == 40
    assert back.sensors.sensors.keys() == vi_map.sensors.sensors.keys()


def test_absolute_poses_scatter_about_the_true_sensor(data: SimulatedData) -> None:
    vi_map, truth = data.maps[0], data.truth
    table = vi_map.absolute_poses
    imu = to_hex(vi_map.missions.sensor_id[0, MissionSensor.IMU])
    T_I_S = vi_map.sensors.T_I_S(imu, to_hex(table.sensor_id[0]))
    assert np.linalg.norm(T_I_S[4:]) > 0.1
    error = se3.local(se3.compose(truth.T_G_I[table.vertex], T_I_S), table.T_G_S)
    assert len(table) == 201
    assert _scatter(error, table.covariance) == pytest.approx(1.0, abs=0.12)


@pytest.mark.parametrize("kind", [TransformationKind.ODOMETRY, TransformationKind.WHEEL_ODOMETRY])
def test_odometry_scatters_about_the_true_motion(
    data: SimulatedData, kind: TransformationKind
) -> None:
    vi_map, truth = data.maps[0], data.truth
    table = vi_map.transformation_edges.take(vi_map.transformation_edges.kind == kind)
    imu = to_hex(vi_map.missions.sensor_id[0, MissionSensor.IMU])
    T_G_S = se3.compose(truth.T_G_I, vi_map.sensors.T_I_S(imu, to_hex(table.sensor_id[0])))
    true = se3.relative(T_G_S[table.from_vertex], T_G_S[table.to_vertex])
    assert len(table) == len(vi_map.vertices) - 1
    error = se3.local(true, table.T_A_B)
    assert _scatter(error, table.covariance) == pytest.approx(1.0, abs=0.12)


def test_true_loop_edges_are_true_and_false_ones_are_not(data: SimulatedData) -> None:
    vi_map, truth = data.maps[0], data.truth
    table = vi_map.loop_closure_edges
    np.testing.assert_array_equal(truth.loop_edge_id, table.id)
    good = truth.loop_edge_is_true
    assert good.sum() == 30
    true = se3.relative(truth.T_G_I[table.from_vertex], truth.T_G_I[table.to_vertex])
    error = se3.local(true, table.T_A_B)
    assert _scatter(error[good], table.covariance[good]) == pytest.approx(1.0, abs=0.3)
    assert np.linalg.norm(error[~good, :3], axis=1).min() > 1.5
    gap_ns = np.diff(vi_map.vertices.timestamp_ns[[table.from_vertex, table.to_vertex]], axis=0)
    assert gap_ns.min() >= 8e9


def test_other_sensors_leave_the_other_measurements_alone(data: SimulatedData) -> None:
    plain = simulate(dataclasses.replace(SCENARIO, other_sensors=OtherSensorOptions())).maps[0]
    np.testing.assert_array_equal(plain.keypoints.uv_px, data.maps[0].keypoints.uv_px)
    np.testing.assert_array_equal(plain.imu_samples.accel_gyro, data.maps[0].imu_samples.accel_gyro)
    assert len(simulated().maps[0].loop_closure_edges) == 0


def test_too_many_loop_edges_are_refused() -> None:
    options = dataclasses.replace(OPTIONS, loop_edges=100_000)
    with pytest.raises(UserError, match=r"other_sensors.loop_edges: the motion offers \d+ pairs"):
        simulate(dataclasses.replace(SCENARIO, other_sensors=options))


def test_the_scenario_of_false_edges() -> None:
    data = simulate(load_scenario("false_loop_edges"))
    assert len(data.truth.loop_edge_is_true) == 60
    assert data.truth.loop_edge_is_true.sum() == 40


def test_raw_data_have_the_velocities_of_the_wheels(tmp_path: Path) -> None:
    options = OtherSensorOptions(
        wheel_odometry=True,
        wheel_scale=1.5,
        wheel_position_m=(-0.2, 0.1, -0.3),
        wheel_turn_rad=(0.0, 0.0, 0.2),
        odometry_sigma_m=1e-6,
        odometry_sigma_deg=1e-5,
    )
    scenario = dataclasses.replace(
        SMALL,
        world=dataclasses.replace(SMALL.world, rooms=2),
        other_sensors=options,
        sessions=(SessionOptions(kind="vehicle", duration_s=8.0, turns=0.2),),
    )
    data = simulate(scenario)
    (folder,) = write_raw_data(scenario, data, tmp_path)
    track = read_wheel_odometry(folder / "mav0" / "wheel0" / "data.csv")
    assert track.kind == "velocities"
    edges = data.maps[0].transformation_edges
    stamps = data.maps[0].vertices.timestamp_ns
    T_O_S, covered = interpolate_poses(track.times_ns, track.T_O_S, stamps)
    first = np.flatnonzero(covered[:-1] & covered[1:])
    assert len(first) >= len(edges) - 1
    found = se3.relative(T_O_S[first], T_O_S[first + 1])
    assert np.linalg.norm(edges.T_A_B[:, 4:], axis=1).sum() > 1.0
    np.testing.assert_allclose(found[:, 4:], edges.T_A_B[first, 4:], atol=1e-3)
    np.testing.assert_allclose(
        se3.log(se3.relative(found, edges.T_A_B[first]))[:, 3:], 0.0, atol=1e-3
    )
