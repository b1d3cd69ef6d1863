"""A window that goes on with another calibration."""

import dataclasses

import numpy as np

from maplab_py.array_types import F64
from maplab_py.estimation.window.options import WindowOptions
from maplab_py.estimation.window.smoother import FixedLagSmoother
from maplab_py.geometry import alignment, se3, so3
from maplab_py.sensors import Camera, Distortion, Imu
from maplab_py.sensors.imu import ImuIntrinsics
from tests.estimation.window.recordings import SimulatedTracks, scenario, simulated

SIGMA = np.repeat([1e-3, 2e-3, 0.02, 1e-3, 0.02], 3)
SWITCHED = 40
Rig = tuple[tuple[Camera, ...], F64, Imu]


def wrong(tracks: SimulatedTracks) -> Rig:
    """Return a calibration that is wrong by 5 px, 1 deg, 1 cm and 1 %."""
    T_I_C = tracks.T_I_C.copy()
    T_I_C[:, :4] = so3.multiply(T_I_C[:, :4], so3.exp(np.deg2rad([0.6, -0.6, 0.5])))
    T_I_C[:, 4:] += [0.006, -0.006, 0.005]
    cameras = tuple(
        dataclasses.replace(camera, intrinsics=camera.intrinsics + np.array([5.0, 5.0, 4.0, -4.0]))
        for camera in tracks.cameras
    )
    scales = ImuIntrinsics(T_g=np.diag([0.99, 1.01, 0.99]), T_a=np.diag([1.01, 0.99, 0.99]))
    return cameras, T_I_C, dataclasses.replace(tracks.imu, intrinsics=scales)


def estimates(tracks: SimulatedTracks, first: Rig, then: Rig | None) -> F64:
    """Return the poses as they are estimated at their time, with another calibration from a frame on."""
    smoother = FixedLagSmoother(*first, WindowOptions())
    smoother.start(tracks.frames[0], tracks.start_state(SIGMA))
    poses = [tracks.T_M_I[0]]
    for number, frame in enumerate(tracks.frames[1:], 1):
        if number == SWITCHED and then is not None:
            newest = smoother.states.T_M_I[-1].copy()
            smoother.recalibrate(*then)
            np.testing.assert_allclose(smoother.states.T_M_I[-1], newest, atol=1e-12)
        poses.append(smoother.add(frame).state.T_M_I[0])
    return np.array(poses)


def error_m(tracks: SimulatedTracks, poses: F64) -> float:
    """Return the position error after the switch, aligned in yaw and position."""
    true, p = tracks.T_M_I[SWITCHED:, 4:], poses[SWITCHED:, 4:]
    aligned = se3.transform(alignment.align_yaw_position(true, p), p)
    return float(np.sqrt(np.mean(np.sum((aligned - true) ** 2, axis=1))))


def test_the_same_calibration_changes_nothing() -> None:
    tracks = simulated(scenario(duration_s=6.0, stereo=False, keypoints=80))
    rig = tracks.cameras, tracks.T_I_C, tracks.imu
    np.testing.assert_allclose(estimates(tracks, rig, rig), estimates(tracks, rig, None), atol=1e-6)


def test_a_right_calibration_is_at_once_better_without_a_jump() -> None:
    tracks = simulated(scenario(duration_s=8.0, stereo=False, keypoints=80))
    right = tracks.cameras, tracks.T_I_C, tracks.imu
    before, switched = (estimates(tracks, wrong(tracks), then) for then in (None, right))
    assert error_m(tracks, switched) < 0.5 * error_m(tracks, before)
    step, true_step = (
        (poses[SWITCHED] - poses[SWITCHED - 1])[4:] for poses in (switched, tracks.T_M_I)
    )
    assert np.linalg.norm(step - true_step) < 5e-3


def test_a_window_without_its_delay_doubts_what_it_has_made_of_it() -> None:
    tracks = simulated(scenario(duration_s=8.0, stereo=False, keypoints=80, seed=2))
    late = tuple(dataclasses.replace(camera, image_delay_s=0.01) for camera in tracks.cameras)
    wrong_rig, right = ((of, tracks.T_I_C, tracks.imu) for of in (late, tracks.cameras))
    before, switched = (estimates(tracks, wrong_rig, then) for then in (None, right))
    assert error_m(tracks, switched) < 0.25 * error_m(tracks, before)


def test_biases_explain_the_samples_as_before() -> None:
    tracks = simulated(scenario(duration_s=3.0, stereo=False, keypoints=80))
    cameras, T_I_C, imu = wrong(tracks)
    smoother = FixedLagSmoother(cameras, T_I_C, imu, WindowOptions())
    smoother.start(tracks.frames[0], tracks.start_state(SIGMA))
    for frame in tracks.frames[1:20]:
        smoother.add(frame)
    before = smoother.states.accel_bias[-1].copy()
    smoother.recalibrate(cameras, T_I_C, tracks.imu)
    # the accelerometer's scale along gravity was 1 % too small: its bias had made up for it
    change = smoother.states.accel_bias[-1] - before
    assert imu.intrinsics is not None
    mean = np.mean([f.accel_gyro[:, :3].mean(axis=0) for f in tracks.frames[10:20]], axis=0)
    expected = (np.diag(imu.intrinsics.T_a) - 1.0) * (mean - before) / np.diag(imu.intrinsics.T_a)
    np.testing.assert_allclose(change, expected, atol=5e-3)


def test_keypoints_without_rays_by_the_new_calibration_are_left_out() -> None:
    tracks = simulated(scenario(duration_s=2.0, stereo=False, keypoints=80))
    smoother = FixedLagSmoother(tracks.cameras, tracks.T_I_C, tracks.imu, WindowOptions())
    smoother.start(tracks.frames[0], tracks.start_state(SIGMA))
    for frame in tracks.frames[1:15]:
        smoother.add(frame)
    count = len(smoother.tracks.observations)
    camera = tracks.cameras[0]
    bent = np.array([-1.0, 0.0, 0.0, 0.0])  # has no rays far from the centre
    assert camera.distortion is Distortion.RADTAN
    camera = dataclasses.replace(camera, distortion_parameters=bent)
    smoother.recalibrate((camera,), tracks.T_I_C, tracks.imu)
    assert 0 < len(smoother.tracks.observations) < count
    assert np.isfinite(smoother.tracks.observations.ray_C).all()
    assert np.isfinite(smoother.tracks.h).all()
