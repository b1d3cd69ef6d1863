"""optvi against truth: accuracy, thinned observations, and parts of a map."""

import dataclasses
from functools import cache

import numpy as np
import pytest

from maplab_py.algorithms.landmarks.keypoint_rays import landmark_covariance, largest_sigma
from maplab_py.algorithms.vi_optimization.data_selection import LeftOut, select, thinned
from maplab_py.algorithms.vi_optimization.local import optimize_around
from maplab_py.algorithms.vi_optimization.optimization import optimize
from maplab_py.algorithms.vi_optimization.options import DataOptions, VIOptimizationOptions
from maplab_py.geometry import se3, so3
from maplab_py.simulation import evaluation, scenario_file
from maplab_py.simulation.simulate import SimulatedData, simulate
from maplab_py.vimap import VIMap, consistency
from maplab_py.vimap.edits import remove_observations
from tests.simulation.small import simulated
from tests.vimap.builders import walk_map

OPTIONS = VIOptimizationOptions()


@cache
def data() -> SimulatedData:
    return simulate(scenario_file.load_scenario("three_sessions"))


def session() -> VIMap:
    return data().maps[0]


def test_errors_against_truth_fall() -> None:
    before = evaluation.evaluate_map(session(), data().truth)
    result, report = optimize(session(), OPTIONS)
    after = evaluation.evaluate_map(result, data().truth)
    assert after.missions[0].ate_m <= 0.25 * before.missions[0].ate_m
    assert report.cost_after < report.cost_before
    assert sum(term.cost_after for term in report.terms) == pytest.approx(report.cost_after)
    assert consistency.check_consistency(result).failure == ""


def test_the_optimum_does_not_depend_on_where_the_map_lies() -> None:
    options = dataclasses.replace(OPTIONS, num_iterations=60, function_tolerance=1e-10)
    here = optimize(session(), options)[1]
    frames = session().baseframes
    moved = se3.compose(se3.make(so3.exp([0.0, 0.0, 1.3]), [50.0, -20.0, 3.0]), frames.T_G_M)
    there = optimize(session().replace(baseframes=frames.replace(T_G_M=moved)), options)[1]
    assert there.cost_after == pytest.approx(here.cost_after, rel=1e-4)


@pytest.mark.parametrize("loss", ["none", "huber", "cauchy", "tukey", "geman_mcclure", "dcs"])
def test_every_loss_lowers_its_cost(loss: str) -> None:
    options = dataclasses.replace(OPTIONS, loss=loss, num_iterations=10)
    report = optimize(session(), options)[1]
    assert report.cost_after < report.cost_before


EIGHT_STEPS = VIOptimizationOptions(num_iterations=8, hide_iterations_console_output=True)


@pytest.fixture(scope="module")
def optimised() -> VIMap:
    return optimize(simulated().maps[0], EIGHT_STEPS)[0]


def test_fixed_vertices_keep_their_states_and_anchor_the_others(optimised: VIMap) -> None:
    fixed = np.array([0, 1, 2, 9])
    disturbed = _shifted(optimised, np.arange(3, 9), 0.05)
    result, report = optimize(disturbed, EIGHT_STEPS, fixed_vertices=fixed)
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
    result, report = optimize_around(disturbed, new, EIGHT_STEPS, max_free=4, max_fixed=4)
    assert report.free_vertices == 8
    assert 1 <= report.fixed_vertices <= 5
    moved = np.linalg.norm(result.T_G_I[:, 4:] - optimised.T_G_I[:, 4:], axis=1)
    assert moved.max() < 0.01
    unchanged = np.all(result.vertices.T_M_I == disturbed.vertices.T_M_I, axis=1)
    assert np.count_nonzero(~unchanged) <= 8
    assert unchanged[: len(unchanged) - 12].all()


def test_with_room_for_all_it_is_the_joint_optimum(optimised: VIMap) -> None:
    session = simulated().maps[0]
    options = dataclasses.replace(EIGHT_STEPS, num_iterations=20)
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


def counts(vi_map: VIMap, keypoints: np.ndarray) -> np.ndarray:
    return np.bincount(vi_map.keypoints.landmark[keypoints], minlength=len(vi_map.landmarks))


def shared_with(vi_map: VIMap, keypoints: np.ndarray) -> np.ndarray:
    """Return for each vertex the number of other vertices that observe a landmark of its own."""
    sees = np.zeros((len(vi_map.vertices), len(vi_map.landmarks)), dtype=np.int64)
    sees[vi_map.keypoint_vertex[keypoints], vi_map.keypoints.landmark[keypoints]] = 1
    shared = sees @ sees.T
    np.fill_diagonal(shared, 0)
    return np.count_nonzero(shared, axis=1)


@pytest.mark.parametrize("limit", [2, 5, 8])
def test_every_landmark_keeps_as_many_observations_as_allowed(limit):
    vi_map = walk_map()
    options = DataOptions(max_observations_per_landmark=limit)
    kept, left_out = thinned(vi_map, vi_map.observations, options)
    before = counts(vi_map, vi_map.observations)
    np.testing.assert_array_equal(counts(vi_map, kept), np.minimum(before, limit))
    assert left_out.over_limit == len(vi_map.observations) - len(kept) > 0
    assert left_out.not_covisible == 0
    np.testing.assert_array_equal(kept, vi_map.observations[np.isin(vi_map.observations, kept)])


def test_what_is_kept_determines_landmarks_better_than_chance():
    vi_map = walk_map()
    limit = 3
    kept, _ = thinned(vi_map, vi_map.observations, DataOptions(max_observations_per_landmark=limit))
    rng = np.random.default_rng(3)
    order = np.lexsort(
        (rng.random(len(vi_map.observations)), vi_map.keypoints.landmark[vi_map.observations])
    )
    number = np.arange(len(order)) - np.repeat(
        vi_map.observation_start[:-1], np.diff(vi_map.observation_start)
    )
    at_random = vi_map.observations[order[number < limit]]
    many = np.flatnonzero(counts(vi_map, vi_map.observations) > 2 * limit)
    sigma = [
        largest_sigma(
            landmark_covariance(
                remove_observations(vi_map, np.setdiff1d(vi_map.observations, chosen)), many, 1.0
            )
        )
        for chosen in (kept, at_random)
    ]
    assert len(many) > 20
    assert np.mean(sigma[0] < sigma[1]) > 0.9
    assert np.median(sigma[0] / sigma[1]) < 0.8


@pytest.mark.parametrize("limit", [1, 3, 8])
def test_no_vertex_shares_landmarks_with_more_vertices_than_allowed(limit):
    vi_map = walk_map()
    options = DataOptions(max_covisible_frames=limit)
    kept, left_out = thinned(vi_map, vi_map.observations, options)
    assert shared_with(vi_map, vi_map.observations).max() > 8
    assert 0 < shared_with(vi_map, kept).max() <= limit
    assert left_out.not_covisible == len(vi_map.observations) - len(kept) > 0
    assert left_out.over_limit == 0


def test_landmarks_at_a_camera_and_maps_without_observations_are_taken():
    vi_map = walk_map()
    options = DataOptions(max_observations_per_landmark=2, max_covisible_frames=2)
    none, left_out = thinned(vi_map, np.zeros(0, dtype=np.int64), options)
    assert len(none) == 0
    assert left_out == LeftOut()
    p_I = vi_map.landmarks.p_I.copy()
    p_I[:5] = np.nan
    broken = vi_map.replace(landmarks=vi_map.landmarks.replace(p_I=p_I))
    kept, _ = thinned(broken, broken.observations, options)
    assert counts(broken, kept).max() <= 2


def test_the_report_counts_what_was_left_out_and_the_result_stays_near():
    vi_map = simulated().maps[0]
    options = VIOptimizationOptions(num_iterations=5)
    full, report = optimize(vi_map, options)
    assert report.observations_over_limit == report.observations_not_covisible == 0
    limited = VIOptimizationOptions(num_iterations=5, max_observations_per_landmark=6)
    thin, thinned_report = optimize(vi_map, limited)
    kept = len(select(vi_map, limited, None).keypoints)
    assert thinned_report.observations == kept
    assert thinned_report.observations_over_limit == report.observations - kept > 0
    moved = np.linalg.norm(full.T_G_I[:, 4:] - vi_map.T_G_I[:, 4:], axis=1)
    apart = np.linalg.norm(full.T_G_I[:, 4:] - thin.T_G_I[:, 4:], axis=1)
    assert np.median(apart) < max(0.5 * np.median(moved), 0.02)
