"""Motions do what their names say, splice without a jerk, and stay out of walls."""

from __future__ import annotations

import numpy as np
import pytest

from maplab_py.errors import UserError
from maplab_py.geometry import so3
from maplab_py.simulation.motion import check_free_way, motion_spline
from maplab_py.simulation.scenario import MotionOptions, SessionOptions, WorldOptions
from maplab_py.simulation.scenario_file import load_scenario, scenario_names
from maplab_py.simulation.spline import MotionState, PoseSpline
from maplab_py.simulation.world import make_world

BUILDING = WorldOptions(layout="corridor", floors=3, room_size_m=(20.0, 16.0, 3.2))


def _spline(options: SessionOptions, world: WorldOptions = WorldOptions()) -> PoseSpline:  # noqa: B008
    return motion_spline(options, world, np.random.default_rng(5))


def _states(options: SessionOptions, world: WorldOptions = WorldOptions()) -> MotionState:  # noqa: B008
    return _spline(options, world).evaluate(np.arange(0.0, options.total_s, 0.02))


def _tilt(state: MotionState) -> np.ndarray:
    return np.degrees(np.arccos(np.clip(so3.to_matrix(state.T_G_I[:, :4])[:, 2, 2], -1.0, 1.0)))


def test_straight_keeps_velocity_and_orientation() -> None:
    state = _states(SessionOptions(kind="straight", duration_s=10.0, speed_mps=0.5))
    np.testing.assert_allclose(np.linalg.norm(state.v_G, axis=1), 0.5, atol=1e-12)
    np.testing.assert_allclose(state.v_G - state.v_G[0], 0.0, atol=1e-12)
    np.testing.assert_allclose(state.a_G, 0.0, atol=1e-11)
    np.testing.assert_allclose(state.w_I, 0.0, atol=1e-12)


def test_rotation_keeps_the_position() -> None:
    state = _states(SessionOptions(kind="rotation", duration_s=10.0, turns=2.0))
    assert not np.any(state.v_G)
    yaw = np.unwrap(np.arctan2(*so3.to_matrix(state.T_G_I[:, :4])[:, [1, 0], 0].T))
    assert yaw[-1] - yaw[0] == pytest.approx(4.0 * np.pi, rel=0.02)
    assert 15.0 < _tilt(state).max() < 40.0


def test_stationary_stands_still() -> None:
    state = _states(SessionOptions(kind="stationary", duration_s=5.0))
    assert not np.any(state.v_G)
    np.testing.assert_allclose(state.w_I, 0.0, atol=1e-13)


def test_vehicle_stays_on_its_plane_and_drives_forwards() -> None:
    state = _states(SessionOptions(kind="vehicle", duration_s=30.0, turns=1.0, height_m=0.4))
    np.testing.assert_allclose(state.T_G_I[:, 6], 0.4, atol=1e-12)
    np.testing.assert_allclose(_tilt(state), 0.0, atol=1e-6)
    v_I = so3.rotate(so3.inverse(state.T_G_I[:, :4]), state.v_G)
    assert np.all(v_I[:, 0] > 0.3)
    assert np.abs(v_I[:, 1]).max() < 0.05


def test_shaking_is_fast_and_hovering_is_slow() -> None:
    shaken = SessionOptions(kind="shake", duration_s=10.0, shake_rad=0.8, shake_hz=1.5)
    rate = np.degrees(np.linalg.norm(_states(shaken).w_I, axis=1))
    assert rate.max() > 300.0
    hover = _states(SessionOptions(kind="hover", duration_s=30.0, shake_m=0.1, shake_rad=0.02))
    assert 0.05 < np.ptp(hover.T_G_I[:, 4:], axis=0).max() < 0.6
    assert np.linalg.norm(hover.v_G, axis=1).max() < 0.3


def test_corridor_visits_every_floor_and_comes_back() -> None:
    options = SessionOptions(
        kind="corridor", duration_s=300.0, turns=4.0, shake_m=0.0, height_swing_m=0.0
    )
    z = _states(options, BUILDING).T_G_I[:, 6] - options.height_m
    for floor in range(3):
        assert np.any(np.abs(z - 3.2 * floor) < 0.01)
    assert z.max() < 6.41
    assert abs(z[-1] - z[0]) < 0.1


def test_loop_through_rooms_passes_the_doorways() -> None:
    world = WorldOptions(rooms=3)
    options = SessionOptions(kind="loop", duration_s=90.0, turns=1.0, shake_m=0.0)
    p = _states(options, world).T_G_I[:, 4:]
    at_door = np.abs(p[:, 0] - 5.0) < 0.05
    assert at_door.any()
    assert np.abs(p[at_door, 1]).max() < 0.9
    assert np.ptp(p[:, 0]) > 24.0
    check_free_way(_spline(options, world), make_world(world, np.random.default_rng(0)), "x")


PHASES = SessionOptions(
    phases=(
        MotionOptions(kind="stationary", duration_s=4.0),
        MotionOptions(kind="room_scan", duration_s=10.0, turns=0.4, start_turn=0.2),
        MotionOptions(kind="rotation", duration_s=8.0, turns=0.7),
        MotionOptions(kind="straight", duration_s=3.0, speed_mps=0.2),
        MotionOptions(kind="shake", duration_s=4.0, shake_rad=0.1, shake_m=0.01),
        MotionOptions(kind="figure_8", duration_s=15.0, turns=0.6),
        MotionOptions(kind="room_scan", duration_s=10.0, turns=0.4),
        MotionOptions(kind="stationary", duration_s=4.0),
    )
)


def test_phases_join_without_a_jerk() -> None:
    state = _states(PHASES)
    assert np.linalg.norm(state.v_G, axis=1).max() < 2.0
    assert np.linalg.norm(state.a_G, axis=1).max() < 4.0
    assert np.degrees(np.linalg.norm(state.w_I, axis=1)).max() < 250.0
    borders = np.cumsum([phase.duration_s for phase in PHASES.phases])[:-1]
    at_border = _spline(PHASES).evaluate(borders)
    assert np.linalg.norm(at_border.v_G, axis=1).max() < 0.1


def test_phases_rest_and_go_on_where_they_stopped() -> None:
    spline = _spline(PHASES)
    rest = spline.evaluate(np.array([1.0, 2.0, 3.0, 55.5, 57.0]))
    np.testing.assert_allclose(rest.v_G, 0.0, atol=1e-12)
    np.testing.assert_allclose(rest.w_I, 0.0, atol=1e-12)
    begin = spline.evaluate(np.array([3.8])).T_G_I[0, 4:]
    angle = 2.0 * np.pi * 0.2
    np.testing.assert_allclose(begin[:2], [2.8 * np.cos(angle), 1.8 * np.sin(angle)], atol=0.4)


@pytest.mark.parametrize(
    ("options", "what"),
    [
        (SessionOptions(kind="straight", duration_s=60.0), "out of the world at"),
        (SessionOptions(wall_distance_m=0.2, duration_s=20.0), "through a wall or furniture at"),
    ],
)
def test_ways_through_walls_are_refused(options: SessionOptions, what: str) -> None:
    world = make_world(WorldOptions(), np.random.default_rng(0))
    with pytest.raises(UserError, match=rf"^sessions\[3\]: the motion leads {what}"):
        check_free_way(_spline(options), world, "sessions[3]")


@pytest.mark.parametrize("name", scenario_names())
def test_the_named_scenarios_keep_clear_of_walls(name: str) -> None:
    scenario = load_scenario(name)
    for seed in (1, 2, 3):
        world = make_world(scenario.world, np.random.default_rng(seed))
        for number, session in enumerate(scenario.sessions):
            rng = np.random.default_rng([seed, number])
            spline = motion_spline(session, scenario.world, rng)
            check_free_way(spline, world, f"{name}: sessions[{number}]")
            state = spline.evaluate(np.arange(0.0, session.total_s, 0.05))
            assert np.linalg.norm(state.w_I, axis=1).max() < 7.0
            assert np.linalg.norm(state.a_G, axis=1).max() < 20.0
