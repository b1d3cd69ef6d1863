"""Corrected IMU samples, tracks that jump, and parts that lose their lengths while solving."""

import dataclasses

import numpy as np
import pytest

from maplab_py.algorithms.self_calibration import calibration as module
from maplab_py.algorithms.self_calibration.calibration import calibrate, partitions_without_scale
from maplab_py.algorithms.self_calibration.estimation.imu_interpolation import (
    correct_interpolation_bias,
)
from maplab_py.algorithms.self_calibration.estimation.problem import (
    SegmentProblem,
    build_segment_problem,
    parallax_rad,
)
from maplab_py.algorithms.self_calibration.estimation.solution import reject_tracks_chi2, solve
from maplab_py.algorithms.self_calibration.segments.selection import collect
from maplab_py.algorithms.self_calibration.segments.splitting import extract_submap
from maplab_py.errors import EstimationError, UserError
from maplab_py.estimation.states import States
from maplab_py.vimap import VIMap
from maplab_py.vimap.edits import with_p_G
from maplab_py.vimap.table import ragged_rows
from tests.algorithms.self_calibration.scenes import EXACT, OPTIONS, scene_map, uncalibrated


def with_signal(vi_map: VIMap, hertz: float) -> tuple[VIMap, np.ndarray]:
    """Put a sine on all axes; return the integral (E,) over every edge, too."""
    time = vi_map.imu_samples.timestamp_ns * 1e-9
    begin = time.min()
    omega = 2.0 * np.pi * hertz
    values = np.repeat(np.sin(omega * (time - begin))[:, None], 6, axis=1)
    first = vi_map.sample_start[:-1]
    last = vi_map.sample_start[1:] - 1
    true = (np.cos(omega * (time[first] - begin)) - np.cos(omega * (time[last] - begin))) / omega
    return vi_map.replace(imu_samples=vi_map.imu_samples.replace(accel_gyro=values)), true


def integrals(vi_map: VIMap) -> np.ndarray:
    """Integrate straight lines between samples over every edge (E,)."""
    time, values = vi_map.imu_samples.timestamp_ns * 1e-9, vi_map.imu_samples.accel_gyro[:, 3]
    result = []
    for edge in range(len(vi_map.imu_edges)):
        rows = ragged_rows(vi_map.sample_start, np.array([edge]))
        result.append(np.trapezoid(values[rows], time[rows]))
    return np.array(result)


def test_chords_integrate_like_the_curve() -> None:
    vi_map, true = with_signal(scene_map(), 1.5)
    inner = slice(1, -1)  # at the ends the curvature is that of the neighbour
    plain = np.abs(integrals(vi_map) - true)[inner].max()
    corrected = np.abs(integrals(correct_interpolation_bias(vi_map)) - true)[inner].max()
    assert corrected < 0.01 * plain


def test_straight_signals_stay() -> None:
    vi_map = scene_map()
    time = vi_map.imu_samples.timestamp_ns * 1e-9
    straight = np.repeat((0.3 + 0.2 * (time - time.min()))[:, None], 6, axis=1)
    before = vi_map.replace(imu_samples=vi_map.imu_samples.replace(accel_gyro=straight))
    after = correct_interpolation_bias(before).imu_samples.accel_gyro
    np.testing.assert_allclose(after, straight, atol=1e-9)


def test_copies_of_a_sample_between_edges_stay_equal() -> None:
    vi_map, _ = with_signal(scene_map(), 1.5)
    corrected = correct_interpolation_bias(vi_map)
    values, start = corrected.imu_samples.accel_gyro, corrected.sample_start
    follows = vi_map.imu_edges.to_vertex[:-1] == vi_map.imu_edges.from_vertex[1:]
    assert follows.any()
    np.testing.assert_array_equal(values[start[1:-1] - 1][follows], values[start[1:-1]][follows])


def jumping(vi_map: VIMap, landmarks: np.ndarray, jump_px: float) -> VIMap:
    """Move the second half of some landmarks' tracks."""
    uv = np.array(vi_map.keypoints.uv_px)
    start = vi_map.observation_start
    for landmark in landmarks.tolist():
        rows = vi_map.observations[start[landmark] : start[landmark + 1]]
        uv[rows[len(rows) // 2 :]] += jump_px * np.array([0.6, 0.8])
    return vi_map.replace(keypoints=vi_map.keypoints.replace(uv_px=uv))


@pytest.mark.parametrize("jump_px", [8.0, 60.0])
def test_jumping_tracks_are_left_out(jump_px: float) -> None:
    truth = scene_map(noise=1.0)
    # of two or three observations even two points may be one
    swapped = np.flatnonzero(np.diff(truth.observation_start) >= 6)[::15]
    problem = build_segment_problem(jumping(truth, swapped, jump_px), OPTIONS)
    states, _ = solve(problem, OPTIONS)
    found = reject_tracks_chi2(problem, states, 0.01)
    used = problem.rejection.used_landmarks()
    ids = problem.vi_map.landmarks.id[problem.selection.landmarks]
    is_swapped = np.isin(ids[:, 0], truth.landmarks.id[swapped, 0])
    assert is_swapped.sum() > 5
    assert np.mean(used[is_swapped]) <= 0.1
    assert np.mean(used[~is_swapped]) >= 0.95
    assert found.noise_factor == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_the_noise_is_measured(factor: float) -> None:
    truth = scene_map(noise=1.0)
    sigma = truth.keypoints.sigma_px / factor
    told = truth.replace(keypoints=truth.keypoints.replace(sigma_px=sigma))
    problem = build_segment_problem(told, OPTIONS)
    states, _ = solve(problem, dataclasses.replace(OPTIONS, function_tolerance=1e-4))
    found = reject_tracks_chi2(problem, states, 0.01)
    assert found.noise_factor == pytest.approx(factor, rel=0.05)


def test_leaving_out_a_part_of_the_good_does_not_lower_the_noise() -> None:
    # what is left out has the largest residuals: the rest would make the noise look smaller
    problem = build_segment_problem(scene_map(noise=1.0), OPTIONS)
    states, _ = solve(problem, dataclasses.replace(OPTIONS, function_tolerance=1e-4))
    found = reject_tracks_chi2(problem, states, 0.3)
    assert 0.2 < found.inconsistent / len(problem.selection.landmarks) < 0.4
    assert found.noise_factor == pytest.approx(1.0, abs=0.05)


APART = dataclasses.replace(EXACT, min_shared_landmarks=10**6)
ROWS = np.concatenate([np.arange(0, 30), np.arange(40, 61)])


def scaled(problem: SegmentProblem, partition: int, path: float, distance: float) -> States:
    """Make a partition's path and its landmarks' distances so many times what they are."""
    states = problem.states
    own = np.flatnonzero(problem.partition == partition)
    T_G_I, p_G = np.array(states.T_G_I), np.array(states.p_G)
    vi_map, selection = problem.vi_map, problem.selection
    vertex = vi_map.keypoint_vertex[selection.keypoints]
    landmark = np.searchsorted(selection.landmarks, vi_map.keypoints.landmark[selection.keypoints])
    seen = np.unique(landmark[np.isin(vertex, own)])
    middle = T_G_I[own[0], 4:]
    T_G_I[own, 4:] = middle + path * (T_G_I[own, 4:] - middle)
    p_G[seen] = middle + distance * (p_G[seen] - middle)
    return dataclasses.replace(states, T_G_I=T_G_I, p_G=p_G)


@pytest.mark.parametrize(
    ("path", "distance", "lost"),
    [
        (1.0, 1.0, []),
        (0.05, 0.05, [1]),
        (20.0, 20.0, [1]),
        # what drift added to a slow path goes, and the landmarks stay where they were
        (0.3, 1.0, []),
    ],
)
def test_a_partition_that_shrinks_as_a_whole_is_found(
    path: float, distance: float, lost: list[int]
) -> None:
    problem = build_segment_problem(extract_submap(scene_map(vertices=61), ROWS), APART)
    after = scaled(problem, 1, path, distance)
    assert partitions_without_scale(problem, after, problem).tolist() == lost


def test_what_is_left_out_is_named_and_does_not_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    start = extract_submap(uncalibrated(scene_map(vertices=61)), ROWS)

    def second_is_lost(problem: SegmentProblem, *_: object) -> np.ndarray:
        return np.arange(1, problem.num_partitions)

    monkeypatch.setattr(module, "partitions_without_scale", second_is_lost)
    result, report = calibrate(start, APART)
    # the scene begins at 0 s and has five vertices a second
    assert [one.split(", ")[1] for one in report.without_scale] == ["8.0 to 12.0 s"]
    assert report.partitions == 1
    alone, _ = calibrate(extract_submap(start, np.arange(30)), APART)
    np.testing.assert_allclose(result.change, alone.change, atol=1e-9)


def test_nothing_is_returned_when_too_little_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    start = extract_submap(uncalibrated(scene_map(vertices=61)), np.r_[np.arange(0, 4), 10:61])

    def second_is_lost(problem: SegmentProblem, *_: object) -> np.ndarray:
        return np.arange(1, problem.num_partitions)

    monkeypatch.setattr(module, "partitions_without_scale", second_is_lost)
    few = dataclasses.replace(OPTIONS, min_shared_landmarks=10**6)
    with pytest.raises(EstimationError, match=r"not excited.*without mission .*lengths are lost"):
        calibrate(start, few)


def test_parallax_does_not_grow_where_landmarks_are_estimated_too_near() -> None:
    vi_map = scene_map(vertices=31)
    rows = np.arange(0, len(vi_map.landmarks), 4)
    home = vi_map.T_G_I[vi_map.landmarks.vertex[rows], 4:]
    near = with_p_G(vi_map, rows, home + 0.3 * (vi_map.p_G[rows] - home))
    before, after = parallax_rad(vi_map)[rows], parallax_rad(near)[rows]
    # by distance alone it would grow by 3.3
    assert np.median(after / before) <= 1.5


def test_groups_of_which_nothing_is_estimated_keep_no_segments() -> None:
    options = dataclasses.replace(OPTIONS, states="intrinsics,extrinsics_rotation")
    assert set(options.grouping()) == {"camera", "extrinsics"}
    database, _ = collect(scene_map(vertices=61, noise=1.0), options)
    assert set(database.tables) == {"camera", "extrinsics"}
    with pytest.raises(UserError, match="something is"):
        dataclasses.replace(options, groups="imu").grouping()
