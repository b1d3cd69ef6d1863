"""The calibration against truth: exact without noise, honest about its errors with it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from maplab_py.algorithms.self_calibration.calibration import calibrate
from maplab_py.algorithms.self_calibration.comparison import compare
from maplab_py.algorithms.self_calibration.device import device_of
from maplab_py.algorithms.self_calibration.estimation.problem import build_segment_problem
from maplab_py.algorithms.self_calibration.segments.splitting import (
    extract_submap,
    split_into_segments,
)
from maplab_py.algorithms.self_calibration.uncertainty import Verdict
from maplab_py.errors import EstimationError
from maplab_py.sensors import Distortion
from maplab_py.vimap.edits import with_new_ids
from maplab_py.vimap.stacking import stack
from tests.algorithms.self_calibration.scenes import EXACT, OPTIONS, scene_map, uncalibrated


@pytest.mark.parametrize("distortion", [Distortion.FOV, Distortion.RADTAN])
def test_without_noise_every_parameter_returns(distortion: Distortion) -> None:
    truth = scene_map(distortion=distortion)
    result, _ = calibrate(uncalibrated(truth), EXACT)
    ids = device_of(truth)
    compared = compare(truth.sensors, ids, result.sensors, ids)
    for one in compared.parameters:
        assert abs(one.difference) <= 1e-6 * max(1.0, abs(one.first)), one


def test_only_the_missions_that_were_asked_for_take_part() -> None:
    start = uncalibrated(scene_map())
    # another device's: it would spoil the calibration
    shaken = start.keypoints.uv_px + np.random.default_rng(1).normal(
        0.0, 20.0, start.keypoints.uv_px.shape
    )
    other = with_new_ids(start.replace(keypoints=start.keypoints.replace(uv_px=shaken)))
    result, report = calibrate(stack(other, start), EXACT, missions=np.array([1]))
    alone, _ = calibrate(start, EXACT)
    assert report.keyframes == len(start.vertices)
    np.testing.assert_allclose(result.change, alone.change, atol=1e-8)


def test_without_noise_segments_alone_are_enough() -> None:
    truth = scene_map(vertices=61)
    start = uncalibrated(truth)
    rows = split_into_segments(start, None, 20)
    result, report = calibrate(extract_submap(start, np.concatenate([rows[0], rows[2]])), EXACT)
    assert report.gaps == 1
    ids = device_of(truth)
    compared = compare(truth.sensors, ids, result.sensors, ids)
    assert (
        max(abs(one.difference) / max(1.0, abs(one.first)) for one in compared.parameters) <= 1e-6
    )


def error_and_covariance(seed: int) -> tuple[np.ndarray, np.ndarray]:
    truth = scene_map(noise=1.0, seed=seed)
    # no prior: the device's deviations are the same in all seeds, so it would shrink the errors
    options = dataclasses.replace(EXACT, num_iterations=30, function_tolerance=1e-7)
    result, _ = calibrate(uncalibrated(truth, seed), options)
    true = build_segment_problem(truth, options).states.blocks
    return result.parameters.difference(result.blocks, true), result.uncertainty.formal


@pytest.mark.slow
def test_errors_are_as_large_as_announced() -> None:
    seeds, count, total = 50, 0, 0.0
    normalised = []
    for seed in range(1, seeds + 1):
        error, covariance = error_and_covariance(seed)
        count = len(error)
        total += float(error @ np.linalg.solve(covariance, error))
        normalised.append(error / np.sqrt(np.diag(covariance)))
    # the mean of a chi-square over 50 seeds: two-sided 95 %
    assert abs(total / seeds - count) <= 1.96 * np.sqrt(2.0 * count / seeds)
    bias = np.mean(normalised, axis=0)
    # 26 means of 50 have a deviation of 0.14 each: the root mean square tells of a common bias
    assert np.sqrt(np.mean(bias**2)) <= 0.3


def test_report_says_what_changed_and_how_certain_it_is() -> None:
    result, report = calibrate(uncalibrated(scene_map(noise=1.0)), OPTIONS_ALL)
    named = {one.parameter: one for one in report.parameters}
    assert len(named) == len(result.parameters) == 26
    focal = named["camera focal length u"]
    assert focal.after == pytest.approx(310.0, abs=5.0 * focal.sigma)
    assert focal.change_in_sigmas == pytest.approx((focal.after - focal.before) / focal.sigma)
    assert 0.0 < focal.sigma < result.parameters.prior_sigma[list(named).index(focal.parameter)]
    assert report.cost_after < report.cost_before


OPTIONS_ALL = dataclasses.replace(OPTIONS, keep_unobservable_at_prior=True)


def test_standing_still_is_refused_with_names() -> None:
    still = standing()
    with pytest.raises(EstimationError, match="not excited") as caught:
        calibrate(still, OPTIONS)
    assert "--sc_keep_unobservable_at_prior" in str(caught.value)


def test_unobservable_directions_stay_at_their_prior() -> None:
    result, report = calibrate(standing(), OPTIONS_ALL)
    assert len(report.unobservable) >= 8
    moved = np.abs(result.change) / result.parameters.prior_sigma
    not_excited = Verdict.NOT_EXCITED.text()
    unknown = [k for k, one in enumerate(report.parameters) if one.verdict == not_excited]
    assert unknown
    assert moved[unknown].max() <= 0.2


def standing():
    """The first vertex again and again: what it sees and feels does not change."""
    truth = scene_map()
    v, imu = truth.vertices, truth.imu_samples
    first = np.zeros(len(v), dtype=int)
    own = np.flatnonzero(truth.keypoint_vertex == 0)
    count = len(v)
    keypoints = truth.keypoints.take(np.tile(own, count))
    samples = np.tile(imu.accel_gyro[0] * [1, 1, 1, 0, 0, 0], (len(imu), 1))
    samples[:, 3:] = v.gyro_bias[0]
    return truth.replace(
        vertices=v.replace(
            T_M_I=v.T_M_I[first],
            v_M=np.zeros((count, 3)),
            gyro_bias=v.gyro_bias[first],
            accel_bias=v.accel_bias[first],
        ),
        frames=truth.frames.replace(keypoint_count=np.full(count, len(own))),
        keypoints=keypoints,
        imu_samples=imu.replace(accel_gyro=samples),
    )
