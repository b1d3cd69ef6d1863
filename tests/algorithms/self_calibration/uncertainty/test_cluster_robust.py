"""Deviations by tracks: as the formal ones for white noise, and as the errors where tracks drift."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from maplab_py.algorithms.self_calibration.calibration import Calibration, calibrate
from maplab_py.algorithms.self_calibration.estimation.problem import build_segment_problem
from maplab_py.algorithms.self_calibration.uncertainty import larger_covariance
from maplab_py.vimap import VIMap
from tests.algorithms.self_calibration.scenes import OPTIONS, scene_map, uncalibrated

PLAIN = dataclasses.replace(OPTIONS, loss="none", keep_unobservable_at_prior=True)


def drifting(vi_map: VIMap, sigma_px: float, seed: int) -> VIMap:
    """Add errors to all tracks that are alike in neighbouring images, and tell how large they are."""
    rng = np.random.default_rng(seed)
    start, rows = vi_map.observation_start, vi_map.observations
    error = rng.normal(0.0, sigma_px, (len(rows), 2))
    keep = 0.7
    for number in range(1, int(np.diff(start).max())):
        here = (start[:-1] + number)[np.diff(start) > number]
        error[here] = keep * error[here - 1] + np.sqrt(1.0 - keep**2) * error[here]
    keypoints = vi_map.keypoints
    uv = np.array(keypoints.uv_px)
    uv[rows] += error
    total = np.hypot(keypoints.sigma_px, sigma_px)
    return vi_map.replace(keypoints=keypoints.replace(uv_px=uv, sigma_px=total))


def formal(result: Calibration) -> np.ndarray:
    return result.uncertainty.formal_sigma


def test_white_noise_makes_no_difference() -> None:
    result, report = calibrate(uncalibrated(scene_map(noise=1.0, vertices=61)), PLAIN)
    ratio = result.uncertainty.cluster_robust_sigma / formal(result)
    assert 0.9 <= np.median(ratio) <= 1.1
    assert ratio.min() >= 0.8
    assert ratio.max() <= 1.25
    assert report.track_deviation_factor == np.median(ratio)
    announced = np.array([one.sigma for one in report.parameters])
    np.testing.assert_allclose(
        announced, np.maximum(formal(result), result.uncertainty.cluster_robust_sigma)
    )


@pytest.mark.slow
def test_errors_of_drifting_tracks_are_as_large_as_announced() -> None:
    normalised, ratio = [], []
    for seed in range(1, 7):
        truth = scene_map(noise=1.0, seed=seed, vertices=61)
        result, _ = calibrate(drifting(uncalibrated(truth, seed), 3.0, seed), PLAIN)
        true = build_segment_problem(truth, PLAIN).states.blocks
        camera = [n.startswith("camera") for n in result.parameters.names]
        error = result.parameters.difference(result.blocks, true)
        normalised.append((error / result.uncertainty.cluster_robust_sigma)[camera])
        ratio.append((result.uncertainty.cluster_robust_sigma / formal(result))[camera])
    assert np.median(ratio) >= 1.15
    # 11 parameters, correlated, 6 seeds
    assert 0.8 <= np.sqrt(np.mean(np.square(normalised))) <= 1.2


def test_the_larger_covariance_is_as_large_as_both() -> None:
    first, second = np.diag([1.0, 4.0, 9.0]), np.diag([2.0, 1.0, 9.0])
    np.testing.assert_allclose(larger_covariance(first, second), np.diag([2.0, 4.0, 9.0]))
    rng = np.random.default_rng(0)
    A, B = rng.normal(size=(2, 5, 8))
    first, second = A @ A.T, B @ B.T
    larger = larger_covariance(first, second)
    for one in (first, second):
        rest = np.linalg.eigvalsh(larger - one)
        assert rest.min() >= -1e-12 * rest.max()
        assert np.sum(np.abs(rest) <= 1e-12 * rest.max()) >= 1  # somewhere no larger
    np.testing.assert_allclose(larger, larger_covariance(second, first))
