"""Calibrations that are freed: all that are named, or those that the residuals contradict."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from maplab_py.algorithms.vi_optimization.optimization import contradicted_calibration, optimize
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.geometry import se3, so3
from maplab_py.sensors import CameraRig
from maplab_py.simulation import scenario as sim
from maplab_py.simulation.evaluation import evaluate_map
from maplab_py.simulation.simulate import SimulatedData, simulate
from maplab_py.vimap import AbsolutePoses, MissionSensor, VIMap
from tests.support.scene import Scene, corrupted


def test_steps_that_may_go_uphill_reach_the_same_minimum() -> None:
    rng = np.random.default_rng(4)
    true = Scene(vertices=10, landmarks=150, noise=1.0).make()
    disturbed = corrupted(true, rng, position_m=0.05, quaternion=0.01, landmark_m=0.05)
    options = VIOptimizationOptions(loss="none", num_iterations=60, function_tolerance=1e-12)
    _, wanted = optimize(disturbed, options)
    uphill = dataclasses.replace(options, use_nonmonotonic_steps=True)
    _, found = optimize(disturbed, uphill)
    assert found.cost_after == pytest.approx(wanted.cost_after, rel=1e-8)


def test_freed_calibrations_return_to_the_truth() -> None:
    true = Scene(vertices=16, interval_s=0.25, landmarks=250).make()
    rig = next(s for s in true.sensors.sensors.values() if isinstance(s, CameraRig))
    camera = rig.cameras[0]
    wrong = dataclasses.replace(
        camera,
        intrinsics=camera.intrinsics * [1.01, 0.99, 1.005, 0.995],
        distortion_parameters=camera.distortion_parameters + 0.01,
    )
    T_B_C = se3.retract(rig.T_B_C, np.full((1, 6), 0.01))
    sensors = {
        **true.sensors.sensors,
        rig.id: dataclasses.replace(rig, cameras=(wrong,), T_B_C=T_B_C),
    }
    start = true.replace(sensors=dataclasses.replace(true.sensors, sensors=sensors))
    options = VIOptimizationOptions(
        loss="none",
        num_iterations=60,
        function_tolerance=1e-14,
        gate_reprojection_error_px=1e3,
        use_visual_outlier_rejection_solver=False,
        fix_ncamera_intrinsics=False,
        fix_ncamera_extrinsics_rotation=False,
        fix_ncamera_extrinsics_translation=False,
        fix_imu_intrinsics=False,
    )
    result, report = optimize(start, options)
    found = result.sensors.camera_rig(rig.id)
    np.testing.assert_allclose(found.cameras[0].intrinsics, camera.intrinsics, rtol=1e-6)
    np.testing.assert_allclose(
        found.cameras[0].distortion_parameters, camera.distortion_parameters, atol=1e-6
    )
    assert np.abs(se3.log(se3.relative(rig.T_B_C, found.T_B_C))).max() < 1e-5
    assert len(report.calibration) == 8 + 6 + 15
    assert all(row.sigma > 0.0 for row in report.calibration)


def test_fixed_calibrations_are_kept_bit_for_bit() -> None:
    vi_map = Scene(vertices=8, landmarks=100, noise=1.0).make()
    assert optimize(vi_map, VIOptimizationOptions())[0].sensors is vi_map.sensors
    only_delay = VIOptimizationOptions(fix_ncamera_time_offset=False)
    result, report = optimize(vi_map, only_delay)
    rig = next(s for s in vi_map.sensors.sensors.values() if isinstance(s, CameraRig))
    found = result.sensors.camera_rig(rig.id)
    np.testing.assert_array_equal(found.cameras[0].intrinsics, rig.cameras[0].intrinsics)
    np.testing.assert_allclose(found.T_B_C, rig.T_B_C, atol=1e-15)
    assert [row.parameter.split(" ", 2)[2] for row in report.calibration] == ["image delay [s]"]
    assert abs(found.cameras[0].image_delay_s) < 5 * report.calibration[0].sigma


def test_base_frames_take_up_the_movement_when_they_may() -> None:
    true = Scene(vertices=8, landmarks=100).make()
    baseframes = true.baseframes.replace(
        T_G_M=se3.compose(
            se3.make(so3.exp([0.0, 0.0, 0.3]), [1.0, 2.0, 3.0]), true.baseframes.T_G_M
        )
    )
    count = len(true.vertices)
    poses = AbsolutePoses.filled(
        count,
        vertex=np.arange(count),
        T_G_S=true.T_G_I,
        covariance=np.tile(1e-6 * np.eye(6), (count, 1, 1)),
        sensor_id=np.tile(true.missions.sensor_id[0, MissionSensor.IMU], (count, 1)),
        timestamp_ns=true.vertices.timestamp_ns,
    )
    start = true.replace(baseframes=baseframes, absolute_poses=poses)
    options = VIOptimizationOptions(
        include_absolute_pose_constraints=True,
        absolute_pose_sensor_fix_mission_baseframes=False,
        num_iterations=50,
        gate_reprojection_error_px=1e6,
    )
    result, _ = optimize(start, options)
    np.testing.assert_allclose(result.T_G_I[:, 4:], true.T_G_I[:, 4:], atol=1e-3)
    np.testing.assert_allclose(
        result.baseframes.T_G_M[:, 4:], true.baseframes.T_G_M[:, 4:], atol=2e-3
    )
    np.testing.assert_allclose(result.vertices.T_M_I[:, 4:], true.vertices.T_M_I[:, 4:], atol=2e-3)


@pytest.mark.parametrize("fix_ncamera_intrinsics", [True, False])
def test_priors_hold_what_they_name(fix_ncamera_intrinsics: bool) -> None:
    rng = np.random.default_rng(4)
    true = Scene(vertices=10, landmarks=150, noise=1.0).make()
    start = corrupted(true, rng, position_m=0.02, quaternion=0.005, landmark_m=0.02)
    free = VIOptimizationOptions(
        loss="none",
        num_iterations=40,
        fix_ncamera_intrinsics=fix_ncamera_intrinsics,
        use_visual_outlier_rejection_solver=False,
        gate_reprojection_error_px=1e6,
    )
    moved = optimize(start, free)[0]
    held, report = optimize(start, dataclasses.replace(free, landmark_prior_sigma_m=1e-6))
    assert np.abs(moved.p_G - start.p_G).max() > 1e-2
    assert np.abs(held.p_G - start.p_G).max() < 1e-4
    assert report.gauge == "nothing of 1 cluster"
    stiff = dataclasses.replace(free, position_prior_sigma_m=1e-6, orientation_prior_sigma_rad=1e-6)
    held, report = optimize(start, stiff)
    assert np.abs(held.T_G_I[:, 4:] - start.T_G_I[:, 4:]).max() < 1e-4
    assert {term.term: term.count for term in report.terms}["pose prior"] == 10
    stiff = dataclasses.replace(
        free, gyro_bias_prior_sigma_radps=1e-9, accel_bias_prior_sigma_mps2=1e-9
    )
    held, _ = optimize(start, stiff)
    assert np.abs(held.vertices.gyro_bias - start.vertices.gyro_bias).max() < 1e-6
    assert np.abs(held.vertices.accel_bias - start.vertices.accel_bias).max() < 1e-6


AUTO = VIOptimizationOptions(calibration="auto")
FIXED = VIOptimizationOptions()


def scenario(line_delay_s: float = 0.0) -> sim.Scenario:
    return dataclasses.replace(
        sim.Scenario().with_seed(1),
        sessions=(sim.SessionOptions(duration_s=10.0),),
        world=sim.WorldOptions(landmarks_per_room=800),
        measurement=sim.MeasurementOptions(max_keypoints=150),
        cameras=(sim.CameraOptions(line_delay_s=line_delay_s),),
    )


@pytest.fixture(scope="module")
def data() -> SimulatedData:
    return simulate(scenario())


def with_fault(vi_map: VIMap, fault: str) -> VIMap:
    """Return the map with a wrong calibration."""
    rig = next(s for s in vi_map.sensors.sensors.values() if isinstance(s, CameraRig))
    camera, T_B_C = rig.cameras[0], rig.T_B_C
    if fault == "time_offset":
        camera = dataclasses.replace(camera, image_delay_s=camera.image_delay_s + 0.005)
    elif fault == "extrinsics_rotation":
        T_B_C = se3.retract(T_B_C, np.array([[0, 0, 0, 0.015, -0.01, 0.01]]))
    elif fault == "mounting":
        T_B_C = se3.retract(T_B_C, np.array([[0.06, -0.05, 0.03, 0.03, -0.02, 0.02]]))
    elif fault == "intrinsics":
        camera = dataclasses.replace(camera, intrinsics=camera.intrinsics * [1.02, 1.02, 1.0, 1.0])
    elif fault == "line_delay":
        camera = dataclasses.replace(camera, image_delay_s=0.0, line_delay_ns=0)
    rig = dataclasses.replace(rig, cameras=(camera,), T_B_C=T_B_C)
    sensors = {**vi_map.sensors.sensors, rig.id: rig}
    return vi_map.replace(sensors=dataclasses.replace(vi_map.sensors, sensors=sensors))


def test_a_true_calibration_stays_to_the_last_bit(data: SimulatedData) -> None:
    result, report = optimize(data.maps[0], AUTO)
    wanted, _ = optimize(data.maps[0], FIXED)
    assert not contradicted_calibration(data.maps[0])
    assert report.calibration == []
    assert "calibration" not in report.note
    np.testing.assert_array_equal(result.vertices.T_M_I, wanted.vertices.T_M_I)
    assert result.sensors is data.maps[0].sensors


@pytest.mark.parametrize(
    ("fault", "words", "block", "solver"),
    [
        ("time_offset", "image delay -", "image delay", "auto"),
        ("extrinsics_rotation", "rotation on the IMU", "rotation", "auto"),
        ("intrinsics", "focal length -", "fu", "auto"),
        ("intrinsics", "focal length -", "fu", "pcg"),  # as it is chosen for short flights
    ],
)
def test_a_fault_is_freed_named_and_mended(
    data: SimulatedData, fault: str, words: str, block: str, solver: str
) -> None:
    start = with_fault(data.maps[0], fault)
    assert contradicted_calibration(start)
    result, report = optimize(start, dataclasses.replace(AUTO, linear_solver_type=solver))
    free = {f"fix_ncamera_{fault}": False}  # the same from a true calibration
    wanted, _ = optimize(data.maps[0], dataclasses.replace(FIXED, **free))
    kept, _ = optimize(start, FIXED)
    truth = data.truth
    assert words in report.note
    assert "--ba_calibration=fixed" in report.note
    assert any(block in row.parameter for row in report.calibration)
    assert all(np.isfinite(row.sigma) and row.sigma > 0.0 for row in report.calibration)
    of_truth_m = evaluate_map(wanted, truth).ate_m
    assert evaluate_map(result, truth).ate_m <= 1.1 * of_truth_m
    assert evaluate_map(kept, truth).ate_m > 1.3 * of_truth_m
    assert optimize(result, AUTO)[1].calibration == []


def test_what_shows_once_a_rotation_is_free_is_freed_then(data: SimulatedData) -> None:
    start = with_fault(data.maps[0], "mounting")
    result, report = optimize(start, AUTO)
    assert "rotation on the IMU" in report.note
    assert "position on the IMU" in report.note
    before, after = (
        next(s for s in m.sensors.sensors.values() if isinstance(s, CameraRig)).T_B_C[0, 4:]
        for m in (start, result)
    )
    reported = {row.parameter[-5:]: row.after - row.before for row in report.calibration}
    moved = [reported[f"{axis} [m]"] for axis in "xyz"]
    np.testing.assert_allclose(moved, after - before, atol=1e-9)
    np.testing.assert_allclose(moved, [-0.06, 0.05, -0.03], atol=0.02)


def test_a_rolling_shutter_is_found() -> None:
    data = simulate(scenario(30e-3 / 480))
    result, report = optimize(with_fault(data.maps[0], "line_delay"), AUTO)
    assert "line delay +6" in report.note
    rig = next(s for s in result.sensors.sensors.values() if isinstance(s, CameraRig))
    assert rig.cameras[0].line_delay_ns == pytest.approx(62_500, rel=0.1)


@pytest.mark.parametrize(
    "settings",
    [
        {"calibration": "fixed"},
        {"num_iterations": 3},
        {"fix_ncamera_line_delay": False},
        {"include_inertial": False},
        {"fix_landmark_positions": True},
    ],
)
def test_what_the_user_says_comes_first(data: SimulatedData, settings: dict[str, Any]) -> None:
    start = with_fault(data.maps[0], "time_offset")
    result, report = optimize(start, dataclasses.replace(AUTO, **settings))
    assert "contradict" not in report.note
    assert all("line delay" in row.parameter for row in report.calibration)
    rig = next(s for s in result.sensors.sensors.values() if isinstance(s, CameraRig))
    assert rig.cameras[0].image_delay_s == pytest.approx(0.005)
