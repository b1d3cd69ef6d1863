"""The pose graph that is built of a map."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from maplab_py.algorithms.relaxation.map_edges import (
    loop_edges,
    trajectory_edges,
    usable_loop_closures,
)
from maplab_py.algorithms.relaxation.options import RelaxationOptions
from maplab_py.estimation.problem.gauge import clusters
from maplab_py.estimation.symbolic.sources import PoseError
from maplab_py.geometry import se3, so3
from tests.algorithms.relaxation.loops import simulate

OPTIONS = RelaxationOptions()
YAW = np.array([0.0, 0.0, 0.7])


def test_trajectory_edges_join_neighbours_and_fit_the_map_exactly():
    vi_map = simulate(0, missions=3).vi_map
    edges = trajectory_edges(vi_map, OPTIONS)
    assert len(edges) == 600 - 3
    mission = vi_map.vertices.mission
    assert np.all(mission[edges.from_vertex] == mission[edges.to_vertex])
    np.testing.assert_allclose(edges.errors(vi_map.T_G_I), 0.0, atol=1e-9)


def test_trajectory_edges_do_not_feel_a_common_yaw_and_shift():
    vi_map = simulate(0).vi_map
    turn = se3.make(so3.exp(YAW), [3.0, 2.0, 1.0])
    edges = trajectory_edges(vi_map, OPTIONS)
    np.testing.assert_allclose(edges.errors(se3.compose(turn, vi_map.T_G_I)), 0.0, atol=1e-9)


def test_tilting_costs_more_than_turning():
    vi_map = simulate(0).vi_map
    edges = trajectory_edges(vi_map, OPTIONS)
    middle = 300
    tails = []
    for axis in range(3):  # turn the second half about an axis of G through its first vertex
        T = vi_map.T_G_I.copy()
        pivot = se3.make(so3.identity(), T[middle, 4:])
        turn = se3.make(so3.exp(np.eye(3)[axis] * 0.01), np.zeros(3))
        about = se3.compose(se3.compose(pivot, turn), se3.inverse(pivot))
        T[middle:] = se3.compose(about, T[middle:])
        tails.append(float(np.sum(edges.errors(T) ** 2)))
    sigma_yaw = np.deg2rad(OPTIONS.yaw_drift_deg) * np.sqrt(0.3)
    np.testing.assert_allclose(tails[2], (0.01 / sigma_yaw) ** 2, rtol=1e-6)
    assert min(tails[:2]) > 10.0 * tails[2]


def test_loop_edges_take_covariances_and_replace_unusable_ones():
    closures = simulate(0).closures
    covariance = closures.covariance.copy()
    covariance[0] = np.nan
    covariance[1] = -np.eye(6)
    covariance[2] = 1e-7 * np.eye(6)
    edges = loop_edges(closures.replace(covariance=covariance), OPTIONS)
    implied = np.linalg.inv(edges.sqrt_information.transpose(0, 2, 1) @ edges.sqrt_information)
    floor = np.diag(np.repeat([0.03, np.deg2rad(0.5)], 3) ** 2)
    fallback = (
        np.diag(np.repeat([OPTIONS.loop_sigma_m, np.deg2rad(OPTIONS.loop_sigma_deg)], 3)) ** 2
    )
    np.testing.assert_allclose(implied[0], fallback + floor, atol=1e-12)
    np.testing.assert_allclose(implied[1], fallback + floor, atol=1e-12)
    np.testing.assert_allclose(implied[2], floor + 1e-7 * np.eye(6), atol=1e-12)
    np.testing.assert_allclose(implied[3], closures.covariance[3] + floor, atol=1e-12)


def _numeric(function, T, vertex):
    """Return the derivatives of function(T) by the twist of one vertex, (..., 6)."""
    columns = []
    for axis in range(6):
        sides = []
        for sign in (1.0, -1.0):
            moved = T.copy()
            moved[vertex] = se3.compose(T[vertex], se3.exp(sign * 1e-6 * np.eye(6)[axis]))
            sides.append(function(moved))
        columns.append((sides[0] - sides[1]) / 2e-6)
    return np.stack(columns, axis=-1)


@pytest.mark.parametrize("kind", PoseError)
def test_derivatives_match_finite_differences(kind):
    loop = simulate(1)
    T = loop.vi_map.T_G_I.copy()
    edges = loop_edges(loop.closures.take(np.arange(3)), OPTIONS)
    # exact, a small and a large error
    T_A_B = se3.relative(T[edges.from_vertex], T[edges.to_vertex])
    error = np.array([[0.0] * 6, [0.01, 0.0, 0.02, 0.001, -0.002, 0.0], [1, 2, -1, 0.5, -1.5, 1]])
    T_A_B = se3.compose(T_A_B, se3.inverse(se3.exp(error)))
    edges = dataclasses.replace(edges, T_A_B=T_A_B, error=kind)
    if kind is PoseError.LOGARITHM:
        whitened = np.einsum("eij,ej->ei", edges.sqrt_information, error)
        np.testing.assert_allclose(edges.errors(T), whitened, rtol=1e-9, atol=1e-9)
    J_a, J_b = np.moveaxis(edges.linearized(T)[1], 1, 0)
    scale = np.abs(J_b).max()
    for row in range(3):
        numeric_a = _numeric(lambda T, r=row: edges.errors(T)[r], T, edges.from_vertex[row])
        numeric_b = _numeric(lambda T, r=row: edges.errors(T)[r], T, edges.to_vertex[row])
        np.testing.assert_allclose(J_a[row], numeric_a, atol=1e-6 * scale)
        np.testing.assert_allclose(J_b[row], numeric_b, atol=1e-6 * scale)


def test_unusable_closures_are_left_out_with_a_reason():
    loop = simulate(0, missions=3)
    vi_map = loop.vi_map
    mission = vi_map.vertices.mission
    everything, notes = usable_loop_closures(vi_map, loop.closures, None)
    assert len(everything) == len(loop.closures)
    assert notes == []
    some, notes = usable_loop_closures(vi_map, loop.closures, np.array([0, 1]))
    assert 0 < len(some) < len(everything)
    assert np.all(mission[some.from_vertex] < 2)
    assert np.all(mission[some.to_vertex] < 2)
    assert "missions not chosen" in notes[0]
    known = np.array([True, True, False])
    floating = vi_map.replace(baseframes=vi_map.baseframes.replace(is_known=known))
    some, notes = usable_loop_closures(floating, loop.closures, None)
    a, b = mission[some.from_vertex], mission[some.to_vertex]
    assert np.all((a == b) | ((a < 2) & (b < 2)))
    assert np.any(a == 2)  # its own closures still count
    assert "unknown base frame" in notes[0]
    itself = loop.closures.replace(to_vertex=loop.closures.from_vertex)
    some, notes = usable_loop_closures(vi_map, itself, None)
    assert len(some) == 0
    assert "with itself" in notes[0]


def test_clusters_are_missions_joined_by_closures():
    loop = simulate(0, missions=2, false_share=0.0)
    trajectory = trajectory_edges(loop.vi_map, OPTIONS)
    none = loop_edges(loop.closures.take(np.zeros(0, dtype=int)), OPTIONS)
    joined = loop_edges(loop.closures, OPTIONS)
    for loops, count in ((none, 2), (joined, 1)):
        links = [(edges.from_vertex, edges.to_vertex) for edges in (trajectory, loops)]
        assert len(np.unique(clusters(600, links))) == count
