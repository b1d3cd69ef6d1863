"""Segments, partitions and information."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from maplab_py.algorithms.self_calibration.estimation.problem import (
    bias_gaps,
    build_segment_problem,
    partitions,
    runs_of,
    split_landmarks,
)
from maplab_py.algorithms.self_calibration.segments.selection import collect, evaluate
from maplab_py.algorithms.self_calibration.segments.splitting import (
    extract_submap,
    split_into_segments,
)
from maplab_py.algorithms.self_calibration.uncertainty import (
    name_directions,
    posterior_covariance,
    score,
    spectrum,
)
from maplab_py.estimation.problem.marginals import Marginals
from tests.algorithms.self_calibration.scenes import OPTIONS, assert_only_gaps, scene_map


def test_segments_share_their_boundary_and_cover_the_mission() -> None:
    rows = split_into_segments(scene_map(), None, 11)
    assert [(int(one[0]), int(one[-1])) for one in rows] == [(0, 10), (10, 20), (20, 30)]


def test_segments_are_not_cut_across_a_missing_edge() -> None:
    vi_map = scene_map()
    broken = vi_map.replace(
        imu_edges=vi_map.imu_edges.replace(
            from_vertex=np.where(vi_map.imu_edges.from_vertex == 5, 6, vi_map.imu_edges.from_vertex)
        )
    )
    for rows in split_into_segments(broken, None, 11):
        assert not (rows[0] <= 5 < rows[-1])


def test_a_restricted_map_keeps_states_tracks_and_samples() -> None:
    vi_map = scene_map()
    rows = np.concatenate([np.arange(3, 12), np.arange(20, 28)])
    small = extract_submap(vi_map, rows)
    assert_only_gaps(small)
    np.testing.assert_array_equal(small.vertices.T_M_I, vi_map.vertices.T_M_I[rows])
    assert len(small.imu_edges) == 8 + 7
    assert runs_of(small).tolist() == [0] * 9 + [1] * 8
    kept = vi_map.landmark_index.rows(small.landmarks.id)
    np.testing.assert_allclose(small.p_G, vi_map.p_G[kept], atol=1e-12)
    observers = [np.unique(small.keypoint_vertex[small.keypoints.landmark == k]) for k in range(9)]
    assert min(map(len, observers)) >= 2


def test_gaps_are_bridged_within_a_mission_only() -> None:
    small = extract_submap(scene_map(), np.concatenate([np.arange(0, 5), np.arange(15, 20)]))
    gaps = bias_gaps(small)
    assert (gaps.before.tolist(), gaps.after.tolist()) == ([4], [5])
    assert gaps.duration_s[0] == pytest.approx(11 * 0.2)


def shared_landmarks(vi_map, a, b) -> int:
    label = runs_of(vi_map)
    seen = [
        set(vi_map.keypoints.landmark[(label[vi_map.keypoint_vertex] == k)].tolist()) - {-1}
        for k in (a, b)
    ]
    return len(seen[0] & seen[1])


def test_partitions_grow_together_above_the_threshold_only() -> None:
    small = extract_submap(scene_map(), np.concatenate([np.arange(0, 8), np.arange(10, 18)]))
    shared = shared_landmarks(small, 0, 1)
    assert shared > 3
    assert partitions(small, shared).max() == 1
    assert partitions(small, shared - 1).max() == 0


def test_partitions_have_landmarks_of_their_own() -> None:
    small = extract_submap(scene_map(), np.concatenate([np.arange(0, 8), np.arange(10, 18)]))
    label = partitions(small, 10**6)
    split = split_landmarks(small, label)
    assert_only_gaps(split)
    assert shared_landmarks(split, 0, 1) == 0
    before = np.sort(small.keypoints.uv_px[small.keypoints.landmark >= 0], axis=0)
    assert 0.9 * len(before) <= np.count_nonzero(split.keypoints.landmark >= 0) <= len(before)


def test_every_partition_has_one_gauge() -> None:
    small = extract_submap(scene_map(), np.concatenate([np.arange(0, 8), np.arange(10, 18)]))
    joined = build_segment_problem(small, OPTIONS)
    apart = build_segment_problem(small, dataclasses.replace(OPTIONS, min_shared_landmarks=10**6))
    assert (joined.num_partitions, apart.num_partitions) == (1, 2)
    difference = joined.problem.degrees_of_freedom() - apart.problem.degrees_of_freedom()
    assert difference == 4


def test_covariance_is_the_block_of_the_inverse() -> None:
    problem = build_segment_problem(scene_map(noise=1.0), OPTIONS, robust=False)
    states = problem.states
    node, direction = problem.parameters.nodes(states)
    covariance = posterior_covariance(problem, states)
    unique = np.unique(node)
    full = Marginals(problem.problem, states).nodes(unique)
    column = 3 * np.searchsorted(unique, node) + direction
    sigma = np.sqrt(np.diag(covariance))
    difference = (covariance - full[np.ix_(column, column)]) / np.outer(sigma, sigma)
    np.testing.assert_allclose(difference, 0.0, atol=1e-3)


def test_more_data_are_more_informative() -> None:
    vi_map = scene_map(noise=1.0)
    small, large = (
        posterior_covariance(p, p.states)
        for p in (
            build_segment_problem(extract_submap(vi_map, np.arange(n)), OPTIONS, robust=False)
            for n in (12, 31)
        )
    )
    assert np.linalg.eigvalsh(small - large).min() >= -1e-9 * np.abs(small).max()


@pytest.mark.parametrize("metric", ["a_optimality", "d_optimality", "e_optimality", "entropy"])
def test_scores_of_a_known_covariance(metric: str) -> None:
    sigma = np.array([0.5, 2.0, 3.0])
    covariance = np.diag((sigma * [1.0, 2.0, 3.0]) ** 2)
    rows = np.array([1, 2])
    wanted = {
        "a_optimality": 4.0 + 9.0,
        "d_optimality": np.log(36.0),
        "e_optimality": 9.0,
        "entropy": 0.5 * np.log((2.0 * np.pi * np.e) ** 2 * 36.0),
    }
    assert score(covariance, sigma, rows, metric) == pytest.approx(wanted[metric])


def test_an_undetermined_direction_is_found_and_named() -> None:
    problem = build_segment_problem(scene_map(noise=1.0), OPTIONS, robust=False)
    parameters = problem.parameters
    scale = parameters.prior_sigma
    covariance = np.diag((0.01 * scale) ** 2)
    k = parameters.names.index("gyroscope z scale")
    covariance[k, k] = scale[k] ** 2
    unknown = spectrum(covariance, parameters).unobservable()
    assert unknown.shape[1] == 1
    assert name_directions(unknown, parameters) == ("gyroscope z scale",)


def test_the_most_informative_segments_are_kept() -> None:
    vi_map = scene_map(vertices=61, noise=1.0)
    database, report = collect(vi_map, OPTIONS)
    evaluation = evaluate(vi_map, OPTIONS)
    assert report.segments_evaluated == len(evaluation.segments) == 7
    rows = evaluation.parameters.of_groups(("imu",))
    scores = np.sort(
        [
            score(one.covariance, database.sigma_ref, rows, "a_optimality")
            for one in evaluation.segments
        ]
    )
    kept = [one.scores["imu"] for one in database.ranked("imu")]
    np.testing.assert_allclose(kept, scores[:2], rtol=1e-6)
    assert set(database.members()) == {one.key for one in database.records}
