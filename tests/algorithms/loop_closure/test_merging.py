from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from maplab_py.algorithms.landmarks.keypoint_rays import landmark_covariance
from maplab_py.algorithms.loop_closure import merging
from maplab_py.algorithms.loop_closure.merging import compare_landmarks
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.workflow import close_loops, search_loops
from maplab_py.geometry import se3
from maplab_py.sensors.projection import project
from maplab_py.vimap import VIMap
from tests.algorithms.loop_closure.rooms import CAMERA, T_I_C, Walk, make_map

TWICE = [Walk(room=1), Walk(room=1, start_s=60.0)]
OPTIONS = LoopClosureOptions()


def matches(vi_map):
    """Return the accepted closures and, for each of their matches, its closure and two landmarks."""
    closures = search_loops(vi_map)[0].closures
    closures = closures.take(np.flatnonzero(closures.accepted))
    closure = np.repeat(np.arange(len(closures)), np.diff(closures.start))
    return closures, closure, vi_map.keypoints.landmark[closures.keypoint].astype(np.int64)


def test_covariances_are_those_of_least_squares_over_the_keypoints():
    vi_map, _ = make_map(TWICE)
    landmarks = np.array([3, 40, 117])
    sigma_px, step = 1.5, 1e-5
    for landmark, covariance in zip(
        landmarks, landmark_covariance(vi_map, landmarks, sigma_px), strict=True
    ):
        keypoints = np.flatnonzero(vi_map.keypoints.landmark == landmark)
        T_C_G = se3.inverse(se3.compose(vi_map.T_G_I[vi_map.keypoint_vertex[keypoints]], T_I_C))
        J = np.empty((len(keypoints), 2, 3))
        for axis in range(3):
            move = step * np.eye(3)[axis]
            ahead, back = (
                project(CAMERA, se3.transform(T_C_G, vi_map.p_G[landmark] + sign * move))[0]
                for sign in (1.0, -1.0)
            )
            J[:, :, axis] = (ahead - back) / (2.0 * step)
        expected = np.linalg.inv(np.einsum("nia,nib->ab", J, J) / sigma_px**2)
        # a ray's error is taken as round in angle, the image's as round in pixels
        ratio = np.linalg.eigvals(np.linalg.solve(expected, covariance)).real
        assert np.all((ratio > 0.7) & (ratio < 1.4))


def test_distances_of_one_point_are_as_large_as_the_noise_says(monkeypatch):
    monkeypatch.setattr(merging, "_POSE_DRIFT", 0.0)  # poses are exact here
    vi_map, _ = make_map(TWICE, noise_px=1.0)
    rng = np.random.default_rng(5)
    covariance = landmark_covariance(vi_map, np.arange(len(vi_map.landmarks)), 1.0)
    noise = np.einsum(
        "nij,nj->ni", np.linalg.cholesky(covariance), rng.normal(size=(len(covariance), 3))
    )
    disturbed = moved(vi_map, noise)
    closures, closure, source = matches(disturbed)
    found = compare_landmarks(disturbed, closures, closure, source, closures.landmark, 1.0)
    assert 1.9 < np.median(found.squared_sigmas) < 2.9  # three degrees of freedom: 2.37
    assert np.mean(found.squared_sigmas > 16.0) < 0.01


def moved(vi_map: VIMap, shift_G: np.ndarray) -> VIMap:
    """Return the map with its landmarks moved by (L, 3)."""
    T_I_G = se3.inverse(vi_map.T_G_I[vi_map.landmarks.vertex])
    p_I = se3.transform(T_I_G, vi_map.p_G + shift_G)
    return vi_map.replace(landmarks=vi_map.landmarks.replace(p_I=p_I))


def test_landmarks_that_their_rays_keep_apart_are_not_merged():
    vi_map, _ = make_map(TWICE)
    closures, _, source = matches(vi_map)
    rows, votes = np.unique(source, return_counts=True)
    chosen = rows[votes >= 4][:10]
    shift = np.zeros((len(vi_map.landmarks), 3))
    shift[chosen, 2] = 0.28  # 3 degrees aside of where their keypoints see them
    tampered = moved(vi_map, shift)
    far = dataclasses.replace(OPTIONS, max_merge_sigma=1e6)
    _, before = merging.merge_verified_landmarks(tampered, closures, far)
    merged, now = merging.merge_verified_landmarks(tampered, closures, OPTIONS)
    assert np.isin(chosen, np.union1d(before.first, before.second)).all()
    assert not np.isin(chosen, np.union1d(now.first, now.second)).any()
    assert now.refused[merging.UNLIKELY] >= len(chosen)
    assert merging.UNLIKELY not in before.refused
    assert len(vi_map.landmarks) - len(merged.landmarks) == now.landmarks_merged
    assert now.landmarks_merged == before.landmarks_merged - len(chosen)


@pytest.mark.parametrize("sigma", [0.05, 4.0])
def test_the_report_says_how_many_were_refused(sigma):
    vi_map, _ = make_map(TWICE, noise_px=1.0)
    _, report = close_loops(vi_map, dataclasses.replace(OPTIONS, max_merge_sigma=sigma))
    assert (report.merges_refused.get(merging.UNLIKELY, 0) > 20) == (sigma < 1.0)
