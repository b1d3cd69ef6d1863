"""Motions and their splines: derivatives, no jerk, recorded trajectories."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from maplab_py.errors import UserError
from maplab_py.geometry import se3, so3
from maplab_py.interop.trajectories import Trajectory, write_euroc, write_tum
from maplab_py.simulation.motion import check_free_way, motion_spline
from maplab_py.simulation.scenario import MOTION_KINDS, MotionOptions, SessionOptions, WorldOptions
from maplab_py.simulation.scenario_file import load_scenario, scenario_names
from maplab_py.simulation.simulate import simulate
from maplab_py.simulation.spline import MotionState, PoseSpline
from maplab_py.simulation.trajectory_motion import through, trajectory_spline
from maplab_py.simulation.world import make_world

STEP_S = 1e-3
_WEIGHTS = {-2: 1.0, -1: -8.0, 1: 8.0, 2: -1.0}


def _random_spline(seed: int) -> PoseSpline:
    rng = np.random.default_rng(seed)
    phi = np.cumsum(rng.normal(0.0, 0.3, (20, 3)), axis=0)
    return PoseSpline(se3.make(so3.exp(phi), rng.normal(0.0, 1.0, (20, 3))), 0.2)


def _room_spline(kind: str) -> PoseSpline:
    layout = "corridor" if kind == "corridor" else "rooms"
    world = WorldOptions(layout=layout, floors=2, room_size_m=(20.0, 16.0, 3.5))
    return motion_spline(SessionOptions(kind=kind), world, np.random.default_rng(3))


SPLINES = [_random_spline(0), _random_spline(1), *(_room_spline(kind) for kind in MOTION_KINDS)]


@pytest.mark.parametrize("spline", SPLINES)
def test_derivatives_agree_with_finite_differences(spline: PoseSpline) -> None:
    # away from the knots, where the third derivative jumps
    time = (np.arange(5, 15) + 0.37) * spline.spacing_s
    now = spline.evaluate(time)
    v, a, w, alpha = np.zeros((4, len(time), 3))
    # central differences of fourth order
    for steps, weight in _WEIGHTS.items():
        then = spline.evaluate(time + steps * STEP_S)
        factor = weight / (12.0 * STEP_S)
        v += factor * then.T_G_I[:, 4:]
        a += factor * then.v_G
        w += factor * so3.log(so3.multiply(so3.inverse(now.T_G_I[:, :4]), then.T_G_I[:, :4]))
        alpha += factor * then.w_I
    np.testing.assert_allclose(now.v_G, v, atol=1e-6)
    np.testing.assert_allclose(now.a_G, a, atol=1e-6)
    np.testing.assert_allclose(now.w_I, w, atol=1e-6)
    np.testing.assert_allclose(now.alpha_I, alpha, atol=1e-6)


@pytest.mark.parametrize("spline", SPLINES)
def test_motion_is_continuous_at_knots(spline: PoseSpline) -> None:
    knots = np.arange(1, 10) * spline.spacing_s
    left, right = spline.evaluate(knots - 1e-12), spline.evaluate(knots)
    for name in ("T_G_I", "v_G", "a_G", "w_I", "alpha_I"):
        np.testing.assert_allclose(getattr(left, name), getattr(right, name), atol=1e-8)


@pytest.mark.parametrize("time", [-0.1, 3.5])
def test_times_outside_are_refused(time: float) -> None:
    with pytest.raises(UserError, match=r"lasts from 0 to 3.4 s"):
        _random_spline(0).evaluate([time])


def test_too_few_control_poses_are_refused() -> None:
    with pytest.raises(UserError, match="four control poses"):
        PoseSpline(se3.identity(3), 0.1)


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


HALL = WorldOptions(room_size_m=(20.0, 20.0, 8.0))


def _poses(count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    q = so3.exp(np.cumsum(rng.normal(0.0, 0.15, (count, 3)), axis=0))
    return se3.make(q, np.cumsum(rng.normal(0.0, 0.1, (count, 3)), axis=0))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_spline_passes_through_every_pose(seed: int) -> None:
    poses = _poses(40, seed)
    spline = through(poses, 0.1)
    met = spline.evaluate(np.arange(40) * 0.1).T_G_I
    np.testing.assert_allclose(se3.local(met, poses), 0.0, atol=1e-8)
    assert spline.duration_s >= 3.9


@pytest.mark.parametrize("write", [write_tum, write_euroc])
def test_files_of_both_kinds_give_the_same_motion(tmp_path: Path, write: object) -> None:
    poses = _poses(60)
    times = 1_500_000_000_000_000_000 + np.arange(60) * 100_000_000
    write(Trajectory(times, poses), tmp_path / "t.csv")  # type: ignore[operator]
    options = SessionOptions(trajectory=str(tmp_path / "t.csv"), duration_s=5.0, height_m=2.0)
    spline = trajectory_spline(options, HALL)
    found = spline.evaluate(np.arange(50) * 0.1).T_G_I
    relative = se3.relative(found[:-1], found[1:])
    np.testing.assert_allclose(relative, se3.relative(poses[:49], poses[1:50]), atol=1e-7)
    assert found[0, 6] == pytest.approx(2.0)


def test_a_scenario_finds_its_trajectory_beside_it(tmp_path: Path) -> None:
    count = 80
    angle = np.linspace(0.0, 1.0, count)
    p = np.stack([2.0 * np.cos(angle), 2.0 * np.sin(angle), 0.0 * angle], axis=1)
    q = so3.exp(np.stack([0.0 * angle, 0.0 * angle, angle], axis=1))
    write_tum(Trajectory(np.arange(count) * 100_000_000, se3.make(q, p)), tmp_path / "walk.txt")
    (tmp_path / "mine.yaml").write_text(
        "world: {landmarks_per_room: 600}\nmeasurement: {frame_rate_hz: 4}\n"
        "sessions: [{trajectory: walk.txt, duration_s: 6}]\n"
    )
    data = simulate(load_scenario(tmp_path / "mine.yaml"))
    assert len(data.maps[0].vertices) == 25
    assert np.ptp(data.truth.T_G_I[:, 5]) == pytest.approx(2.0 * np.sin(0.76), abs=0.1)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("nonsense", "sessions.trajectory: "),
        ("0 0 0 0 0 0 0 1\n0.1 0 0 0 0 0 0 1\n", r"sessions.duration_s: .* lasts 0.1 s"),
        ("".join(f"{t} 0 0 0 0 0 0 1\n" for t in (0, 1, 5, 6, 7)), "gap of more than a second"),
    ],
)
def test_files_that_cannot_be_used(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "t.txt").write_text(text)
    options = SessionOptions(trajectory=str(tmp_path / "t.txt"), duration_s=3.0)
    with pytest.raises(UserError, match=message) as caught:
        trajectory_spline(options, HALL)
    assert "\n" not in str(caught.value)
    with pytest.raises(UserError, match=r"sessions\.trajectory"):
        trajectory_spline(dataclasses.replace(options, trajectory="absent.txt"), HALL)
