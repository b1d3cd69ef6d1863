"""Deviations where tracks drift, and single segments: tested, scored, ranked and bridged."""

import dataclasses
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import chi2, kstest

from maplab_py.algorithms.self_calibration import pruning
from maplab_py.algorithms.self_calibration.calibration import Calibration, calibrate
from maplab_py.algorithms.self_calibration.estimation.parameters import Parameter, Parameters
from maplab_py.algorithms.self_calibration.estimation.problem import (
    bias_gaps,
    build_segment_problem,
    runs_of,
)
from maplab_py.algorithms.self_calibration.pruning import SegmentEstimate
from maplab_py.algorithms.self_calibration.reports import PrunedSegment
from maplab_py.algorithms.self_calibration.segments.database import SegmentDatabase
from maplab_py.algorithms.self_calibration.segments.selection import collect, evaluate
from maplab_py.algorithms.self_calibration.uncertainty import larger_covariance
from maplab_py.errors import EstimationError
from maplab_py.progress import SILENT
from maplab_py.sensors import Imu
from maplab_py.vimap import VIMap
from maplab_py.vimap.merge import merge_maps
from tests.algorithms.self_calibration.scenes import OPTIONS, nominal, scene_map, uncalibrated

AT_PRIOR = dataclasses.replace(OPTIONS, loss="none", keep_unobservable_at_prior=True)


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
    result, report = calibrate(uncalibrated(scene_map(noise=1.0, vertices=61)), AT_PRIOR)
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
        result, _ = calibrate(drifting(uncalibrated(truth, seed), 3.0, seed), AT_PRIOR)
        true = build_segment_problem(truth, AT_PRIOR).states.blocks
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


PLAIN = dataclasses.replace(OPTIONS, loss="none")  # a robust loss would measure the noise first
NOISES = [field.name for field in dataclasses.fields(Imu) if field.name.endswith("noise_density")]


@cache
def collected() -> SegmentDatabase:
    return collect(scene_map(noise=1.0), OPTIONS)[0]


def with_deviations(factor: float) -> SegmentDatabase:
    """Return the segments with other standard deviations of all measurements."""
    vi_map = collected().vi_map
    sensors = {
        key: dataclasses.replace(one, **{name: factor * getattr(one, name) for name in NOISES})
        if isinstance(one, Imu)
        else one
        for key, one in vi_map.sensors.sensors.items()
    }
    other = vi_map.replace(
        keypoints=vi_map.keypoints.replace(sigma_px=factor * vi_map.keypoints.sigma_px),
        sensors=dataclasses.replace(vi_map.sensors, sensors=sensors),
    )
    return dataclasses.replace(collected(), vi_map=other)


@cache
def total_distance(factor: float) -> float:
    database = with_deviations(factor)
    tested = pruning.test_segments(database, database.vi_map.sensors, PLAIN, 0.999, SILENT)
    assert [one.chi_square_per_freedom for one in tested] == pytest.approx(
        [1.0 / factor**2] * len(tested), rel=0.1
    )
    return sum(one.distance for one in tested)


def test_residuals_smaller_than_stated_do_not_shrink_the_covariance() -> None:
    # the covariance is sixteen times larger: so much smaller is the squared distance
    assert total_distance(4.0) < 0.1 * total_distance(1.0)


def test_residuals_larger_than_stated_enlarge_the_covariance() -> None:
    assert total_distance(0.25) < 1.6 * total_distance(1.0)


def test_distances_are_chi_squared_where_the_prior_holds_a_part() -> None:
    # data of covariance V and a prior of covariance P: the estimate moves by S V^-1 error
    rng = np.random.default_rng(3)
    sigma = np.array([0.05, 2.0, 0.01, 10.0])
    turn = np.linalg.qr(rng.normal(size=(4, 4)))[0]
    scale = np.diag(sigma)
    V = scale @ turn @ np.diag([0.02, 0.3, 0.8, 50.0]) @ turn.T @ scale
    S = np.linalg.inv(np.linalg.inv(V) + np.linalg.inv(scale**2))
    gain = S @ np.linalg.inv(V)
    parameters = Parameters(
        tuple(Parameter(f"{k}", "", "imu", "", 0, k, one) for k, one in enumerate(sigma))
    )
    found = [
        SegmentEstimate(parameters, gain @ error, S, S, 1.0).squared_distance()
        for error in rng.multivariate_normal(np.zeros(4), V, 4000, method="cholesky")
    ]
    assert {freedom for _, freedom in found} == {3}  # the prior knows the fourth direction better
    distances = np.array([distance for distance, _ in found])
    assert kstest(distances, chi2(3).cdf).pvalue > 0.01
    assert distances.mean() == pytest.approx(3.0, rel=0.05)


@pytest.mark.parametrize(("against", "is_refused"), [(1, False), (2, True), (3, True)])
def test_half_of_the_segments_are_no_majority(
    monkeypatch: pytest.MonkeyPatch, against: int, is_refused: bool
) -> None:
    # the decision alone: what calibrating and testing give is stated
    stated = [PrunedSegment("", "", 1.0, 1.0, 1.0, number < against) for number in range(4)]
    device = SimpleNamespace(sensors=collected().vi_map.sensors)
    monkeypatch.setattr(pruning, "calibrate", lambda *_, **__: (device, None))
    monkeypatch.setattr(pruning, "test_segments", lambda *_: stated)
    if is_refused:
        with pytest.raises(EstimationError, match=f"{against} of 4 segments contradict"):
            pruning.test_mutual_consistency(collected(), OPTIONS, 0.999, SILENT)
    else:
        assert pruning.test_mutual_consistency(collected(), OPTIONS, 0.999, SILENT) == stated


def test_a_segment_that_sees_nothing_is_as_uncertain_as_the_prior() -> None:
    vi_map = scene_map(noise=1.0)
    blind = vi_map.keypoint_vertex >= 12
    landmark = np.where(blind, -1, vi_map.keypoints.landmark)
    evaluation = evaluate(
        vi_map.replace(keypoints=vi_map.keypoints.replace(landmark=landmark)), OPTIONS
    )
    prior = np.diag(evaluation.parameters.prior_sigma**2)
    found = [np.array_equal(one.covariance, prior) for one in evaluation.segments]
    assert found[0] is False
    assert found[-1] is True
    assert evaluation.segments[-1].unobservable == len(evaluation.parameters)
    assert evaluation.segments[0].unobservable < len(evaluation.parameters)


def test_sessions_are_scored_at_the_calibration_of_the_database() -> None:
    other = scene_map(noise=1.0, seed=2, device_seed=1)
    grown, _ = collect(other, OPTIONS, collected())
    knocked, _ = collect(other.replace(sensors=nominal(other)), OPTIONS, collected())
    assert {one.mission for one in grown.records} - {one.mission for one in collected().records}
    assert knocked.records == grown.records


def test_the_least_informative_segments_are_those_at_the_other_end() -> None:
    database = dataclasses.replace(collected(), capacity=len(collected()))
    least = dataclasses.replace(database, selection="least_informative")
    for table in database.tables:
        best = [one.key for one in database.ranked(table)]
        assert [one.key for one in least.ranked(table)] == best[::-1]


def test_between_missions_there_is_no_gap_to_bridge() -> None:
    first, second = scene_map(noise=1.0), scene_map(noise=1.0, seed=2, device_seed=1)
    both, _ = merge_maps(first, second)
    assert len(both.missions) == 2
    assert runs_of(both).max() == 1
    gaps = bias_gaps(both)
    assert len(gaps.before) == len(gaps.after) == len(gaps.duration_s) == 0
