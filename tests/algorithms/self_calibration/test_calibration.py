"""The calibration against truth; what is refused or doubted, and motions that excite too little."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from maplab_py.algorithms.self_calibration import checks
from maplab_py.algorithms.self_calibration.calibration import calibrate
from maplab_py.algorithms.self_calibration.checks import calibrate_with_checks
from maplab_py.algorithms.self_calibration.comparison import compare
from maplab_py.algorithms.self_calibration.device import device_of
from maplab_py.algorithms.self_calibration.estimation.problem import build_segment_problem
from maplab_py.algorithms.self_calibration.options import SelfCalibrationOptions
from maplab_py.algorithms.self_calibration.segments.selection import collect
from maplab_py.algorithms.self_calibration.segments.splitting import (
    extract_submap,
    split_into_segments,
)
from maplab_py.algorithms.self_calibration.uncertainty import Verdict
from maplab_py.errors import EstimationError, UserError
from maplab_py.sensors import Distortion
from maplab_py.simulation.scenario import MotionOptions, SessionOptions
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.simulation.simulate import simulate
from maplab_py.simulation.truth import true_map
from maplab_py.vimap.edits import with_new_ids
from maplab_py.vimap.merge import stack
from tests.algorithms.self_calibration.scenes import EXACT, OPTIONS, device, scene_map, uncalibrated


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
    assert "optvi" in report.advice


def test_short_data_confirm_no_large_change() -> None:
    _, report = calibrate(uncalibrated(scene_map(noise=1.0)), OPTIONS_ALL)
    sure, unexcited = Verdict.WELL_DETERMINED.text(), Verdict.NOT_EXCITED.text()
    changed = dataclasses.replace(
        report,
        parameters=tuple(
            dataclasses.replace(report.parameters[0], change_in_sigmas=change, verdict=verdict)
            for change, verdict in ((-8.9, sure), (2.9, sure), (8.9, unexcited))
        ),
    )
    doubted = checks.doubt_large_changes(changed, 10.0)
    verdicts = [one.verdict for one in doubted.parameters]
    assert verdicts == ["not confirmed: 8.9 sigma on 10 s of data", sure, unexcited]
    assert "--parts" in doubted.advice
    assert checks.doubt_large_changes(changed, 31.0) == changed


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


CAMERA = dataclasses.replace(
    OPTIONS,
    states="intrinsics,extrinsics_rotation,extrinsics_translation",
    keep_unobservable_at_prior=True,
)


def test_a_camera_that_moves_too_far_is_kept_where_it_was() -> None:
    start = uncalibrated(scene_map(noise=1.0))
    free, _, believed = calibrate_with_checks(start, CAMERA, batch=True, max_camera_shift_m=1.0)
    held, _, report = calibrate_with_checks(start, CAMERA, batch=True, max_camera_shift_m=1e-5)
    before = device(start)[1].T_B_C[:, 4:]
    kept = [one for one in report.parameters if "position" in one.parameter]
    assert len(report.parameters) == len(believed.parameters)
    assert all(one.verdict.startswith("kept: the data would move") for one in kept)
    rig_id = device(start)[1].id
    assert np.abs(held.camera_rig(rig_id).T_B_C[:, 4:] - before).max() <= 1e-12
    assert np.abs(free.camera_rig(rig_id).T_B_C[:, 4:] - before).max() > 1e-5


def test_the_spread_of_parts_widens_deviations_and_never_narrows_them() -> None:
    start = uncalibrated(scene_map(vertices=61, noise=1.0))
    _, _, formal = calibrate_with_checks(start, CAMERA, batch=True)
    _, _, widened = calibrate_with_checks(start, CAMERA, batch=True, parts=3)
    ratio = [b.sigma / a.sigma for a, b in zip(formal.parameters, widened.parameters, strict=True)]
    assert min(ratio) >= 1.0 - 1e-9
    # the simulated device is what the model says: results scatter as announced
    assert float(np.median(ratio)) <= 2.0
    assert not any(one.verdict.startswith("not confirmed") for one in widened.parameters)
    with pytest.raises(UserError, match="two parts"):
        calibrate_with_checks(start, CAMERA, batch=True, parts=1)


def test_the_spread_is_the_standard_error_of_the_mean_of_parts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    start = uncalibrated(scene_map(vertices=41, noise=1.0))
    changes, deviations = [], []

    def recorded(*arguments: Any, **keywords: Any) -> Any:
        result, report = calibrate(*arguments, **keywords)
        changes.append(result.change)
        return result, report

    def noted(report: Any, result: Any, *arguments: Any) -> Any:
        deviations.append(result.uncertainty.model_sigma)
        return with_spread(report, result, *arguments)

    with_spread = checks._with_spread
    monkeypatch.setattr(checks, "calibrate", recorded)
    monkeypatch.setattr(checks, "_with_spread", noted)
    _, _, report = calibrate_with_checks(start, CAMERA, batch=True, parts=4)
    assert len(changes) == 5  # of all data, then of the parts
    expected = np.maximum(np.std(changes[1:], axis=0, ddof=1) / 2.0, deviations[0])
    # one of them at least must be larger than what the noise explains, or nothing is tested
    assert np.any(expected > deviations[0])
    np.testing.assert_allclose([one.sigma for one in report.parameters], expected, rtol=1e-12)


STILL = {"shake_m": 0.0, "shake_rad": 0.0}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("motion", "lacking"),
    [
        (
            MotionOptions(kind="straight", duration_s=10.0, wall_distance_m=2.0, **STILL),
            "gyroscope",
        ),
        (MotionOptions(kind="stationary", duration_s=10.0, **STILL), "gyroscope"),
        (MotionOptions(kind="rotation", duration_s=14.0, turns=1.2, **STILL), "camera position"),
        (MotionOptions(kind="rotation", duration_s=14.0, turns=1.2), "camera position"),
    ],
)
def test_degenerate_motion_is_refused(motion: MotionOptions, lacking: str) -> None:
    scenario = dataclasses.replace(
        load_scenario("ar_room"), sessions=(SessionOptions(phases=(motion,)),)
    )
    with pytest.raises(EstimationError, match="not excited") as refused:
        calibrate(simulate(scenario).maps[0], SelfCalibrationOptions())
    assert lacking in str(refused.value)
    # the user can act on it
    assert "record motion" in str(refused.value)


@pytest.mark.slow
def test_turning_among_other_motion_does_not_spoil_the_calibration() -> None:
    """A session that put the camera 9 sigmas off: 12 s of turning and shaking, badly tracked."""
    scenario = load_scenario("ar_room")
    seeds = dataclasses.replace(scenario.seeds, motion=106, measurement=206, appearance=306)
    data = simulate(dataclasses.replace(scenario, seeds=seeds, sessions=(scenario.sessions[1],)))
    options = SelfCalibrationOptions()
    database, _ = collect(data.maps[0], options)
    result, _ = calibrate(database.vi_map, options)
    truth = build_segment_problem(
        true_map(data.maps[0], data.truth), options, robust=False
    ).states.blocks
    off = result.parameters.difference(result.blocks, truth)
    assert np.abs(off / np.sqrt(np.diag(result.uncertainty.formal))).max() <= 3.5
