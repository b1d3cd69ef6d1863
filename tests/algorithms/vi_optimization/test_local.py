"""Optimisation of what new vertices touch."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from maplab_py.algorithms.vi_optimization.local import optimize_around
from maplab_py.algorithms.vi_optimization.optimization import optimize
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.vimap import VIMap
from tests.simulation.small import simulated

OPTIONS = VIOptimizationOptions(num_iterations=8, hide_iterations_console_output=True)


@pytest.fixture(scope="module")
def optimised() -> VIMap:
    return optimize(simulated().maps[0], OPTIONS)[0]


def test_fixed_vertices_keep_their_states_and_anchor_the_others(optimised: VIMap) -> None:
    fixed = np.array([0, 1, 2, 9])
    disturbed = _shifted(optimised, np.arange(3, 9), 0.05)
    result, report = optimize(disturbed, OPTIONS, fixed_vertices=fixed)
    for name in ("T_M_I", "v_M", "gyro_bias", "accel_bias"):
        assert np.allclose(
            getattr(result.vertices, name)[fixed],
            getattr(optimised.vertices, name)[fixed],
            atol=1e-12,
        )
    assert report.gauge == "nothing of 1 cluster"
    assert report.cost_after < 0.5 * report.cost_before
    moved = np.linalg.norm(result.T_G_I[3:9, 4:] - optimised.T_G_I[3:9, 4:], axis=1)
    assert moved.max() < 0.01


def test_new_vertices_are_corrected_and_far_ones_stay(optimised: VIMap) -> None:
    new = np.arange(len(optimised.vertices) - 4, len(optimised.vertices))
    disturbed = _shifted(optimised, new, 0.05)
    result, report = optimize_around(disturbed, new, OPTIONS, max_free=4, max_fixed=4)
    assert report.free_vertices == 8
    assert 1 <= report.fixed_vertices <= 5
    moved = np.linalg.norm(result.T_G_I[:, 4:] - optimised.T_G_I[:, 4:], axis=1)
    assert moved.max() < 0.01
    unchanged = np.all(result.vertices.T_M_I == disturbed.vertices.T_M_I, axis=1)
    assert np.count_nonzero(~unchanged) <= 8
    assert unchanged[: len(unchanged) - 12].all()


def test_with_room_for_all_it_is_the_joint_optimum(optimised: VIMap) -> None:
    session = simulated().maps[0]
    options = dataclasses.replace(OPTIONS, num_iterations=20)
    every = np.arange(len(session.vertices))
    local, report = optimize_around(session, every, options, max_free=0, max_fixed=0)
    joint, joint_report = optimize(session, options)
    assert report.fixed_vertices == 0
    assert report.optimization.cost_after == pytest.approx(joint_report.cost_after, rel=1e-6)
    np.testing.assert_allclose(local.T_G_I[:, 4:], joint.T_G_I[:, 4:], atol=1e-4)


def _shifted(vi_map: VIMap, vertices: np.ndarray, by_m: float) -> VIMap:
    T_M_I = vi_map.vertices.T_M_I.copy()
    T_M_I[vertices, 4] += by_m
    return vi_map.replace(vertices=vi_map.vertices.replace(T_M_I=T_M_I))
