"""Relaxation of simulated loops, with and without false closures."""

from __future__ import annotations

import numpy as np
import pytest

from maplab_py.algorithms.relaxation.options import RelaxationOptions
from maplab_py.algorithms.relaxation.relaxation import move_vertices, relax
from maplab_py.errors import Cancelled
from maplab_py.geometry import se3, so3
from maplab_py.progress import SilentProgress
from maplab_py.vimap.tables import Landmarks, LoopClosureEdges
from tests.algorithms.relaxation.loops import Loop, ate, simulate

OPTIONS = RelaxationOptions()


def _relaxed_error(loop: Loop, closures: LoopClosureEdges, options=OPTIONS) -> float:
    relaxed, report = relax(loop.vi_map, options, loop_closures=closures)
    assert report.failure == ""
    return ate(relaxed.T_G_I, loop.T_G_I)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("drift", [1.0, 4.0])
def test_thirty_percent_false_closures_cost_less_than_a_tenth(seed, drift):
    loop = simulate(seed, false_share=0.3, drift=drift)
    clean = loop.closures.take(np.arange(loop.num_true))
    clean_error = _relaxed_error(loop, clean, RelaxationOptions(robustness="none"))
    assert clean_error < 0.6 * ate(loop.vi_map.T_G_I, loop.T_G_I)
    relaxed, report = relax(loop.vi_map, OPTIONS, loop_closures=loop.closures)
    assert ate(relaxed.T_G_I, loop.T_G_I) <= 1.1 * clean_error
    num_false = len(loop.closures) - loop.num_true
    assert num_false <= report.num_switched_off <= num_false + 8
    assert report.num_loop_closures == len(loop.closures)
    assert report.cost_after < report.cost_before


@pytest.mark.parametrize("robustness", ["switchable", "cauchy"])
def test_other_robust_weightings_hold_too(robustness):
    loop = simulate(1, false_share=0.3)
    options = RelaxationOptions(robustness=robustness)
    relaxed, report = relax(loop.vi_map, options, loop_closures=loop.closures)
    raw = ate(loop.vi_map.T_G_I, loop.T_G_I)
    assert ate(relaxed.T_G_I, loop.T_G_I) < 0.5 * raw
    assert report.num_switched_off >= len(loop.closures) - loop.num_true


def test_false_closures_do_harm_without_robustness():
    loop = simulate(1, false_share=0.3)
    raw = ate(loop.vi_map.T_G_I, loop.T_G_I)
    assert _relaxed_error(loop, loop.closures, RelaxationOptions(robustness="none")) > raw


def test_missions_are_pulled_together_and_one_vertex_stays():
    loop = simulate(2, missions=3)
    relaxed, report = relax(loop.vi_map, OPTIONS, loop_closures=loop.closures)
    assert report.num_clusters == 1
    assert report.num_vertices == 599
    np.testing.assert_allclose(relaxed.T_G_I[0], loop.vi_map.T_G_I[0], atol=1e-12)
    assert ate(relaxed.T_G_I, loop.T_G_I) < 0.6 * ate(loop.vi_map.T_G_I, loop.T_G_I)
    np.testing.assert_array_equal(relaxed.baseframes.T_G_M, loop.vi_map.baseframes.T_G_M)


def test_only_chosen_missions_move():
    loop = simulate(2, missions=3, false_share=0.0)
    relaxed, report = relax(
        loop.vi_map, OPTIONS, loop_closures=loop.closures, missions=np.array([0, 2])
    )
    other = loop.vi_map.vertices.mission == 1
    np.testing.assert_array_equal(relaxed.vertices.T_M_I[other], loop.vi_map.vertices.T_M_I[other])
    assert report.num_ignored > 0
    assert "not chosen" in report.notes[0]


def test_without_closures_the_map_stays_and_the_report_fails():
    loop = simulate(0)
    same, report = relax(loop.vi_map, OPTIONS)
    assert same is loop.vi_map
    assert report.failure == "no loop closure edges"
    unknown = simulate(0, missions=2, false_share=0.0)
    across = unknown.closures.take(np.arange(5))
    mission = np.zeros(600, dtype=np.int32)
    mission[300:] = 1
    vi_map = unknown.vi_map.replace(
        baseframes=unknown.vi_map.baseframes.replace(is_known=np.array([True, False]))
    )
    same, report = relax(vi_map, OPTIONS, loop_closures=across)
    assert same is vi_map
    assert "unknown base frame" in report.failure


def test_closures_of_the_map_count_and_stay():
    loop = simulate(0, false_share=0.0)
    vi_map = loop.vi_map.replace(loop_closure_edges=loop.closures)
    relaxed, report = relax(vi_map, OPTIONS)
    assert report.num_loop_closures == 80
    assert len(relaxed.loop_closure_edges) == 80
    assert ate(relaxed.T_G_I, loop.T_G_I) < 0.6 * ate(vi_map.T_G_I, loop.T_G_I)


def test_velocities_turn_and_landmarks_follow():
    vi_map = simulate(0).vi_map
    landmarks = Landmarks.filled(2, vertex=[3, 400], p_I=[[1.0, 2, 3], [4, 5, 6]])
    vi_map = vi_map.replace(landmarks=landmarks)
    turn = se3.make(so3.exp([0.0, 0.0, 0.3]), [1.0, -2.0, 0.5])
    rows = np.arange(100, 600)
    moved = move_vertices(vi_map, rows, se3.compose(turn, vi_map.T_G_I))
    np.testing.assert_array_equal(moved.vertices.T_M_I[:100], vi_map.vertices.T_M_I[:100])
    np.testing.assert_allclose(
        moved.vertices.v_M[rows], so3.rotate(turn[:4], vi_map.vertices.v_M[rows]), atol=1e-12
    )
    np.testing.assert_allclose(moved.p_G[1], se3.transform(turn, vi_map.p_G[1]), atol=1e-12)
    np.testing.assert_array_equal(moved.p_G[0], vi_map.p_G[0])


def test_same_bits_twice():
    loop = simulate(3)
    first, _ = relax(loop.vi_map, OPTIONS, loop_closures=loop.closures)
    second, _ = relax(loop.vi_map, OPTIONS, loop_closures=loop.closures)
    assert first.vertices.T_M_I.tobytes() == second.vertices.T_M_I.tobytes()


def test_cancelling_leaves_by_the_exception():
    class Impatient(SilentProgress):
        def check(self) -> None:
            raise Cancelled("stop")

    loop = simulate(3)
    with pytest.raises(Cancelled):
        relax(loop.vi_map, OPTIONS, loop_closures=loop.closures, progress=Impatient())
