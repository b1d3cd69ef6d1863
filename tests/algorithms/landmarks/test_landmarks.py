"""Landmarks: made, initialised, and judged by the geometry of their rays."""

import warnings

import numpy as np
import pytest

from maplab_py.algorithms.gate import any_failed
from maplab_py.algorithms.keyframing.heuristic import keyframe
from maplab_py.algorithms.keyframing.options import KeyframingOptions
from maplab_py.algorithms.landmarks import quality, sightings, tracks, triangulation
from maplab_py.algorithms.landmarks.options import InvalidObservationOptions, LandmarkQualityOptions
from maplab_py.algorithms.landmarks.removal import remove_bad, remove_invalid_observations
from maplab_py.algorithms.loop_closure.workflow import close_loops
from maplab_py.algorithms.vi_optimization.optimization import optimize
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.vimap import LandmarkQuality, VIMap, consistency, edits, ragged_rows
from tests.algorithms.loop_closure.rooms import Walk, make_map
from tests.vimap.builders import walk_map

OPTIONS = LandmarkQualityOptions(min_observers=10)


def disturbed(m: VIMap, sigma_m: float) -> VIMap:
    noise = np.random.default_rng(5).normal(size=m.p_G.shape) * sigma_m
    return edits.with_p_G(m, np.arange(len(m.landmarks)), m.p_G + noise)


def test_retriangulation_restores_every_seen_landmark():
    m = walk_map()
    result, report = triangulation.retriangulate(disturbed(m, 5.0), OPTIONS)
    seen = np.diff(m.observation_start) >= 2
    assert report.triangulated == np.count_nonzero(seen)
    assert report.too_few_observations == np.count_nonzero(~seen)
    np.testing.assert_allclose(result.p_G[seen], m.p_G[seen], atol=1e-6)
    np.testing.assert_array_equal(result.landmarks.vertex, m.landmarks.vertex)


def test_good_needs_observers_angle_and_place():
    m = walk_map()
    judged, report = quality.evaluate_quality(m, OPTIONS)
    good = judged.landmarks.quality == LandmarkQuality.GOOD
    assert 0 < report.good < len(m.landmarks)
    assert np.all(np.diff(m.observation_start)[good] >= 10)
    row = int(np.flatnonzero(good)[0])
    behind = edits.with_p_G(m, [row], 2.0 * m.T_G_M[0, 4:] - m.p_G[[row]] - [0.0, 0.0, 20.0])
    worse, report_behind = quality.evaluate_quality(behind, OPTIONS)
    assert report_behind.good == report.good - 1
    assert report_behind.too_near_or_behind >= 1
    strict = LandmarkQualityOptions(min_observers=10, max_reprojection_error_px=1.0)
    assert quality.evaluate_quality(disturbed(m, 1.0), strict)[1].too_large_error > 0
    assert quality.evaluate_quality(m, strict)[1].too_large_error == 0
    assert len(worse.landmarks) == len(m.landmarks)


def test_bad_landmarks_go_and_quality_can_be_reset():
    judged, report = quality.evaluate_quality(walk_map(), OPTIONS)
    left, removal = remove_bad(judged)
    assert removal.landmarks_removed == report.bad
    assert len(left.landmarks) == report.good
    assert consistency.check_consistency(left).errors == ()
    fresh, after = quality.reset_quality(judged)
    assert after.unknown == len(fresh.landmarks)
    assert not np.any(fresh.landmarks.quality)


def test_tracks_become_the_landmarks_they_were():
    m = walk_map()
    gone = edits.remove_landmarks(m, np.ones(len(m.landmarks), dtype=bool))
    again, report = tracks.init_tracks(gone, OPTIONS)
    enough = np.diff(m.observation_start) >= 2
    assert report.landmarks_added == np.count_nonzero(enough)
    assert consistency.check_consistency(again).errors == ()
    observing = again.observations
    true = m.p_G[m.keypoints.landmark[observing]]
    np.testing.assert_allclose(again.p_G[again.keypoints.landmark[observing]], true, atol=1e-6)
    assert tracks.init_tracks(again, OPTIONS)[1].landmarks_added == 0
    same, _ = tracks.init_tracks(gone, OPTIONS)
    np.testing.assert_array_equal(same.landmarks.id, again.landmarks.id)


def test_observations_that_contradict_are_detached_and_reborn():
    m = walk_map()
    clean, report = remove_invalid_observations(m, InvalidObservationOptions())
    assert report.behind_camera == report.too_large_error == report.twice_in_frame == 0
    np.testing.assert_array_equal(clean.keypoints.landmark, m.keypoints.landmark)
    a, b = np.argsort(np.diff(m.observation_start))[-2:]
    mixed = m.keypoints.landmark.copy()
    mixed[mixed == b] = a
    wrong = m.replace(keypoints=m.keypoints.replace(landmark=mixed))
    repaired, report = remove_invalid_observations(
        wrong, InvalidObservationOptions(max_reprojection_error_px=5.0)
    )
    assert report.twice_in_frame > 0
    assert report.landmarks_added == 1
    frame_pairs = np.stack([repaired.keypoint_frame, repaired.keypoints.landmark])
    frame_pairs = frame_pairs[:, repaired.keypoints.landmark >= 0]
    assert len(np.unique(frame_pairs, axis=1).T) == frame_pairs.shape[1]
    np.testing.assert_allclose(repaired.p_G[-1], m.p_G[b], atol=1e-6)


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
    return edits.remove_observations(vi_map, removed), many


def is_good(vi_map: VIMap, landmarks: np.ndarray, options: LandmarkQualityOptions) -> np.ndarray:
    return ~any_failed(quality.criteria(vi_map, landmarks, options))


def fails(vi_map: VIMap, landmarks: np.ndarray, criterion: str) -> np.ndarray:
    gates = quality.criteria(vi_map, landmarks, DEFAULT)
    return any_failed([gate for gate in gates if gate.verdict == criterion])


def test_two_observers_at_a_wide_angle_are_enough():
    vi_map, landmarks = with_two_observers(make_map(TWICE)[0], far_apart=True)
    assert np.all(np.diff(vi_map.observation_start)[landmarks] == 2)
    assert len(landmarks) > 100
    assert np.mean(is_good(vi_map, landmarks, DEFAULT)) > 0.9


@pytest.mark.parametrize("coordinate", [1e12, 1e160, -1e300])
def test_landmarks_at_infinity_are_bad(coordinate):
    vi_map, landmarks = with_two_observers(make_map(TWICE)[0], far_apart=True)
    far = edits.with_p_G(vi_map, landmarks, np.full((len(landmarks), 3), coordinate))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not is_good(far, landmarks, DEFAULT).any()


def test_a_landmark_at_its_camera_is_bad():
    vi_map, landmarks = with_two_observers(make_map(TWICE)[0], far_apart=True)
    keypoints = vi_map.observations[vi_map.observation_start[landmarks]]
    origins = sightings.rays_in_G(vi_map, keypoints)[0]
    for offset_m in (0.0, 1e-9, 1e-160):
        near = edits.with_p_G(vi_map, landmarks, origins + offset_m)
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
    assert np.all(
        quality.predicted_sigma(vi_map, landmarks) < quality.predicted_sigma(pair, landmarks)
    )


def test_a_landmark_beside_its_rays_is_uncertain_and_one_wrong_keypoint_does_not_matter():
    vi_map, _ = make_map(TWICE)
    landmarks = np.flatnonzero(np.diff(vi_map.observation_start) >= 8)
    usual = quality.predicted_sigma(vi_map, landmarks)
    beside = edits.with_p_G(vi_map, landmarks, vi_map.p_G[landmarks] + [0.0, 1.0, 0.0])
    assert np.all(quality.predicted_sigma(beside, landmarks) > 10.0 * usual)
    assert fails(beside, landmarks, "too_uncertain").all()
    uv = vi_map.keypoints.uv_px.copy()
    first = vi_map.observations[vi_map.observation_start[landmarks]]
    uv[first] += 100.0
    wrong = vi_map.replace(keypoints=vi_map.keypoints.replace(uv_px=uv))
    np.testing.assert_allclose(quality.predicted_sigma(wrong, landmarks), usual, rtol=0.4)


def test_judging_again_keeps_what_merging_has_learned():
    vi_map, _ = make_map([*TWICE[:1], Walk(room=1, mission=1, drift=(0.02, 0.01, 0.0, 0.002))])
    merged, report = close_loops(quality.reset_quality(vi_map)[0])
    assert report.landmarks_merged > 150
    seen_twice = np.zeros((len(merged.missions), len(merged.landmarks)), dtype=np.bool_)
    observed = merged.observations
    mission = merged.vertices.mission[merged.keypoint_vertex[observed]]
    seen_twice[mission, merged.keypoints.landmark[observed]] = True
    both = seen_twice.all(axis=0)
    assert np.all(merged.landmarks.quality[both] == LandmarkQuality.GOOD)
    again, _ = quality.evaluate_quality(merged, DEFAULT)
    assert np.mean(again.landmarks.quality[both] == LandmarkQuality.GOOD) > 0.99


def test_a_note_says_why_most_landmarks_are_bad():
    vi_map, _ = make_map(TWICE)
    assert quality.evaluate_quality(vi_map, DEFAULT)[1].note == ""
    _, report = quality.evaluate_quality(vi_map, LandmarkQualityOptions(min_observers=100))
    assert report.note.startswith(f"{report.bad} of {report.landmarks} landmarks are bad")
    assert f"{report.too_few_observers} with too few observers" in report.note
    poor, _ = with_two_observers(vi_map, far_apart=False)
    _, notes = quality.evaluate_unknown_quality(quality.reset_quality(poor)[0])
    assert "evaluated the quality" in notes[0]
    assert "too uncertain" in notes[1]
    assert quality.mostly_bad(5, 10, {"too_far": 5}) == ""
    assert quality.mostly_bad(0, 0, {}) == ""


def test_keyframing_and_optvi_say_when_they_leave_most_landmarks_bad():
    vi_map, _ = make_map([Walk(room=1)])
    ends = np.isin(vi_map.keypoint_vertex, [0, len(vi_map.vertices) - 1])
    few = KeyframingOptions(
        distance_threshold_m=100.0, rotation_threshold_deg=180.0, every_nth_vertex=100,
        min_shared_landmarks_obs=0,
    )  # fmt: skip
    two, report = keyframe(vi_map, few)
    assert report.vertices_after == 2
    _, blind = keyframe(edits.remove_observations(vi_map, np.flatnonzero(ends)), few)
    assert blind.landmarks_undetermined > 0.9 * len(vi_map.landmarks)
    assert "fewer than two observations" in blind.note
    only_first = edits.remove_observations(two, np.flatnonzero(two.keypoint_vertex == 1)[5:])
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
    np.testing.assert_array_equal(
        quality.predicted_sigma(unknown, rows), quality.predicted_sigma(one, rows)
    )


@pytest.mark.parametrize(
    "options",
    [
        LandmarkQualityOptions(),
        LandmarkQualityOptions(min_observers=50),
        LandmarkQualityOptions(min_observation_angle_deg=20.0, max_reprojection_error_px=0.5),
        LandmarkQualityOptions(max_distance_from_closest_observer=1.0),
    ],
)
def test_the_explanation_agrees_with_the_verdict(options: LandmarkQualityOptions) -> None:
    vi_map = walk_map()
    rows = np.arange(min(len(vi_map.landmarks), 12))
    gates = quality.criteria(vi_map, rows, options)
    good = ~any_failed(gates)
    for row in rows.tolist():
        report = quality.explain_landmark(vi_map, row, options)
        results = {c.flag: c.result for c in report.criteria}
        for gate in gates:
            if gate.applies[row]:
                assert (results[gate.flag] == "failed") == gate.failed[row]
        error = results["--elq_max_reprojection_error_px"]
        assert (error == "not checked") == (options.max_reprojection_error_px < 0.0)
        assert report.summary.endswith("good.") == good[row]
