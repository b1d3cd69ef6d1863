"""Lidar, absolute poses, odometry, wheels, loop closure edges: right mean, size and share."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from maplab_py.errors import UserError
from maplab_py.geometry import interpolation, se3, so3
from maplab_py.interop import ply, wheel_odometry
from maplab_py.simulation import raw_data, scenario_file
from maplab_py.simulation import scenario as sim
from maplab_py.simulation.simulate import Lidar, SimulatedData, simulate
from maplab_py.simulation.truth import Truth
from maplab_py.simulation.world import World, make_world
from maplab_py.storage.native import load_map, save_map
from maplab_py.storage.resources.store import ResourceStore
from maplab_py.vimap import MissionSensor, ResourceOwner, TransformationKind, from_hex, to_hex
from maplab_py.vimap.consistency import check_consistency
from tests.simulation.small import SMALL, simulated

OPTIONS = sim.OtherSensorOptions(
    absolute_pose_every_s=0.2, odometry=True, wheel_odometry=True, loop_edges=40,
    loop_edge_false_share=0.25, loop_edge_min_gap_s=8.0, loop_edge_max_distance_m=1.5,
)  # fmt: skip
SCENARIO = dataclasses.replace(
    SMALL,
    other_sensors=OPTIONS,
    sessions=(sim.SessionOptions(duration_s=40.0, turns=2.0),),
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
    plain = simulate(dataclasses.replace(SCENARIO, other_sensors=sim.OtherSensorOptions())).maps[0]
    np.testing.assert_array_equal(plain.keypoints.uv_px, data.maps[0].keypoints.uv_px)
    np.testing.assert_array_equal(plain.imu_samples.accel_gyro, data.maps[0].imu_samples.accel_gyro)
    assert len(simulated().maps[0].loop_closure_edges) == 0


def test_too_many_loop_edges_are_refused() -> None:
    options = dataclasses.replace(OPTIONS, loop_edges=100_000)
    with pytest.raises(UserError, match=r"other_sensors.loop_edges: the motion offers \d+ pairs"):
        simulate(dataclasses.replace(SCENARIO, other_sensors=options))


def test_raw_data_have_the_velocities_of_the_wheels(tmp_path: Path) -> None:
    options = sim.OtherSensorOptions(
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
        sessions=(sim.SessionOptions(kind="vehicle", duration_s=8.0, turns=0.2),),
    )
    data = simulate(scenario)
    (folder,) = raw_data.write_raw_data(scenario, data, tmp_path)
    track = wheel_odometry.read_wheel_odometry(folder / "mav0" / "wheel0" / "data.csv")
    assert track.kind == "velocities"
    edges = data.maps[0].transformation_edges
    stamps = data.maps[0].vertices.timestamp_ns
    T_O_S, covered = interpolation.interpolate_poses(track.times_ns, track.T_O_S, stamps)
    first = np.flatnonzero(covered[:-1] & covered[1:])
    assert len(first) >= len(edges) - 1
    found = se3.relative(T_O_S[first], T_O_S[first + 1])
    assert np.linalg.norm(edges.T_A_B[:, 4:], axis=1).sum() > 1.0
    np.testing.assert_allclose(found[:, 4:], edges.T_A_B[first, 4:], atol=1e-3)
    np.testing.assert_allclose(
        se3.log(se3.relative(found, edges.T_A_B[first]))[:, 3:], 0.0, atol=1e-3
    )


EXACT = sim.LidarOptions(rate_hz=2.0, rings=8, columns=90, range_sigma_m=0.0)


def distance_to_surfaces(world: World, p_G: np.ndarray) -> np.ndarray:
    """Return how far (N,) points are from the nearest side of the room and of its boxes."""
    low, high = world.bounds
    result = np.minimum(np.abs(p_G - low), np.abs(p_G - high)).min(axis=1)
    for box in world.boxes:
        beyond = np.maximum(np.maximum(box[0] - p_G, p_G - box[1]), 0.0)
        inside = np.minimum(p_G - box[0], box[1] - p_G).min(axis=1)
        off = np.where(inside > 0.0, inside, np.linalg.norm(beyond, axis=1))
        result = np.minimum(result, off)
    return result


def test_points_lie_on_the_surfaces_all_around() -> None:
    rng = np.random.default_rng(1)
    world = make_world(sim.WorldOptions(landmarks_per_room=100), rng)
    lidar = Lidar.of(world, EXACT, rng)
    T_G_L = se3.make(so3.exp([0.1, -0.2, 0.7]), np.array([0.5, -0.4, 1.4]))
    cloud = lidar.scan(T_G_L, rng)
    assert distance_to_surfaces(world, se3.transform(T_G_L, cloud.p)).max() < 1e-3
    azimuth = np.degrees(np.arctan2(cloud.p[:, 1], cloud.p[:, 0]))
    assert len(np.unique(np.round(azimuth / 4.0) % 90)) == 90
    elevation = np.degrees(np.arcsin(cloud.p[:, 2] / np.linalg.norm(cloud.p, axis=1)))
    assert elevation.min() == pytest.approx(EXACT.lowest_deg, abs=0.01)
    assert elevation.max() == pytest.approx(EXACT.highest_deg, abs=0.01)


def test_noise_lies_along_the_rays_and_ranges_are_limited() -> None:
    rng = np.random.default_rng(1)
    world = make_world(sim.WorldOptions(landmarks_per_room=100), rng)
    T_G_L = se3.make(so3.exp([0.0, 0.0, 0.0]), np.array([0.5, -0.4, 1.4]))
    exact = Lidar.of(world, EXACT, rng).scan(T_G_L, rng)
    noisy = Lidar.of(world, dataclasses.replace(EXACT, range_sigma_m=0.02), rng).scan(T_G_L, rng)
    error = np.linalg.norm(noisy.p, axis=1) - np.linalg.norm(exact.p, axis=1)
    assert error.std() == pytest.approx(0.02, rel=0.15)
    np.testing.assert_allclose(np.cross(noisy.p, exact.p), 0.0, atol=1e-4)
    near = Lidar.of(world, dataclasses.replace(EXACT, max_range_m=4.5), rng).scan(T_G_L, rng)
    assert 0 < len(near.p) < len(exact.p)
    assert np.linalg.norm(near.p, axis=1).max() <= 4.5


def test_a_map_gets_clouds_of_a_mounted_sensor() -> None:
    scenario = dataclasses.replace(SMALL, sessions=SMALL.sessions[:1], lidar=EXACT)
    data, again = simulate(scenario), simulate(scenario)
    vi_map, truth = data.maps[0], data.truth
    table = vi_map.resources
    assert len(table) == 12  # 6 s at 2 Hz
    assert (table.owner_kind == ResourceOwner.SENSOR).all()
    np.testing.assert_array_equal(table.id, again.maps[0].resources.id)
    np.testing.assert_array_equal(
        vi_map.missions.sensor_id[0, MissionSensor.LIDAR], table.sensor_id[0]
    )
    plain = simulate(dataclasses.replace(scenario, lidar=sim.LidarOptions())).maps[0]
    np.testing.assert_array_equal(plain.vertices.T_M_I, vi_map.vertices.T_M_I)
    assert not len(plain.resources)
    _check_clouds_against_truth(data.world, vi_map, truth)


def _check_clouds_against_truth(world: World, vi_map, truth: Truth) -> None:
    """Check that points lie on surfaces when the sensor is put where the true trajectory has it."""
    table = vi_map.resources
    row = int(np.argmin(np.abs(truth.sample_time_ns - table.timestamp_ns[5])))
    assert truth.sample_time_ns[row] == pytest.approx(table.timestamp_ns[5], abs=3_000_000)
    imu = next(key for key, s in vi_map.sensors.sensors.items() if hasattr(s, "gyro_noise_density"))
    lidar_id = next(
        key
        for key in vi_map.sensors.sensors
        if (from_hex(key) == np.asarray(table.sensor_id[0])).all()
    )
    T_G_L = se3.compose(truth.sample_T_G_I[row], vi_map.sensors.T_I_S(imu, lidar_id))
    folder = vi_map.metadata.staged_folders[0].path
    cloud = ply.parse_ply(ResourceStore(vi_map, folder).load(5), "cloud")
    assert distance_to_surfaces(world, se3.transform(T_G_L, cloud.p)).max() < 0.01


@pytest.mark.parametrize(
    ("options", "key"),
    [
        (sim.LidarOptions(rate_hz=-1.0), "rate_hz"),
        (sim.LidarOptions(rings=1), "rings"),
        (sim.LidarOptions(lowest_deg=20.0, highest_deg=-20.0), "lowest_deg"),
        (sim.LidarOptions(min_range_m=5.0, max_range_m=4.0), "max_range_m"),
    ],
)
def test_wrong_options_are_refused(options: sim.LidarOptions, key: str) -> None:
    with pytest.raises(UserError, match=key):
        scenario_file.check_scenario(sim.Scenario(lidar=options))
