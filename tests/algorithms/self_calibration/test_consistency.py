"""Tracks that jump are found, good ones stay, and the noise is measured on the way."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from maplab_py.algorithms.self_calibration.calibration import solve
from maplab_py.algorithms.self_calibration.consistency import keep_consistent
from maplab_py.algorithms.self_calibration.problem import pose
from maplab_py.progress import SILENT
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
    problem = pose(jumping(truth, swapped, jump_px), OPTIONS)
    states, _ = solve(problem, OPTIONS, SILENT)
    found = keep_consistent(problem.posed, states, 0.01)
    used = problem.posed.rejection.used_landmarks()
    ids = problem.posed.vi_map.landmarks.id[problem.posed.selection.landmarks]
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
    problem = pose(told, OPTIONS)
    states, _ = solve(problem, dataclasses.replace(OPTIONS, function_tolerance=1e-4), SILENT)
    found = keep_consistent(problem.posed, states, 0.01)
    assert found.noise_factor == pytest.approx(factor, rel=0.05)
