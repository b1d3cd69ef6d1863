"""Edges of closures: each once, with the covariance of the relative pose."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np

from maplab_py.algorithms.loop_closure.closure_table import Closures, closure_edges
from maplab_py.algorithms.loop_closure.merging import Votes, count_pairs
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.workflow import search_loops
from maplab_py.geometry import se3
from tests.algorithms.loop_closure.rooms import Walk, make_map

OPTIONS = LoopClosureOptions()
FLOOR = np.diag(np.array([0.01, 0.01, 0.01, 0.002, 0.002, 0.002]) ** 2)


@cache
def accepted() -> Closures:
    walks = [Walk(room=1, vertices=6), Walk(room=1, vertices=6, start_s=60.0)]
    closures = search_loops(make_map(walks)[0])[0].closures
    return closures.take(np.flatnonzero(closures.accepted))


def with_covariance(covariance: np.ndarray) -> Closures:
    count = len(accepted())
    return dataclasses.replace(accepted(), covariance=np.tile(covariance, (count, 1, 1)))


def test_no_edge_is_more_certain_than_points_of_a_map_are() -> None:
    edges = closure_edges(with_covariance(1e-12 * np.eye(6)), OPTIONS)
    np.testing.assert_allclose(edges.covariance, np.tile(FLOOR, (len(edges), 1, 1)), atol=1e-9)


def test_a_closure_that_was_found_twice_gives_one_edge() -> None:
    rows = np.arange(len(accepted()))
    once = closure_edges(accepted(), OPTIONS)
    twice = closure_edges(accepted().take(np.concatenate([rows, rows[:3]])), OPTIONS)
    np.testing.assert_array_equal(twice.id, once.id)
    assert len(np.unique(once.id, axis=0)) == len(once)


def test_covariances_are_those_of_the_relative_pose() -> None:
    # T_A_B = T_M_A^-1 T_M_B, derived by differences of T_M_A
    spread = np.random.default_rng(4).normal(size=(6, 6))
    covariance = 1e-2 * spread @ spread.T
    closures = with_covariance(covariance)
    edges = closure_edges(closures, OPTIONS)
    rows = np.array([closures.id.tolist().index(one) for one in edges.id.tolist()])
    T_M_A, T_A_B = closures.T_M_I[rows], closures.T_A_B[rows]
    T_M_B = se3.compose(T_M_A, T_A_B)
    step = 1e-6
    J = np.empty((len(edges), 6, 6))
    for axis in range(6):
        delta = np.tile(step * np.eye(6)[axis], (len(edges), 1))
        sides = [
            se3.local(T_A_B, se3.relative(se3.retract(T_M_A, sign * delta), T_M_B))
            for sign in (1.0, -1.0)
        ]
        J[:, :, axis] = (sides[0] - sides[1]) / (2.0 * step)
    expected = J @ covariance @ np.swapaxes(J, 1, 2) + FLOOR
    np.testing.assert_allclose(edges.covariance, expected, rtol=1e-5, atol=1e-7)


def test_keypoints_of_one_vertex_are_one_vote() -> None:
    source, target = np.array([3, 3, 9, 9]), np.array([7, 7, 4, 4])
    bits = np.array([10, 20, 1, 3], dtype=np.int32)
    votes = Votes(source, target, np.array([5, 5, 5, 6]), bits, bits == 1)
    pairs = count_pairs(votes, np.arange(20))
    rows = zip(pairs.first.tolist(), pairs.second.tolist(), pairs.votes.tolist(), strict=True)
    assert sorted(rows) == [(7, 3, 1), (9, 4, 2)]
    assert pairs.bits[pairs.of_vote].tolist() == [15.0, 15.0, 2.0, 2.0]
    assert pairs.is_doubtful[pairs.of_vote].tolist() == [False, False, True, True]


def test_places_seen_too_recently_are_not_searched() -> None:
    walks = [Walk(room=1, vertices=6), Walk(room=1, vertices=6, start_s=60.0)]
    vi_map = make_map(walks)[0]
    for seconds, is_found in ((50.0, True), (70.0, False)):
        options = LoopClosureOptions(min_image_time_seconds=seconds)
        assert search_loops(vi_map, options)[0].closures.accepted.any() == is_found
