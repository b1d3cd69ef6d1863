import dataclasses

import numpy as np
import pytest

from maplab_py.algorithms.landmarks.options import LandmarkQualityOptions
from maplab_py.algorithms.landmarks.quality import evaluate_quality
from maplab_py.algorithms.landmarks.triangulation import retriangulate
from maplab_py.algorithms.loop_closure.features import findable_landmarks, map_features
from maplab_py.algorithms.summary.options import SummaryMapOptions
from maplab_py.algorithms.summary.summary import landmark_covariances, make_summary_map
from maplab_py.errors import EstimationError
from maplab_py.vimap import IdIndex, VIMap
from tests.simulation.small import SMALL, simulated
from tests.support.noiseless import without_noise


@pytest.fixture(scope="module")
def vi_map() -> VIMap:
    options = LandmarkQualityOptions(min_observers=3, min_observation_angle_deg=1.0)
    return evaluate_quality(simulated().maps[0], options)[0]


def test_a_summary_holds_the_good_landmarks_as_seen_from_g(vi_map):
    options = SummaryMapOptions(descriptor_step=0.0, position_step_m=0.0, landmark_ids=True)
    summary = make_summary_map(vi_map, options)
    findable = findable_landmarks(vi_map)
    rows = IdIndex(vi_map.landmarks.id).rows(summary.landmark_id)
    np.testing.assert_array_equal(np.sort(rows), np.flatnonzero(findable))
    np.testing.assert_allclose(summary.p_G, vi_map.p_G[rows], atol=1e-5)
    observers = IdIndex(vi_map.vertices.id).rows(summary.observer_id)
    np.testing.assert_allclose(summary.p_G_observer, vi_map.T_G_I[observers, 4:], atol=1e-5)
    pairs = {
        (int(a), int(b))
        for a, b in zip(rows[summary.landmark], observers[summary.observer], strict=True)
    }
    seen = vi_map.observations
    landmark = vi_map.keypoints.landmark[seen]
    vertex = vi_map.keypoint_vertex[seen]
    expected = {(int(a), int(b)) for a, b in zip(landmark, vertex, strict=True) if findable[a]}
    assert pairs <= expected
    assert len(pairs) > 0.99 * len(expected)


def test_descriptors_stay_with_landmark_and_observer(vi_map):
    options = SummaryMapOptions(descriptor_step=0.0, landmark_ids=True)
    summary = make_summary_map(vi_map, options)
    assert np.all(np.diff(summary.landmark.astype(np.int64)) >= 0)
    features, _ = map_features(vi_map, np.arange(len(vi_map.missions)))
    landmark = IdIndex(vi_map.landmarks.id).rows(summary.landmark_id)[summary.landmark]
    vertex = IdIndex(vi_map.vertices.id).rows(summary.observer_id)[summary.observer]
    known = {
        (label, vertex, point.tobytes())
        for label, vertex, point in zip(
            features.descriptors.label.tolist(),
            features.vertex.tolist(),
            features.descriptors.projected,
            strict=True,
        )
    }
    rows = zip(landmark.tolist(), vertex.tolist(), summary.descriptors, strict=True)
    assert all((row, seer, point.tobytes()) in known for row, seer, point in rows)


def test_neighbours_in_space_follow_each_other(vi_map):
    p_G = make_summary_map(vi_map, SummaryMapOptions()).p_G
    shuffled = np.random.default_rng(0).permutation(p_G)
    step, random_step = (
        np.median(np.linalg.norm(np.diff(p, axis=0), axis=1)) for p in (p_G, shuffled)
    )
    assert step < 0.25 * random_step


def test_rounded_descriptors_are_near_the_exact_ones(vi_map):
    exact = make_summary_map(vi_map, SummaryMapOptions(descriptor_step=0.0))
    rounded = make_summary_map(vi_map, SummaryMapOptions())
    assert np.abs(exact.descriptors - rounded.descriptors).max() <= 1.0 / 64.0 + 1e-5
    assert np.all(rounded.descriptors * 32.0 == np.round(rounded.descriptors * 32.0))


def test_rounded_positions_are_near_the_exact_ones(vi_map):
    exact = make_summary_map(vi_map, SummaryMapOptions(position_step_m=0.0))
    rounded = make_summary_map(vi_map, SummaryMapOptions())
    for name in ("p_G", "p_G_observer"):
        difference = np.abs(getattr(exact, name) - getattr(rounded, name))
        assert 0.0 < difference.max() <= 0.5 / 1024.0 + 1e-5


def test_covariances_are_written_when_asked_for(vi_map):
    summary = make_summary_map(vi_map, SummaryMapOptions(covariances=True))
    assert summary.landmark_covariance is not None
    assert np.linalg.eigvalsh(summary.landmark_covariance.astype(np.float64)).min() > 0.0


def test_ids_of_landmarks_are_written_when_asked_for(vi_map):
    assert make_summary_map(vi_map, SummaryMapOptions()).landmark_id is None
    assert make_summary_map(vi_map, SummaryMapOptions()).observer_id is not None


def test_observations_can_be_limited(vi_map):
    options = SummaryMapOptions(max_observations_per_landmark=3)
    few = make_summary_map(vi_map, options)
    whole = make_summary_map(vi_map, dataclasses.replace(options, max_observations_per_landmark=0))
    assert few.landmark_covariance is None
    counts, before = np.bincount(few.landmark), np.bincount(whole.landmark)
    np.testing.assert_array_equal(counts, np.minimum(before, 3))


def test_covariances_tell_how_far_landmarks_err():
    """Errors of landmarks seen from true poses, whitened by their covariances, are of unit size."""
    true_poses = dataclasses.replace(SMALL, drift=without_noise(SMALL).drift)
    data = simulated(true_poses)
    vi_map = data.maps[0]
    baseframes = vi_map.baseframes.replace(T_G_M=data.truth.T_G_M[:1])
    vi_map, _ = retriangulate(vi_map.replace(baseframes=baseframes), LandmarkQualityOptions())
    features, _ = map_features(vi_map, np.array([0]))
    covariance = landmark_covariances(vi_map, features)
    row = IdIndex(data.truth.landmark_id).rows(vi_map.landmarks.id)
    error = data.truth.point_G[data.truth.landmark_point[row]] - vi_map.p_G
    well = np.diff(vi_map.observation_start) >= 5
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)[well]
    # the median of chi-squared with three degrees of freedom is 2.37
    assert 1.5 < np.median(nees) < 4.0


def test_a_map_without_good_landmarks_has_no_summary(vi_map):
    bad = vi_map.landmarks.replace(quality=np.ones(len(vi_map.landmarks)))
    with pytest.raises(EstimationError, match="good landmark"):
        make_summary_map(vi_map.replace(landmarks=bad), SummaryMapOptions())
