"""Landmarks are judged by the geometry of their rays, not by the number of frames."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from maplab_py.algorithms.gate import any_failed
from maplab_py.algorithms.keyframing.heuristic import keyframe
from maplab_py.algorithms.keyframing.options import KeyframingOptions
from maplab_py.algorithms.landmarks.options import LandmarkQualityOptions
from maplab_py.algorithms.landmarks.quality import (
    criteria,
    evaluate_quality,
    evaluate_unknown_quality,
    mostly_bad,
    predicted_sigma,
    reset_quality,
)
from maplab_py.algorithms.landmarks.sightings import rays_in_G
from maplab_py.algorithms.loop_closure.workflow import close_loops
from maplab_py.algorithms.vi_optimization.optimization import optimize
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.vimap import LandmarkQuality, VIMap
from maplab_py.vimap.edits import remove_observations, with_p_G
from maplab_py.vimap.table import ragged_rows
from tests.algorithms.loop_closure.rooms import Walk, make_map

DEFAULT = LandmarkQualityOptions()
TWICE = [Walk(room=1), Walk(room=1, start_s=60.0, drift=(0.02, -0.01, 0.005, 0.001))]


def with_two_observers(vi_map: VIMap, *, far_apart: bool) -> tuple[VIMap, np.ndarray]:
    """Return the map whose landmarks keep two observations, and those that had many.

    The room's walk goes sideways: the first and the last view differ most, the first two hardly.
    """
    counts = np.diff(vi_map.observation_start)
    many = np.flatnonzero(counts >= 8)
    rows = ragged_rows(vi_map.observation_start, many)
    last = np.cumsum(counts[many]) - 1
    first = last - counts[many] + 1
    kept = np.concatenate([first, last if far_apart else first + 1])
    removed = np.delete(vi_map.observations[rows], kept)
    return remove_observations(vi_map, removed), many


def is_good(vi_map: VIMap, landmarks: np.ndarray, options: LandmarkQualityOptions) -> np.ndarray:
    return ~any_failed(criteria(vi_map, landmarks, options))


def fails(vi_map: VIMap, landmarks: np.ndarray, criterion: str) -> np.ndarray:
    gates = criteria(vi_map, landmarks, DEFAULT)
    return any_failed([gate for gate in gates if gate.verdict == criterion])


def test_two_observers_at_a_wide_angle_are_enough():
    vi_map, landmarks = with_two_observers(make_map(TWICE)[0], far_apart=True)
    assert np.all(np.diff(vi_map.observation_start)[landmarks] == 2)
    assert len(landmarks) > 100
    assert np.mean(is_good(vi_map, landmarks, DEFAULT)) > 0.9


@pytest.mark.parametrize("coordinate", [1e12, 1e160, -1e300])
def test_landmarks_at_infinity_are_bad(coordinate):
    vi_map, landmarks = with_two_observers(make_map(TWICE)[0], far_apart=True)
    far = with_p_G(vi_map, landmarks, np.full((len(landmarks), 3), coordinate))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not is_good(far, landmarks, DEFAULT).any()


def test_a_landmark_at_its_camera_is_bad():
    vi_map, landmarks = with_two_observers(make_map(TWICE)[0], far_apart=True)
    keypoints = vi_map.observations[vi_map.observation_start[landmarks]]
    origins = rays_in_G(vi_map, keypoints)[0]
    for offset_m in (0.0, 1e-9, 1e-160):
        near = with_p_G(vi_map, landmarks, origins + offset_m)
        assert not is_good(near, landmarks, DEFAULT).any()


def test_two_observers_side_by_side_are_not():
    slow = [Walk(room=1, vertices=40)]
    vi_map, landmarks = with_two_observers(make_map(slow)[0], far_apart=False)
    assert np.mean(fails(vi_map, landmarks, "too_uncertain")) > 0.9
    assert not fails(vi_map, landmarks, "too_few_observers").any()
    unlimited = LandmarkQualityOptions(max_relative_sigma=-1.0, min_observation_angle_deg=0.0)
    assert is_good(vi_map, landmarks, unlimited).all()


def test_more_rays_of_a_narrow_view_count():
    """Eight rays over a few degrees know more than two of them."""
    vi_map, _ = make_map(TWICE)
    pair, landmarks = with_two_observers(vi_map, far_apart=True)
    assert np.all(predicted_sigma(vi_map, landmarks) < predicted_sigma(pair, landmarks))


def test_a_landmark_beside_its_rays_is_uncertain_and_one_wrong_keypoint_does_not_matter():
    vi_map, _ = make_map(TWICE)
    landmarks = np.flatnonzero(np.diff(vi_map.observation_start) >= 8)
    usual = predicted_sigma(vi_map, landmarks)
    beside = with_p_G(vi_map, landmarks, vi_map.p_G[landmarks] + [0.0, 1.0, 0.0])
    assert np.all(predicted_sigma(beside, landmarks) > 10.0 * usual)
    assert fails(beside, landmarks, "too_uncertain").all()
    uv = vi_map.keypoints.uv_px.copy()
    first = vi_map.observations[vi_map.observation_start[landmarks]]
    uv[first] += 100.0
    wrong = vi_map.replace(keypoints=vi_map.keypoints.replace(uv_px=uv))
    np.testing.assert_allclose(predicted_sigma(wrong, landmarks), usual, rtol=0.4)


def test_judging_again_keeps_what_merging_has_learned():
    vi_map, _ = make_map([*TWICE[:1], Walk(room=1, mission=1, drift=(0.02, 0.01, 0.0, 0.002))])
    merged, report = close_loops(reset_quality(vi_map)[0])
    assert report.landmarks_merged > 150
    seen_twice = np.zeros((len(merged.missions), len(merged.landmarks)), dtype=np.bool_)
    observed = merged.observations
    mission = merged.vertices.mission[merged.keypoint_vertex[observed]]
    seen_twice[mission, merged.keypoints.landmark[observed]] = True
    both = seen_twice.all(axis=0)
    assert np.all(merged.landmarks.quality[both] == LandmarkQuality.GOOD)
    again, _ = evaluate_quality(merged, DEFAULT)
    assert np.mean(again.landmarks.quality[both] == LandmarkQuality.GOOD) > 0.99


def test_a_note_says_why_most_landmarks_are_bad():
    vi_map, _ = make_map(TWICE)
    assert evaluate_quality(vi_map, DEFAULT)[1].note == ""
    _, report = evaluate_quality(vi_map, LandmarkQualityOptions(min_observers=100))
    assert report.note.startswith(f"{report.bad} of {report.landmarks} landmarks are bad")
    assert f"{report.too_few_observers} with too few observers" in report.note
    poor, _ = with_two_observers(vi_map, far_apart=False)
    _, notes = evaluate_unknown_quality(reset_quality(poor)[0])
    assert "evaluated the quality" in notes[0]
    assert "too uncertain" in notes[1]
    assert mostly_bad(5, 10, {"too_far": 5}) == ""
    assert mostly_bad(0, 0, {}) == ""


def test_keyframing_and_optvi_say_when_they_leave_most_landmarks_bad():
    vi_map, _ = make_map([Walk(room=1)])
    ends = np.isin(vi_map.keypoint_vertex, [0, len(vi_map.vertices) - 1])
    few = KeyframingOptions(
        distance_threshold_m=100.0, rotation_threshold_deg=180.0, every_nth_vertex=100,
        min_shared_landmarks_obs=0,
    )  # fmt: skip
    two, report = keyframe(vi_map, few)
    assert report.vertices_after == 2
    _, blind = keyframe(remove_observations(vi_map, np.flatnonzero(ends)), few)
    assert blind.landmarks_undetermined > 0.9 * len(vi_map.landmarks)
    assert "fewer than two observations" in blind.note
    only_first = remove_observations(two, np.flatnonzero(two.keypoint_vertex == 1)[5:])
    options = VIOptimizationOptions(include_inertial=False, num_iterations=1)
    _, optimized = optimize(only_first, options)
    assert "landmarks are bad" in optimized.note
    all_, kept = keyframe(vi_map, KeyframingOptions(every_nth_vertex=1))
    assert kept.note == ""
    assert kept.landmarks_undetermined == 0
    assert optimize(all_, options)[1].note == ""


@pytest.mark.parametrize("sigma_px", [0.0, np.nan])
def test_keypoints_without_deviation_are_taken_as_usual_ones(sigma_px):
    vi_map, _ = make_map(TWICE)
    sigma = np.full(len(vi_map.keypoints), sigma_px)
    unknown = vi_map.replace(keypoints=vi_map.keypoints.replace(sigma_px=sigma))
    one = vi_map.replace(keypoints=vi_map.keypoints.replace(sigma_px=np.ones(len(sigma))))
    rows = np.arange(len(vi_map.landmarks))
    np.testing.assert_array_equal(predicted_sigma(unknown, rows), predicted_sigma(one, rows))
