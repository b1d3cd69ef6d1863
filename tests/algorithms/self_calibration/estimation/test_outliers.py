"""Tracks that jump are found, good ones stay, and the noise is measured on the way."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from maplab_py.algorithms.self_calibration.estimation.problem import build_segment_problem
from maplab_py.algorithms.self_calibration.estimation.solution import reject_tracks_chi2, solve
from maplab_py.vimap import VIMap
from tests.algorithms.self_calibration.scenes import OPTIONS, scene_map


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
