"""What a tracker gets wrong: drifting tracks, moving things, rolling shutters, coarse octaves."""

import dataclasses

import numpy as np
import pytest

from maplab_py.geometry import se3
from maplab_py.sensors.projection import project
from maplab_py.simulation import detection
from maplab_py.simulation import scenario as sim
from maplab_py.simulation.detection import drifts
from maplab_py.simulation.simulate import SimulatedData, simulate
from maplab_py.simulation.world import make_world
from maplab_py.vimap import consistency, tables
from tests.simulation.small import PERFECT, SMALL


def _errors(data: SimulatedData) -> np.ndarray:
    """Return measured minus noiseless pixels of the tracked keypoints of the first session."""
    keypoints = data.maps[0].keypoints
    true = data.truth.keypoint_uv_px[: len(keypoints)]
    point = data.truth.keypoint_point[: len(keypoints)]
    return (keypoints.uv_px - true)[point >= 0]


def _simulate(**measurement: float) -> SimulatedData:
    options = dataclasses.replace(SMALL.measurement, **measurement)
    return simulate(dataclasses.replace(SMALL, measurement=options, sessions=SMALL.sessions[:1]))


def test_drifting_tracks_slide_away() -> None:
    assert np.abs(_errors(_simulate(keypoint_sigma_px=0.5))).max() < 4.0
    data = _simulate(keypoint_sigma_px=0.5, track_drift_share=0.3, track_drift_px=2.0)
    error = np.linalg.norm(_errors(data), axis=1)
    assert 0.05 < np.mean(error > 4.0) < 0.3
    assert consistency.check_consistency(data.maps[0]).errors == ()


def test_a_drift_begins_on_the_point_and_is_a_random_walk() -> None:
    track = np.repeat(np.arange(4000), 10)
    frame = np.tile(np.arange(10), 4000)
    walk = drifts(track, frame, 0.5, 0.4, np.random.default_rng(0)).reshape(4000, 10, 2)
    assert not walk[:, 0].any()
    moving = walk[:, -1].any(axis=1)
    assert np.mean(moving) == pytest.approx(0.5, abs=0.03)
    assert not walk[~moving].any()
    assert np.std(walk[moving, 9]) == pytest.approx(0.4 * 3.0, rel=0.05)


def test_coarse_octaves_are_found_near_by_and_are_less_exact() -> None:
    data = _simulate(octaves=4, keypoint_sigma_px=0.4)
    keypoints = data.maps[0].keypoints
    point = data.truth.keypoint_point[: len(keypoints)] >= 0
    sigma, error = keypoints.sigma_px[point], _errors(data)
    levels = np.unique(np.round(sigma, 9))
    np.testing.assert_allclose(levels, 0.4 * np.sqrt(2.0) ** np.arange(4))
    for level in levels:
        own = np.isclose(sigma, level)
        assert np.std(error[own]) == pytest.approx(level, rel=0.06)
    assert np.all(np.diff(np.unique(keypoints.scale)) > 0.0)


ROLLING = dataclasses.replace(
    PERFECT,
    cameras=(sim.CameraOptions(line_delay_s=4e-5),),
    sessions=(sim.SessionOptions(duration_s=6.0),),
)


def test_rolling_shutter_shows_each_row_at_its_time() -> None:
    data = simulate(ROLLING)
    vi_map, truth = data.maps[0], data.truth
    assert np.all(vi_map.frames.present & tables.FrameField.TIME_OFFSET)
    offset_s = vi_map.keypoints.time_offset_ns[:, 0] * 1e-9
    np.testing.assert_allclose(offset_s, 4e-5 * (vi_map.keypoints.uv_px[:, 1] - 240.0), atol=1e-9)
    # the true motion is known at every IMU sample: interpolate it to the time of each keypoint
    vertex = vi_map.keypoint_vertex
    begin = truth.sample_time_ns[0]
    sample_s = (truth.sample_time_ns - begin) * 1e-9
    wanted = (vi_map.vertices.timestamp_ns[vertex] - begin) * 1e-9 + offset_s
    use = (wanted > 0.0) & (wanted < sample_s[-1])
    row = np.searchsorted(sample_s, wanted[use], side="right") - 1
    dt = wanted[use] - sample_s[row]
    start = truth.sample_T_G_I[row]
    gyro = vi_map_rates(truth.sample_T_G_I, sample_s)[row]
    move = truth.sample_v_G[row] * dt[:, None]
    T_G_I = se3.retract(start, np.concatenate([move, gyro * dt[:, None]], axis=1))
    rig = next(s for s in vi_map.sensors.sensors.values() if hasattr(s, "cameras"))
    T_G_C = se3.compose(T_G_I, rig.T_B_C[0])
    point = truth.point_G[truth.keypoint_point[use]]
    uv, _ = project(rig.cameras[0], se3.transform(se3.inverse(T_G_C), point))
    np.testing.assert_allclose(uv, vi_map.keypoints.uv_px[use], atol=0.02)
    # with a global shutter the difference is of the order of pixels
    T_G_C = se3.compose(truth.T_G_I[vertex[use]], rig.T_B_C[0])
    uv, _ = project(rig.cameras[0], se3.transform(se3.inverse(T_G_C), point))
    assert np.abs(uv - vi_map.keypoints.uv_px[use]).max() > 1.0


def vi_map_rates(T_G_I: np.ndarray, time_s: np.ndarray) -> np.ndarray:
    """Return angular velocities (N, 3) between samples, the last one repeated."""
    step = se3.local(T_G_I[:-1], T_G_I[1:])[:, 3:] / np.diff(time_s)[:, None]
    return np.concatenate([step, step[-1:]])


MOVING = dataclasses.replace(
    PERFECT,
    world=sim.WorldOptions(landmarks_per_room=800, moving_objects=4, landmarks_per_object=150),
    measurement=sim.MeasurementOptions(
        frame_rate_hz=5.0, keypoint_sigma_px=0.0, identity_swap_share=0.0, clutter_share=0.0
    ),
    sessions=(sim.SessionOptions(duration_s=8.0, turns=0.3),),
)


def test_moving_objects_are_seen_where_they_are() -> None:
    data = simulate(MOVING)
    vi_map, truth = data.maps[0], data.truth
    moving = truth.point_moving[truth.keypoint_point] >= 0
    assert 0.02 < np.mean(moving) < 0.8
    rig = next(s for s in vi_map.sensors.sensors.values() if hasattr(s, "cameras"))
    T_G_C = se3.compose(truth.T_G_I[vi_map.keypoint_vertex], rig.T_B_C[0])
    world = make_world(MOVING.world, np.random.default_rng([1, 0]))
    np.testing.assert_array_equal(world.p_G, truth.point_G)
    p_G = truth.point_G[truth.keypoint_point]
    still = project(rig.cameras[0], se3.transform(se3.inverse(T_G_C), p_G))[0]
    error = np.linalg.norm(still - vi_map.keypoints.uv_px, axis=1)
    assert error[~moving].max() < 1e-9
    assert np.median(error[moving]) > 5.0
    seconds = (vi_map.vertices.timestamp_ns - vi_map.vertices.timestamp_ns[0]) * 1e-9
    for number, mover in enumerate(world.objects):
        own = truth.point_moving[truth.keypoint_point] == number
        p_G[own] += mover.displacement(seconds[vi_map.keypoint_vertex[own]])
    there = project(rig.cameras[0], se3.transform(se3.inverse(T_G_C), p_G))[0]
    np.testing.assert_allclose(there, vi_map.keypoints.uv_px, atol=1e-9)


def test_objects_stay_inside_and_keep_their_speed() -> None:
    world = make_world(MOVING.world, np.random.default_rng(3))
    time = np.arange(0.0, 60.0, 0.05)
    for number, mover in enumerate(world.objects):
        p = world.p_G[world.moving == number]
        moved = mover.displacement(time)
        assert np.all(p.min(axis=0) + moved.min(axis=0) > world.bounds[0] - 1e-5)
        assert np.all(p.max(axis=0) + moved.max(axis=0) < world.bounds[1] + 1e-5)
        speed = np.linalg.norm(np.diff(moved, axis=0), axis=1).mean() / 0.05
        assert speed < 0.6


def test_what_is_out_of_reach_is_left_out_without_a_difference(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    city = sim.WorldOptions(
        layout="city", blocks=(4, 1), room_size_m=(18.0, 14.0, 9.0), corridor_width_m=6.0
    )
    walk = sim.SessionOptions(kind="streets", duration_s=20.0, turns=0.2, last_block=(3, 0))
    scenario = dataclasses.replace(SMALL, world=city, sessions=(walk,))
    data = simulate(scenario)
    everywhere = np.full(3, -np.inf), np.full(3, np.inf)
    monkeypatch.setattr(detection, "_reach", lambda eyes, distance_m: everywhere)
    keypoints = simulate(scenario).maps[0].keypoints
    assert len(keypoints) > 1000
    np.testing.assert_array_equal(data.maps[0].keypoints.uv_px, keypoints.uv_px)
    np.testing.assert_array_equal(data.maps[0].keypoints.descriptor, keypoints.descriptor)
