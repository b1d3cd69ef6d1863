"""maplab's acceptance tests, rebuilt on maps with known truth, with the default flags.

Source: applications/vi-mapping-test-app of maplab. All poses but the first two get 0.2 m of normal
noise and 0.05 on the vector part of a unit quaternion, landmarks 0.2 m in the frame of the vertex
that stores them; the result is compared with the map that was optimised undisturbed.
"""

import dataclasses
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from maplab_py.algorithms.vi_optimization.optimization import optimize
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.algorithms.vi_optimization.reports import VIOptimizationReport
from maplab_py.geometry import se3, so3
from maplab_py.sensors.sensor_set import Extrinsics, OtherSensor
from maplab_py.vimap import AbsolutePoses, LoopClosureEdges, VIMap, from_hex, random_ids
from tests.support.scene import Scene, corrupted

OPTIONS = VIOptimizationOptions()
MORE = pytest.mark.slow
SENSOR_ID = "a" * 32


@cache
def reference() -> VIMap:
    """Return the undisturbed map: a walk of 60 keyframes at its optimum."""
    measured = Scene(vertices=60, landmarks=900, seen_share=0.8, noise=1.0).make()
    options = dataclasses.replace(OPTIONS, num_iterations=50, function_tolerance=1e-9)
    return optimize(measured, options)[0]


def disturbed(vi_map: VIMap, seed: int, landmark_m: float = 0.2) -> VIMap:
    rng = np.random.default_rng(seed)
    return corrupted(vi_map, rng, position_m=0.2, quaternion=0.05, landmark_m=landmark_m, keep=2)


def pose_errors(result: VIMap) -> NDArray[np.float64]:
    """Return position errors [m] and angles [rad] of all vertices (V, 2)."""
    error = se3.local(reference().T_G_I, result.T_G_I)
    return np.stack([np.linalg.norm(error[:, k : k + 3], axis=1) for k in (0, 3)], axis=1)


def share_within(result: VIMap, limit_m: float) -> float:
    error = np.linalg.norm(result.landmarks.p_I - reference().landmarks.p_I, axis=1)
    return float(np.mean(error <= limit_m))


def recovered(vi_map: VIMap, seed: int, **flags: bool) -> tuple[VIMap, VIOptimizationReport]:
    return optimize(disturbed(vi_map, seed), dataclasses.replace(OPTIONS, **flags))  # type: ignore[arg-type]


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=MORE) for seed in range(1, 8))])
def test_disturbed_map_recovers(seed: int) -> None:
    before = disturbed(reference(), seed)
    assert pose_errors(before)[2:, 0].mean() > 0.25
    result, _ = recovered(reference(), seed)
    assert pose_errors(result).max() <= 0.03
    assert share_within(result, 0.03) >= 0.95


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=MORE) for seed in range(1, 4))])
def test_images_alone_recover_poses_over_known_landmarks(seed: int) -> None:
    moved = disturbed(reference(), seed, landmark_m=0.0)
    home = reference().landmarks.vertex
    known = se3.transform(se3.inverse(moved.T_G_I[home]), reference().p_G)
    moved = moved.replace(landmarks=moved.landmarks.replace(p_I=known))
    options = dataclasses.replace(OPTIONS, include_inertial=False, fix_landmark_positions=True)
    result, _ = optimize(moved, options)
    assert pose_errors(result).max() <= 0.05
    np.testing.assert_allclose(result.p_G, reference().p_G, atol=1e-12)


def with_absolute_poses(vi_map: VIMap, every: int = 10) -> VIMap:
    """Add exact measurements of a sensor mounted anywhere, 1 cm and 0.01 rad strong."""
    vertex = np.arange(0, len(vi_map.vertices), every)
    T_I_S = se3.make(so3.exp([0.5, -1.0, 0.3]), [0.3, -0.4, 0.9])
    imu_id = next(iter(vi_map.sensors.sensors))
    sensors = dataclasses.replace(
        vi_map.sensors,
        sensors={
            **vi_map.sensors.sensors,
            SENSOR_ID: OtherSensor(SENSOR_ID, "ABSOLUTE_6DOF"),
        },
        extrinsics={**vi_map.sensors.extrinsics, SENSOR_ID: Extrinsics(imu_id, T_I_S)},
    )
    table = AbsolutePoses.filled(
        len(vertex),
        vertex=vertex,
        timestamp_ns=vi_map.vertices.timestamp_ns[vertex],
        sensor_id=np.tile(from_hex(SENSOR_ID), (len(vertex), 1)),
        T_G_S=se3.compose(vi_map.T_G_I[vertex], T_I_S),
        covariance=np.tile(1e-4 * np.eye(6), (len(vertex), 1, 1)),
    )
    return vi_map.replace(sensors=sensors, absolute_poses=table)


def with_loop_edges(vi_map: VIMap, *, wrong: int = 0) -> VIMap:
    """Add exact edges between vertices far apart, 1 cm and 0.01 rad strong, and wrong ones."""
    rng = np.random.default_rng(11)
    order = rng.permutation(len(vi_map.vertices))[::4]
    first, second = order[:-1], order[1:]
    T_A_B = se3.relative(vi_map.T_G_I[first], vi_map.T_G_I[second])
    a, b = rng.choice(len(vi_map.vertices), (2, wrong), replace=False)
    lie = se3.compose(
        se3.relative(vi_map.T_G_I[a], vi_map.T_G_I[b]),
        se3.make(so3.exp(rng.normal(size=(wrong, 3))), rng.normal(0.0, 2.0, (wrong, 3))),
    )
    count = len(first) + wrong
    table = LoopClosureEdges.filled(
        count,
        id=random_ids(count, rng),
        from_vertex=np.concatenate([first, a]),
        to_vertex=np.concatenate([second, b]),
        T_A_B=np.concatenate([T_A_B, lie]),
        covariance=np.tile(1e-4 * np.eye(6), (count, 1, 1)),
        switch_variable_variance=np.full(count, 1e-3),
    )
    return vi_map.replace(loop_closure_edges=table)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=MORE) for seed in range(1, 4))])
def test_absolute_poses_hold_the_map(seed: int) -> None:
    flags = {"include_absolute_pose_constraints": True}
    result, report = recovered(with_absolute_poses(reference()), seed, **flags)
    assert report.gauge == "nothing of 1 cluster"
    assert pose_errors(result).max() <= 0.005
    assert share_within(result, 0.01) >= 0.95


@pytest.mark.parametrize("wrong", [pytest.param(0, marks=MORE), 1, pytest.param(3, marks=MORE)])
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=MORE) for seed in range(1, 4))])
def test_loop_edges_hold_the_map_and_wrong_ones_do_no_harm(wrong: int, seed: int) -> None:
    flags = {"include_loop_closure_edges": True}
    result, report = recovered(with_loop_edges(reference(), wrong=wrong), seed, **flags)
    assert "loop closure" in [term.term for term in report.terms]
    assert pose_errors(result).max() <= 0.005
    assert share_within(result, 0.01) >= 0.95
