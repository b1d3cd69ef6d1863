"""A simulated lidar: where its points lie, what a map gets of it, and wrong options."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from maplab_py.errors import UserError
from maplab_py.geometry import se3, so3
from maplab_py.interop.ply import parse_ply
from maplab_py.simulation.scenario import LidarOptions, Scenario, WorldOptions
from maplab_py.simulation.scenario_file import check_scenario
from maplab_py.simulation.simulate import Lidar, simulate
from maplab_py.simulation.truth import Truth
from maplab_py.simulation.world import World, make_world
from maplab_py.storage.resources.store import ResourceStore
from maplab_py.vimap import MissionSensor, ResourceOwner
from maplab_py.vimap.ids import from_hex
from tests.simulation.small import SMALL

EXACT = LidarOptions(rate_hz=2.0, rings=8, columns=90, range_sigma_m=0.0)


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
    world = make_world(WorldOptions(landmarks_per_room=100), rng)
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
    world = make_world(WorldOptions(landmarks_per_room=100), rng)
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
    plain = simulate(dataclasses.replace(scenario, lidar=LidarOptions())).maps[0]
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
    cloud = parse_ply(ResourceStore(vi_map, folder).load(5), "cloud")
    assert distance_to_surfaces(world, se3.transform(T_G_L, cloud.p)).max() < 0.01


@pytest.mark.parametrize(
    ("options", "key"),
    [
        (LidarOptions(rate_hz=-1.0), "rate_hz"),
        (LidarOptions(rings=1), "rings"),
        (LidarOptions(lowest_deg=20.0, highest_deg=-20.0), "lowest_deg"),
        (LidarOptions(min_range_m=5.0, max_range_m=4.0), "max_range_m"),
    ],
)
def test_wrong_options_are_refused(options: LidarOptions, key: str) -> None:
    with pytest.raises(UserError, match=key):
        check_scenario(Scenario(lidar=options))
