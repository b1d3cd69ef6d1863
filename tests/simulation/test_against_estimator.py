"""The simulator against the estimator: two implementations of every model that agree.

Without noise the estimator's residuals vanish at the truth, with noise they have the announced size.
"""

import dataclasses

import numpy as np
import pytest

from maplab_py.algorithms.vi_optimization.optimization import optimize
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.algorithms.vi_optimization.reports import VIOptimizationReport
from maplab_py.estimation.imu import inertial_data, preintegration
from maplab_py.geometry import so3
from maplab_py.sensors import Imu, ImuIntrinsics
from maplab_py.simulation import scenario as sim
from maplab_py.simulation import scenario_file, truth
from maplab_py.simulation.imu import measure
from maplab_py.simulation.motion import motion_spline
from maplab_py.simulation.simulate import simulate
from tests.simulation.small import PERFECT, SMALL

AT_TRUTH = VIOptimizationOptions(
    num_iterations=0,
    loss="none",
    retriangulate_doubtful=False,
    gate_reprojection_error_px=1e9,
    hide_iterations_console_output=True,
)
RESIDUALS_PER = {"reprojection": 2, "inertial": 9, "bias walk": 6}
DEVIATIONS = sim.CalibrationOptions(
    focal_sigma_px=3.0,
    centre_sigma_px=3.0,
    camera_rotation_sigma_deg=1.0,
    camera_position_sigma_m=0.01,
    gyro_scale_sigma=0.01,
    accel_scale_sigma=0.02,
    gyro_misalignment_sigma=0.01,
    accel_misalignment_sigma=0.01,
    accel_rotation_sigma_deg=1.0,
)


def _report_at_truth(scenario: sim.Scenario) -> VIOptimizationReport:
    data = simulate(scenario)
    report = optimize(truth.true_map(data.maps[0], data.truth), AT_TRUTH)[1]
    assert report.observations_not_used == 0
    return report


def _chi_square(report: VIOptimizationReport) -> dict[str, float]:
    """Return the mean squared whitened residual per degree of freedom, by kind of term."""
    return {
        term.term: 2.0 * term.cost_before / (RESIDUALS_PER[term.term] * term.count)
        for term in report.terms
    }


def _cameras() -> dict[str, sim.CameraOptions]:
    parameters: dict[str, tuple[float, ...]] = {
        "none": (),
        "radial-tangential": (-0.28, 0.07, 2e-4, 2e-5),
        "equidistant": (-0.02, 0.01, -0.006, 0.001),
        "fisheye": (0.92,),
    }
    cameras = {}
    for distortion, values in parameters.items():
        pinhole = sim.CameraOptions(distortion=distortion, distortion_parameters=values)
        cameras[f"pinhole {distortion}"] = pinhole
        cameras[f"unified {distortion}"] = dataclasses.replace(
            pinhole,
            projection="unified-projection",
            intrinsics=(0.9, 700.0, 700.0, 376.0, 240.0),
        )
    return cameras


@pytest.mark.parametrize("name", ["pinhole radial-tangential", "pinhole fisheye"])
def test_without_noise_no_reprojection_error_is_left(name: str) -> None:
    second = dataclasses.replace(_cameras()["pinhole fisheye"], turn_rad=(0.0, 0.1, 0.6))
    scenario = dataclasses.replace(PERFECT, cameras=(_cameras()[name], second))
    _assert_no_error(_report_at_truth(scenario))


@pytest.mark.slow
@pytest.mark.parametrize("name", _cameras())
def test_without_noise_no_reprojection_error_is_left_in_any_model(name: str) -> None:
    scenario = dataclasses.replace(PERFECT, cameras=(_cameras()[name],))
    _assert_no_error(_report_at_truth(scenario))


def _assert_no_error(report: VIOptimizationReport) -> None:
    visual = next(term for term in report.terms if term.term == "reprojection")
    assert visual.count > 700
    # keypoints announce 0.1 px: the root of the sum bounds the largest single error
    assert np.sqrt(2.0 * visual.cost_before) * 0.1 < 1e-9


def test_an_unknown_calibration_is_found_in_the_truth() -> None:
    scenario = dataclasses.replace(PERFECT, calibration=DEVIATIONS)
    data = simulate(scenario)
    stored, _ = data.maps[0], data.truth
    known = optimize(truth.true_map(stored, data.truth), AT_TRUTH)[1]
    _assert_no_error(known)
    wrong = truth.true_map(stored, data.truth).replace(sensors=stored.sensors)
    assert optimize(wrong, AT_TRUTH)[1].mean_reprojection_before_px > 1.0
    inertial = {term.term: term.cost_before for term in known.terms}["inertial"]
    skewed = {term.term: term.cost_before for term in optimize(wrong, AT_TRUTH)[1].terms}
    assert skewed["inertial"] > 100.0 * inertial


def _without_swaps(scenario: sim.Scenario) -> sim.Scenario:
    measurement = dataclasses.replace(scenario.measurement, identity_swap_share=0.0)
    return dataclasses.replace(scenario, measurement=measurement)


def test_reprojection_errors_have_the_announced_size() -> None:
    scenario = _without_swaps(dataclasses.replace(SMALL, sessions=SMALL.sessions[:1]))
    chi_square = _chi_square(_report_at_truth(scenario))
    # 11000 residuals: a standard deviation of 1.3 %
    assert chi_square["reprojection"] == pytest.approx(1.0, abs=0.04)


@pytest.mark.slow
def test_all_residuals_of_a_long_session_have_the_announced_size() -> None:
    report = _report_at_truth(_without_swaps(scenario_file.load_scenario("single_session")))
    chi_square = _chi_square(report)
    assert chi_square["reprojection"] == pytest.approx(1.0, abs=0.02)
    assert chi_square["bias walk"] == pytest.approx(1.0, abs=0.06)
    total = sum(2.0 * term.cost_before for term in report.terms)
    freedom = sum(RESIDUALS_PER[term.term] * term.count for term in report.terms)
    assert total / freedom == pytest.approx(1.0, abs=0.02)


@pytest.mark.slow
def test_inertial_errors_have_the_announced_size() -> None:
    options = sim.ImuOptions(gyro_bias_walk=0.0, accel_bias_walk=0.0)
    stride, seconds = 100, 1500
    session = sim.SessionOptions(duration_s=float(seconds), turns=40.0)
    spline = motion_spline(session, sim.WorldOptions(), np.random.default_rng(1))
    motion = spline.evaluate(np.arange(seconds * 200 + 1) / 200.0)
    samples = [
        measure(opts, ImuIntrinsics(), motion, np.random.default_rng(2))
        for opts in (options, dataclasses.replace(options, gyro_noise_density=0.0, accel_noise_density=0.0))
    ]  # fmt: skip
    first = np.arange(0, seconds * 200, stride)
    rows = (first[:, None] + np.arange(stride + 1)).ravel()
    imu = Imu(
        "0" * 32,
        acc_noise_density=options.accel_noise_density,
        gyro_noise_density=options.gyro_noise_density,
    )
    noisy, clean = (
        preintegration.integrate(
            inertial_data.InertialData(
                np.arange(len(first) + 1) * (stride + 1),
                np.round(rows * 5e6).astype(np.int64),
                recording.accel_gyro[rows],
                (imu,),
                np.zeros(len(first), dtype=np.int64),
            ),
            samples[1].gyro_bias[0],
            samples[1].accel_bias[0],
        )
        for recording in samples
    )
    theta = so3.log(so3.multiply(so3.inverse(clean.q_A_B), noisy.q_A_B))
    error = np.concatenate([noisy.dp - clean.dp, theta, noisy.dv - clean.dv], axis=1)
    whitened = np.linalg.solve(np.linalg.cholesky(clean.covariance), error[:, :, None])
    # 27000 residuals: a standard deviation of 0.9 %; the end samples count half: -0.5 %
    assert np.mean(whitened**2) == pytest.approx(1.0, abs=0.02)
