"""Gyroscope bias from epipolar geometry, and the closed form for velocity, gravity and bias."""

import dataclasses

import numpy as np
import pytest

from maplab_py.array_types import F64
from maplab_py.frontend.initialization.gyro_bias import (
    delayed,
    estimate_gyro_bias,
    fit_turns,
    gauss_newton_step,
    integrate_turns,
    ray_pairs,
)
from maplab_py.frontend.initialization.linear import solve_motion
from maplab_py.frontend.initialization.rays import RayMaker, SegmentRays
from maplab_py.frontend.initialization.refinement import mission_frame
from maplab_py.frontend.initialization.segment import History, Segment
from maplab_py.geometry import so3
from tests.frontend.initialization import flights
from tests.frontend.initialization.flights import Flight, fly, lively

EXACT = dataclasses.replace(flights.EXACT_IMU, accel_bias_sigma=0.0)


def segment_of(flight: Flight, interval_s: float = 0.2) -> tuple[Segment, SegmentRays]:
    history = History(10.0)
    for frame in flight.frames:
        history.push(frame)
    imu = flight.device.imu
    assert imu is not None
    segment = history.segment(imu, interval_s)
    return segment, RayMaker(flight.device.cameras, flight.device.T_I_C).of(segment)


def test_pairs_are_the_common_tracks_of_a_camera() -> None:
    _, rays = segment_of(fly(lively(1, 2.0), seed=1, cameras=2, points=600))
    pairs = ray_pairs(rays)
    count = 0
    for number, (a, b) in enumerate(zip(pairs.first_frame, pairs.second_frame, strict=True)):
        assert b - a in (1, 2, 4)
        of_pair = slice(*pairs.start[number : number + 2])
        assert np.all(pairs.pair[of_pair] == number)
        expected = 0
        for camera in (0, 1):
            seen = [(rays.frame == frame) & (rays.camera == camera) for frame in (a, b)]
            common = np.intersect1d(rays.track[seen[0]], rays.track[seen[1]])
            first, second = (each & np.isin(rays.track, common) for each in seen)
            if np.array_equal(rays.ray_I[first], pairs.first[of_pair]):
                np.testing.assert_array_equal(pairs.second[of_pair], rays.ray_I[second])
                expected = len(common)
        assert expected >= 12
        count += expected
    assert count == len(pairs.pair) > 1000


def test_a_step_is_that_of_the_whole_least_squares_problem() -> None:
    """The bias and all directions, solved as one dense problem with numeric derivatives."""
    segment, rays = segment_of(fly(lively(2, 2.0), seed=2, cameras=1, points=300), 0.4)
    pairs = ray_pairs(rays)
    turns = integrate_turns(segment.inertial, np.zeros(3))
    count, of = len(pairs.first_frame), pairs.pair
    weight = np.ones(len(of))
    step, weight, _ = gauss_newton_step(pairs, turns, weight, np.zeros(3))

    def normals(bias: F64) -> F64:
        q_A_I = so3.multiply(turns.q_A_I, so3.exp(turns.jacobian @ bias))
        q_i_j = so3.multiply(so3.inverse(q_A_I[pairs.first_frame]), q_A_I[pairs.second_frame])
        return np.cross(pairs.first, so3.rotate(q_i_j[of], pairs.second))

    scaled = normals(np.zeros(3)) / pairs.sigma[:, None]
    scatter = np.zeros((count, 3, 3))
    np.add.at(scatter, of, scaled[:, :, None] * scaled[:, None])
    axes = np.linalg.eigh(scatter)[1]
    sine = np.linalg.norm(np.cross(axes[of, :, 0], pairs.first), axis=1)

    def residual(x: F64) -> F64:
        moved = axes[:, :, 1:] @ x[3:].reshape(-1, 2, 1)
        t = axes[:, :, 0] + moved[:, :, 0]
        error = np.sum(t[of] * normals(x[:3]), axis=1) / (np.maximum(sine, 1e-3) * pairs.sigma)
        return np.concatenate([np.sqrt(weight) * error, x[:3] / 0.2])

    zero, h = np.zeros(3 + 2 * count), 1e-6
    columns = [(residual(h * e) - residual(-h * e)) / (2.0 * h) for e in np.eye(len(zero))]
    expected, *_ = np.linalg.lstsq(np.stack(columns, axis=1), -residual(zero), rcond=None)
    np.testing.assert_allclose(step, expected[:3], rtol=1e-5, atol=1e-8)
    np.testing.assert_allclose(weight, 1.0 / (1.0 + (residual(zero)[:-3] ** 2 / weight)))


@pytest.mark.parametrize("cameras", [1, 2])
@pytest.mark.parametrize("seed", [1, 2])
def test_the_bias_of_the_gyroscope(cameras: int, seed: int) -> None:
    flight = fly(lively(seed, 2.0), seed=seed, cameras=cameras, points=1500)
    segment, rays = segment_of(flight)
    bias = estimate_gyro_bias(segment.inertial, ray_pairs(rays))
    error = np.linalg.norm(bias - flight.gyro_bias[-1])
    assert np.linalg.norm(flight.gyro_bias[-1]) > 0.02
    assert error < 4e-3


def test_without_common_tracks_the_bias_is_zero() -> None:
    flight = fly(lively(1, 1.0), points=20)
    segment, rays = segment_of(flight)
    pairs = ray_pairs(rays)
    assert len(pairs.first_frame) == 0
    assert estimate_gyro_bias(segment.inertial, pairs).tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize("delay_s", [-0.045, -0.006, 0.0, 0.03])
def test_the_delay_of_the_images(delay_s: float) -> None:
    """Samples are moved the other way, so that images seem to be late."""
    segment, rays = segment_of(fly(lively(2, 2.0), seed=2, points=1500), 0.1)
    fit = fit_turns(delayed(segment.inertial, -delay_s), ray_pairs(rays))
    assert fit.delay_sigma_s < 2e-3
    assert abs(fit.delay_s - delay_s) < min(3.0 * fit.delay_sigma_s + 1e-4, 2e-3)


def test_without_common_tracks_nothing_shows_a_delay() -> None:
    segment, rays = segment_of(fly(lively(1, 1.0), points=20))
    fit = fit_turns(segment.inertial, ray_pairs(rays))
    assert (fit.delay_s, fit.gyro_bias.tolist()) == (0.0, [0.0, 0.0, 0.0])
    assert fit.delay_sigma_s >= 0.05


def test_delayed_samples_are_those_of_later_frames() -> None:
    segment, _ = segment_of(fly(lively(1, 1.0), points=20))
    moved = delayed(segment.inertial, 0.012)
    assert len(moved) == len(segment.inertial)
    begin = segment.inertial.timestamp_ns[segment.inertial.sample_start[:-1]]
    np.testing.assert_array_equal(moved.timestamp_ns[moved.sample_start[:-1]], begin + 12_000_000)
    unmoved = delayed(segment.inertial, 0.0)
    np.testing.assert_array_equal(unmoved.timestamp_ns, segment.inertial.timestamp_ns)
    np.testing.assert_allclose(unmoved.accel_gyro, segment.inertial.accel_gyro, atol=1e-12)


@pytest.mark.parametrize("cameras", [1, 2])
def test_the_closed_form_is_exact_without_noise(
    cameras: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(flights, "NOISE_PX", 1e-4)
    flight = fly(lively(4, 2.5), seed=4, cameras=cameras, imu=EXACT, outlier_share=0.0, points=1500)
    segment, rays = segment_of(flight)
    gyro_bias = flight.gyro_bias[0]
    turns = integrate_turns(segment.inertial, gyro_bias)
    motion = solve_motion(segment.inertial, turns, gyro_bias, rays, 0.2)
    assert motion is not None
    times_ns = [frame.time_ns for frame in flight.frames]
    rows = np.searchsorted(times_ns, segment.time_ns)
    q_A_G = so3.inverse(flight.truth.T_G_I[rows[0], :4])
    p_G = flight.truth.T_G_I[rows, 4:]
    # what remains comes from samples at 200 Hz of a smooth motion
    np.testing.assert_allclose(motion.p_A, so3.rotate(q_A_G, p_G - p_G[0]), atol=2e-3)
    np.testing.assert_allclose(motion.v_A, so3.rotate(q_A_G, flight.truth.v_G[rows]), atol=3e-3)
    np.testing.assert_allclose(motion.g_A, so3.rotate(q_A_G, [0.0, 0.0, -9.81]), atol=0.03)
    assert np.linalg.norm(motion.g_A) == pytest.approx(9.81)
    assert motion.share_in_front == 1.0


def test_points_without_parallax_do_not_determine_the_motion() -> None:
    flight = fly(lively(5, 2.0, metres=0.0), seed=5, imu=EXACT, outlier_share=0.0, points=600)
    segment, rays = segment_of(flight)
    turns = integrate_turns(segment.inertial, flight.gyro_bias[0])
    assert solve_motion(segment.inertial, turns, flight.gyro_bias[0], rays, 0.2) is None


@pytest.mark.parametrize(
    "g_A", [[0.0, 0.0, -9.81], [0.0, 0.0, 9.81], [3.0, -4.0, 8.0], [9.81, 0.0, 0.0]]
)
def test_gravity_points_down_in_the_mission_frame(g_A: list[float]) -> None:
    q_M_A = mission_frame(np.array(g_A))
    down = so3.rotate(q_M_A, g_A) / np.linalg.norm(g_A)
    np.testing.assert_allclose(down, [0.0, 0.0, -1.0], atol=1e-12)
    assert np.linalg.norm(q_M_A) == pytest.approx(1.0)
