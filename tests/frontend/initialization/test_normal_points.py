"""Observations are averaged with those of neighbouring frames, and stay where they belong."""

import dataclasses

import numpy as np
import pytest

from maplab_py.array_types import F64, I64
from maplab_py.estimation.window.calibration import WindowCalibration
from maplab_py.estimation.window.cameras import CameraPoses
from maplab_py.estimation.window.states import WindowStates
from maplab_py.frontend.initialization.normal_points import with_normal_points
from maplab_py.frontend.initialization.segment import History, ObservedFrames, Segment
from maplab_py.sensors.projection import project
from tests.frontend.initialization.flights import EXACT_IMU, NOISE_PX, Flight, fly, lively

GATE_CHI2 = 13.8


@dataclasses.dataclass(frozen=True, eq=False)
class Case:
    segment: Segment  # every third frame
    states: WindowStates  # true
    track_id: I64
    p_M: F64  # true, of the tracks
    rig: WindowCalibration

    def averaged(self, states: WindowStates | None = None) -> Segment:
        return with_normal_points(
            self.segment, states or self.states, self.track_id, self.p_M, self.rig, GATE_CHI2
        )

    def errors(self, segment: Segment) -> F64:
        """Return the differences (N, 2) of a segment's keypoints to the projections."""
        poses = CameraPoses.of(self.states.T_M_I, self.rig.T_I_C)
        p_C = poses.to_camera(segment.frame, segment.camera, self.p_M[segment.track_id])
        uv_px = np.zeros_like(segment.uv_px)
        for number, camera in enumerate(self.rig.cameras):
            rows = segment.camera == number
            uv_px[rows] = project(camera, p_C[rows])[0]
        return segment.uv_px - uv_px


def case(cameras: int = 1, noise_px: float = 0.0, seed: int = 1) -> Case:
    flight = fly(lively(seed, 3.0), seed=seed, cameras=cameras, imu=EXACT_IMU, outlier_share=0.0)
    rng = np.random.default_rng(seed)
    history, device = History(10.0), flight.device
    points = _points(flight)
    poses = CameraPoses.of(flight.truth.T_G_I, device.T_I_C)
    for number, frame in enumerate(flight.frames):
        frames = np.full(len(frame.track_id), number)
        p_C = poses.to_camera(frames, frame.camera, points[frame.track_id])
        uv_px = np.zeros((len(p_C), 2))
        for row, camera in enumerate(device.cameras):
            seen = frame.camera == row
            uv_px[seen] = project(camera, p_C[seen])[0]
        uv_px += noise_px * rng.standard_normal(uv_px.shape)
        history.push(dataclasses.replace(frame, uv_px=uv_px))
    assert device.imu is not None
    segment = history.segment(device.imu, 0.15)
    rows = np.searchsorted([frame.time_ns for frame in flight.frames], segment.time_ns)
    motion = [flight.truth.v_G[rows], flight.gyro_bias[rows], flight.accel_bias[rows]]
    states = WindowStates(
        flight.truth.T_G_I[rows], np.concatenate(motion, axis=1), np.zeros((0, 3))
    )
    rig = WindowCalibration.of(device.cameras, device.T_I_C)
    return Case(segment, states, np.arange(len(points)), points, rig)


def _points(flight: Flight) -> F64:
    """Return a point for each track, in front of the camera of the first frame that sees it."""
    rng = np.random.default_rng(5)
    ids = np.concatenate([frame.track_id for frame in flight.frames])
    points = np.zeros((int(ids.max()) + 1, 3))
    is_placed = np.zeros(len(points), dtype=bool)
    poses = CameraPoses.of(flight.truth.T_G_I, flight.device.T_I_C)
    for number, frame in enumerate(flight.frames):
        first = ~is_placed[frame.track_id]
        ids, camera = frame.track_id[first], frame.camera[first]
        ray = np.column_stack([rng.uniform(-0.5, 0.5, (len(ids), 2)), np.ones(len(ids))])
        p_C = ray * rng.uniform(2.0, 6.0, (len(ids), 1))
        points[ids] = poses.to_mission(np.full(len(ids), number), camera, p_C)
        is_placed[ids] = True
    return points


@pytest.mark.parametrize("cameras", [1, 2])
def test_keypoints_without_noise_stay_where_they_are(cameras: int) -> None:
    exact = case(cameras)
    assert len(exact.segment.between.time_ns) == 2 * (len(exact.segment) - 1)
    averaged = exact.averaged()
    # the integration of the samples is exact to a hundredth of a pixel
    np.testing.assert_allclose(averaged.uv_px, exact.segment.uv_px, rtol=0.0, atol=0.02)
    assert np.mean(averaged.sigma_px < 0.6 * exact.segment.sigma_px) > 0.5
    assert averaged.sigma_px.min() >= exact.segment.sigma_px.min() / np.sqrt(3.0) - 1e-12
    assert len(averaged.between.time_ns) == 0
    np.testing.assert_array_equal(averaged.track_id, exact.segment.track_id)


def test_means_are_as_accurate_as_their_deviations_say() -> None:
    noisy = case(noise_px=NOISE_PX)
    averaged = noisy.averaged()
    raw, mean = noisy.errors(noisy.segment), noisy.errors(averaged)
    three = averaged.sigma_px < 0.6 * noisy.segment.sigma_px
    assert np.std(raw[three]) == pytest.approx(NOISE_PX, rel=0.1)
    assert np.std(mean[three]) == pytest.approx(NOISE_PX / np.sqrt(3.0), rel=0.1)
    unchanged = averaged.sigma_px == noisy.segment.sigma_px
    np.testing.assert_array_equal(averaged.uv_px[unchanged], noisy.segment.uv_px[unchanged])


def test_a_wrong_scale_and_velocity_move_keypoints_hardly() -> None:
    exact = case()
    states, wrong = exact.states, 1.05
    T_M_I, motion = states.T_M_I.copy(), states.motion.copy()
    T_M_I[:, 4:] *= wrong
    motion[:, :3] *= wrong
    scaled = dataclasses.replace(exact, p_M=wrong * exact.p_M)
    averaged = scaled.averaged(WindowStates(T_M_I, motion, states.h))
    offset = averaged.uv_px - exact.segment.uv_px
    assert np.sqrt(np.mean(offset**2)) < 0.05  # of 0.29 px that a mean of three has
    assert np.quantile(np.abs(offset), 0.99) < 0.15


def test_an_outlier_of_a_neighbour_is_left_out() -> None:
    exact = case()
    between = exact.segment.between
    uv_px = between.uv_px.copy()
    uv_px[::2] += 30.0
    damaged = dataclasses.replace(
        exact,
        segment=dataclasses.replace(
            exact.segment, between=dataclasses.replace(between, uv_px=uv_px)
        ),
    )
    averaged = damaged.averaged()
    np.testing.assert_allclose(averaged.uv_px, exact.segment.uv_px, rtol=0.0, atol=0.02)
    weights = (exact.segment.sigma_px / averaged.sigma_px) ** 2
    assert weights.mean() < ((exact.segment.sigma_px / exact.averaged().sigma_px) ** 2).mean()


def test_tracks_without_landmarks_and_segments_without_frames_between_stay() -> None:
    exact = case()
    some = dataclasses.replace(exact, track_id=exact.track_id[::2], p_M=exact.p_M[::2])
    averaged = some.averaged()
    is_other = ~np.isin(exact.segment.track_id, some.track_id)
    assert is_other.any()
    np.testing.assert_array_equal(averaged.sigma_px[is_other], exact.segment.sigma_px[is_other])
    assert np.any(averaged.sigma_px[~is_other] < exact.segment.sigma_px[~is_other])
    none = dataclasses.replace(exact, track_id=exact.track_id[:0], p_M=exact.p_M[:0])
    assert none.averaged() is exact.segment
    alone = dataclasses.replace(exact.segment, between=ObservedFrames.of([]))
    assert dataclasses.replace(exact, segment=alone).averaged() is alone
