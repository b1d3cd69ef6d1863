from __future__ import annotations

import numpy as np
import pytest

from maplab_py.algorithms.landmarks.keypoint_rays import landmark_covariance, largest_sigma
from maplab_py.algorithms.vi_optimization.data_selection import select
from maplab_py.algorithms.vi_optimization.optimization import optimize
from maplab_py.algorithms.vi_optimization.options import DataOptions, VIOptimizationOptions
from maplab_py.algorithms.vi_optimization.thinning import LeftOut, thinned
from maplab_py.errors import FlagError
from maplab_py.vimap import VIMap
from maplab_py.vimap.edits import remove_observations
from tests.simulation.small import simulated
from tests.vimap.builders import walk_map


def counts(vi_map: VIMap, keypoints: np.ndarray) -> np.ndarray:
    return np.bincount(vi_map.keypoints.landmark[keypoints], minlength=len(vi_map.landmarks))


def shared_with(vi_map: VIMap, keypoints: np.ndarray) -> np.ndarray:
    """Return for each vertex the number of other vertices that observe a landmark of its own."""
    sees = np.zeros((len(vi_map.vertices), len(vi_map.landmarks)), dtype=np.int64)
    sees[vi_map.keypoint_vertex[keypoints], vi_map.keypoints.landmark[keypoints]] = 1
    shared = sees @ sees.T
    np.fill_diagonal(shared, 0)
    return np.count_nonzero(shared, axis=1)


def test_nothing_is_left_out_without_limits():
    vi_map = walk_map()
    kept, left_out = thinned(vi_map, vi_map.observations, DataOptions())
    np.testing.assert_array_equal(kept, vi_map.observations)
    assert left_out == LeftOut()


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


def test_both_limits_hold_together_and_the_counts_add_up():
    vi_map = walk_map()
    options = DataOptions(max_observations_per_landmark=3, max_covisible_frames=6)
    kept, left_out = thinned(vi_map, vi_map.observations, options)
    assert counts(vi_map, kept).max() <= 3
    assert shared_with(vi_map, kept).max() <= 6
    assert left_out.over_limit + left_out.not_covisible == len(vi_map.observations) - len(kept)
    again, _ = thinned(vi_map, vi_map.observations, options)
    np.testing.assert_array_equal(again, kept)


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


@pytest.mark.parametrize(
    "values",
    [
        {"max_observations_per_landmark": -1},
        {"max_observations_per_landmark": 1},
        {"max_covisible_frames": -3},
    ],
)
def test_limits_out_of_range_are_refused(values):
    with pytest.raises(FlagError, match="--ba_max"):
        VIOptimizationOptions(**values)
