import numpy as np
import pytest

from maplab_py.algorithms.landmarks.options import InvalidObservationOptions, LandmarkQualityOptions
from maplab_py.algorithms.landmarks.quality import evaluate_quality, reset_quality
from maplab_py.algorithms.landmarks.removal import remove_bad, remove_invalid_observations
from maplab_py.algorithms.landmarks.tracks import init_tracks
from maplab_py.algorithms.landmarks.triangulation import retriangulate
from maplab_py.errors import FlagError
from maplab_py.vimap import LandmarkQuality, VIMap
from maplab_py.vimap.consistency import check_consistency
from maplab_py.vimap.edits import remove_landmarks, with_p_G
from tests.vimap.builders import walk_map

OPTIONS = LandmarkQualityOptions(min_observers=10)


def disturbed(m: VIMap, sigma_m: float) -> VIMap:
    noise = np.random.default_rng(5).normal(size=m.p_G.shape) * sigma_m
    return with_p_G(m, np.arange(len(m.landmarks)), m.p_G + noise)


def test_retriangulation_restores_every_seen_landmark():
    m = walk_map()
    result, report = retriangulate(disturbed(m, 5.0), OPTIONS)
    seen = np.diff(m.observation_start) >= 2
    assert report.triangulated == np.count_nonzero(seen)
    assert report.too_few_observations == np.count_nonzero(~seen)
    np.testing.assert_allclose(result.p_G[seen], m.p_G[seen], atol=1e-6)
    np.testing.assert_array_equal(result.landmarks.vertex, m.landmarks.vertex)


def test_good_needs_observers_angle_and_place():
    m = walk_map()
    judged, report = evaluate_quality(m, OPTIONS)
    good = judged.landmarks.quality == LandmarkQuality.GOOD
    assert 0 < report.good < len(m.landmarks)
    assert np.all(np.diff(m.observation_start)[good] >= 10)
    row = int(np.flatnonzero(good)[0])
    behind = with_p_G(m, [row], 2.0 * m.T_G_M[0, 4:] - m.p_G[[row]] - [0.0, 0.0, 20.0])
    worse, report_behind = evaluate_quality(behind, OPTIONS)
    assert report_behind.good == report.good - 1
    assert report_behind.too_near_or_behind >= 1
    strict = LandmarkQualityOptions(min_observers=10, max_reprojection_error_px=1.0)
    assert evaluate_quality(disturbed(m, 1.0), strict)[1].too_large_error > 0
    assert evaluate_quality(m, strict)[1].too_large_error == 0
    assert len(worse.landmarks) == len(m.landmarks)


def test_bad_landmarks_go_and_quality_can_be_reset():
    judged, report = evaluate_quality(walk_map(), OPTIONS)
    left, removal = remove_bad(judged)
    assert removal.landmarks_removed == report.bad
    assert len(left.landmarks) == report.good
    assert check_consistency(left).errors == ()
    fresh, after = reset_quality(judged)
    assert after.unknown == len(fresh.landmarks)
    assert not np.any(fresh.landmarks.quality)


def test_tracks_become_the_landmarks_they_were():
    m = walk_map()
    gone = remove_landmarks(m, np.ones(len(m.landmarks), dtype=bool))
    again, report = init_tracks(gone, OPTIONS)
    enough = np.diff(m.observation_start) >= 2
    assert report.landmarks_added == np.count_nonzero(enough)
    assert check_consistency(again).errors == ()
    observing = again.observations
    true = m.p_G[m.keypoints.landmark[observing]]
    np.testing.assert_allclose(again.p_G[again.keypoints.landmark[observing]], true, atol=1e-6)
    assert init_tracks(again, OPTIONS)[1].landmarks_added == 0
    same, _ = init_tracks(gone, OPTIONS)
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


@pytest.mark.parametrize(
    "values",
    [
        {"min_observers": -1},
        {"min_observation_angle_deg": 200.0},
        {"min_distance_from_closest_observer": 50.0},
    ],
)
def test_options_out_of_range_are_refused(values):
    with pytest.raises(FlagError):
        LandmarkQualityOptions(**values)
