"""Free calibrations, base frames, step schedules: what optvi estimates beside the poses."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from maplab_py.algorithms.vi_optimization.optimization import optimize
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.geometry import se3, so3
from maplab_py.sensors import CameraRig
from maplab_py.vimap import MissionSensor
from maplab_py.vimap.tables import AbsolutePoses
from tests.support.scene import Scene, corrupted


@pytest.mark.parametrize(
    "settings",
    [
        {"trust_region_schedule": "ceres"},
        {"use_nonmonotonic_steps": True},
        {"trust_region_schedule": "ceres", "use_nonmonotonic_steps": True},
    ],
)
def test_every_way_to_step_reaches_the_same_minimum(settings: dict[str, Any]) -> None:
    rng = np.random.default_rng(4)
    true = Scene(vertices=10, landmarks=150, noise=1.0).make()
    disturbed = corrupted(true, rng, position_m=0.05, quaternion=0.01, landmark_m=0.05)
    options = VIOptimizationOptions(loss="none", num_iterations=60, function_tolerance=1e-12)
    _, wanted = optimize(disturbed, options)
    _, found = optimize(disturbed, dataclasses.replace(options, **settings))
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
