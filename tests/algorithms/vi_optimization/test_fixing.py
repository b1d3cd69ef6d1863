"""Every --ba_fix flag keeps exactly what it names, and lets everything else move."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pytest

from maplab_py.algorithms.vi_optimization.optimization import optimize
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.errors import UserError
from maplab_py.vimap import VIMap
from tests.support.scene import Scene, corrupted

OPTIONS = VIOptimizationOptions(num_iterations=5)

# what a flag keeps: (attribute of the map, column)
KEPT = {
    "fix_vertices": [("vertices", "T_M_I")],
    "fix_velocity": [("vertices", "v_M")],
    "fix_gyro_bias": [("vertices", "gyro_bias")],
    "fix_accel_bias": [("vertices", "accel_bias")],
    "fix_landmark_positions": [("", "p_G")],
}
STATES = [column for columns in KEPT.values() for column in columns]


@cache
def start() -> VIMap:
    truth = Scene(missions=2, vertices=6, noise=1.0).make()
    rng = np.random.default_rng(2)
    return corrupted(
        truth,
        rng,
        position_m=0.01,
        quaternion=0.002,
        landmark_m=0.01,
        velocity_mps=0.02,
        gyro_bias=1e-3,
        accel_bias=0.02,
    )


def state(vi_map: VIMap, place: tuple[str, str]) -> np.ndarray:
    table = getattr(vi_map, place[0]) if place[0] else vi_map
    return np.asarray(getattr(table, place[1]))


@pytest.mark.parametrize("names", [[], *([name] for name in KEPT), list(KEPT)[1:], list(KEPT)[:4]])
def test_what_is_named_stays_and_the_rest_moves(names: list[str]) -> None:
    options = dataclasses.replace(OPTIONS, **dict.fromkeys(names, True))  # type: ignore[arg-type]
    result, report = optimize(start(), options)
    assert report.cost_after < report.cost_before
    kept = [place for name in names for place in KEPT[name]]
    for place in STATES:
        change = np.abs(state(result, place) - state(start(), place)).max()
        if place in kept:
            assert change <= 1e-13, place
        else:
            assert change >= 1e-5, place


def test_with_everything_fixed_the_map_stays_and_the_cost_is_told() -> None:
    options = dataclasses.replace(OPTIONS, **dict.fromkeys(KEPT, True))  # type: ignore[arg-type]
    result, report = optimize(start(), options)
    for place in STATES:
        np.testing.assert_allclose(state(result, place), state(start(), place), atol=1e-13)
    assert report.cost_after == pytest.approx(report.cost_before)
    assert report.cost_before > 0.0


@pytest.mark.parametrize("mission", [0, 1])
def test_missions_that_are_not_named_stay_to_the_last_bit(mission: int) -> None:
    result, _ = optimize(start(), OPTIONS, missions=np.array([mission]))
    other = start().vertices.mission != mission
    for name in ("T_M_I", "v_M", "gyro_bias", "accel_bias"):
        before, after = getattr(start().vertices, name), getattr(result.vertices, name)
        np.testing.assert_array_equal(after[other], before[other])
        assert np.abs(after[~other] - before[~other]).max() > 1e-5


def test_base_frames_measurements_and_sensors_stay() -> None:
    result, _ = optimize(start(), OPTIONS)
    assert result.baseframes is start().baseframes
    assert result.keypoints is start().keypoints
    assert result.imu_samples is start().imu_samples
    assert result.sensors is start().sensors


def test_base_frames_that_nothing_could_move_are_refused() -> None:
    options = dataclasses.replace(
        OPTIONS, fix_vertices=True, absolute_pose_sensor_fix_mission_baseframes=False
    )
    with pytest.raises(UserError, match="--ba_fix_vertices keeps the base frames as well"):
        optimize(start(), options)
