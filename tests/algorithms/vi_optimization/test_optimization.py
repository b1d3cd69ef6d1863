"""optvi on simulated sessions with known truth: accuracy, gauge, outliers, robustness to bad maps."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pytest

from maplab_py.algorithms.vi_optimization.optimization import optimize
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.errors import EstimationError
from maplab_py.geometry import se3, so3
from maplab_py.simulation.evaluation import evaluate_map
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.simulation.simulate import SimulatedData, simulate
from maplab_py.vimap import VIMap
from maplab_py.vimap.consistency import check_consistency
from maplab_py.vimap.edits import remove_observations

OPTIONS = VIOptimizationOptions()


@cache
def data() -> SimulatedData:
    return simulate(load_scenario("three_sessions"))


def session() -> VIMap:
    return data().maps[0]


def test_errors_against_truth_fall() -> None:
    before = evaluate_map(session(), data().truth)
    result, report = optimize(session(), OPTIONS)
    after = evaluate_map(result, data().truth)
    assert after.missions[0].ate_m <= 0.25 * before.missions[0].ate_m
    assert report.cost_after < report.cost_before
    assert sum(term.cost_after for term in report.terms) == pytest.approx(report.cost_after)
    assert check_consistency(result).failure == ""


def test_only_position_and_heading_of_one_vertex_are_fixed() -> None:
    result, report = optimize(session(), OPTIONS)
    assert report.gauge == "position and heading of 1 cluster"
    first = session().T_G_I[0], result.T_G_I[0]
    np.testing.assert_array_equal(first[0][4:], first[1][4:])
    turned = so3.log(so3.multiply(first[1][:4], so3.inverse(first[0][:4])))
    assert abs(turned[2]) <= 1e-4
    assert np.linalg.norm(turned[:2]) > abs(turned[2])


def test_the_optimum_does_not_depend_on_where_the_map_lies() -> None:
    options = dataclasses.replace(OPTIONS, num_iterations=60, function_tolerance=1e-10)
    here = optimize(session(), options)[1]
    frames = session().baseframes
    moved = se3.compose(se3.make(so3.exp([0.0, 0.0, 1.3]), [50.0, -20.0, 3.0]), frames.T_G_M)
    there = optimize(session().replace(baseframes=frames.replace(T_G_M=moved)), options)[1]
    assert there.cost_after == pytest.approx(here.cost_after, rel=1e-4)


def test_corrupted_poses_return() -> None:
    good, _ = optimize(session(), OPTIONS)
    rng = np.random.default_rng(5)
    vertices = good.vertices
    delta = np.concatenate(
        [rng.normal(0.0, 0.05, (len(vertices), 3)), rng.normal(0.0, 0.01, (len(vertices), 3))],
        axis=1,
    )
    delta[0] = 0.0
    bad = good.replace(vertices=vertices.replace(T_M_I=se3.retract(vertices.T_M_I, delta)))
    again, _ = optimize(bad, dataclasses.replace(OPTIONS, num_iterations=60))
    error = np.linalg.norm(again.T_G_I[:, 4:] - good.T_G_I[:, 4:], axis=1)
    assert error.max() <= 0.03


def test_input_is_untouched_and_runs_are_identical() -> None:
    before = session().vertices.T_M_I.copy()
    one, two = (optimize(session(), OPTIONS)[0] for _ in range(2))
    np.testing.assert_array_equal(session().vertices.T_M_I, before)
    np.testing.assert_array_equal(one.vertices.T_M_I, two.vertices.T_M_I)
    np.testing.assert_array_equal(one.landmarks.p_I, two.landmarks.p_I)


def test_blind_vertices_and_missing_imu_edges_are_no_obstacle() -> None:
    blind = np.flatnonzero(np.isin(session().keypoint_vertex, [5, 6, 40]))
    observing = blind[session().keypoints.landmark[blind] >= 0]
    vi_map = remove_observations(session(), observing)
    result, report = optimize(vi_map, OPTIONS)
    assert report.vertices_held == 0  # inertial edges carry them
    assert np.isfinite(result.vertices.T_M_I).all()
    visual = dataclasses.replace(OPTIONS, include_inertial=False, num_iterations=10)
    result, report = optimize(vi_map, visual)
    assert report.vertices_held == 3
    held = result.vertices.T_M_I[5], vi_map.vertices.T_M_I[5]
    np.testing.assert_allclose(*held, atol=1e-12)


@pytest.mark.parametrize("loss", ["none", "huber", "cauchy", "tukey", "geman_mcclure", "dcs"])
def test_every_loss_lowers_its_cost(loss: str) -> None:
    options = dataclasses.replace(OPTIONS, loss=loss, num_iterations=10)
    report = optimize(session(), options)[1]
    assert report.cost_after < report.cost_before


def test_fixed_states_stay() -> None:
    options = dataclasses.replace(
        OPTIONS, fix_vertices=True, fix_gyro_bias=True, fix_landmark_positions=True
    )
    result, _ = optimize(session(), options)
    np.testing.assert_allclose(result.vertices.T_M_I, session().vertices.T_M_I, atol=1e-12)
    np.testing.assert_array_equal(result.vertices.gyro_bias, session().vertices.gyro_bias)
    assert np.abs(result.vertices.v_M - session().vertices.v_M).max() > 1e-4


def test_nothing_to_optimise_is_said() -> None:
    with pytest.raises(EstimationError, match="nothing to optimise"):
        optimize(VIMap(), OPTIONS)


def test_failed_factorisations_are_named_by_the_map() -> None:
    from maplab_py.algorithms.vi_optimization.map_problem import build
    from maplab_py.algorithms.vi_optimization.report_building import make_report
    from maplab_py.estimation.problem.solver import SolverSummary
    from maplab_py.estimation.states import NODES_PER_VERTEX, VELOCITY
    from maplab_py.vimap.ids import to_hex

    posed = build(session(), OPTIONS)
    summary = SolverSummary({}, {}, 3, 1, "", 0.0, (3 * NODES_PER_VERTEX + VELOCITY,))
    report = make_report(posed, posed.states, summary)
    assert report.singular_at == [f"velocity of {to_hex(session().vertices.id[3])}"]
