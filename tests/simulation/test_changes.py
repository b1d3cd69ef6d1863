"""Worlds that change between sessions."""

import dataclasses

import numpy as np
import pytest

from maplab_py.errors import UserError
from maplab_py.simulation.changes import visible_in_light, with_changes
from maplab_py.simulation.scenario import ChangeOptions, WorldOptions
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.simulation.simulate import SessionSimulator
from maplab_py.simulation.world import make_world

OPTIONS = WorldOptions(rooms=2, landmarks_per_room=400, furniture_per_room=4)
SESSIONS = 6


def changing_world(changes: ChangeOptions):
    rng = np.random.default_rng(3)
    return with_changes(make_world(OPTIONS, rng), OPTIONS, changes, SESSIONS, rng)


def test_furniture_that_moves_keeps_its_points_and_its_look() -> None:
    world = changing_world(ChangeOptions(moved_share=0.3))
    assert (world.has_box.sum(axis=1) == world.has_box[0].sum()).all()
    assert (world.exists.sum(axis=1) == world.exists[0].sum()).all()
    assert len(world.boxes) > world.has_box[0].sum()
    for session in range(SESSIONS):
        here = world.exists[session]
        assert len(np.unique(world.look[here])) == here.sum()
    moved = np.flatnonzero(~world.exists[0])
    boxes = world.boxes
    margin = 1e-4
    on_box = np.any(
        np.all(
            (world.p_G[moved, None] > boxes[None, :, 0] - margin)
            & (world.p_G[moved, None] < boxes[None, :, 1] + margin),
            axis=2,
        ),
        axis=1,
    )
    assert on_box.all()


def test_posters_and_a_refurbishment_replace_points_by_others() -> None:
    changes = ChangeOptions(replaced_posters=1, refurbished_session=4)
    world = changing_world(changes)
    lost = (world.exists[:-1] & ~world.exists[1:]).sum(axis=1)
    assert (lost > 0).all()
    assert lost[3] == lost.max()
    fresh = world.exists[-1] & ~world.exists[0]
    assert not np.isin(world.look[fresh], world.look[world.exists[0]]).any()


def test_a_share_of_the_points_is_seen_in_one_light_only() -> None:
    world = changing_world(ChangeOptions(moved_share=0.1, single_light_share=0.4))
    seen = [visible_in_light(world, light) for light in (0, 1)]
    assert 0.1 < (~seen[0]).mean() < 0.3
    assert (seen[0] | seen[1]).all()


def test_only_furnished_rooms_change() -> None:
    rng = np.random.default_rng(0)
    city = dataclasses.replace(OPTIONS, layout="city")
    world, changes = make_world(city, rng), ChangeOptions(moved_share=0.1)
    with pytest.raises(UserError, match="only worlds of rooms"):
        with_changes(world, city, changes, 2, rng)
    with pytest.raises(UserError, match="moving_objects: 0"):
        with_changes(world, dataclasses.replace(OPTIONS, moving_objects=1), changes, 2, rng)


def test_lidars_and_images_do_not_show_changes() -> None:
    scenario = load_scenario("office_year")
    lidar = dataclasses.replace(scenario.lidar, rate_hz=2.0)
    images = dataclasses.replace(scenario.images, render=True)
    for shown in ({"lidar": lidar}, {"images": images}):
        with pytest.raises(UserError, match="neither lidars nor rendered images"):
            SessionSimulator(dataclasses.replace(scenario, **shown))


def test_sessions_of_a_year_see_the_world_of_their_day() -> None:
    scenario = load_scenario("office_year")
    short = dataclasses.replace(scenario.sessions[1], duration_s=4.0)
    scenario = dataclasses.replace(scenario, sessions=(short,) * 3)
    simulator = SessionSimulator(scenario)
    first, last = simulator.session(0), simulator.session(2)
    gap_ns = last.vi_map.vertices.timestamp_ns[0] - first.vi_map.vertices.timestamp_ns[0]
    assert gap_ns == pytest.approx(24 * 86_400e9, rel=1e-6)
    for number, session in ((0, first), (2, last)):
        shown = session.truth.keypoint_point
        assert simulator.world.exists[number][shown[shown >= 0]].all()
