"""Worlds with places that look alike, and streets: what repeats, what differs, and where one can walk."""

import dataclasses

import numpy as np
import pytest

from maplab_py.errors import UserError
from maplab_py.simulation.motion import check_free_way, motion_spline
from maplab_py.simulation.scenario import MotionOptions, Scenario, SessionOptions, WorldOptions
from maplab_py.simulation.scenario_file import check_scenario, load_scenario
from maplab_py.simulation.world import block_boxes, make_world, street_bounds, street_route

ROOMS = WorldOptions(
    rooms=3,
    corridor_rooms=(1,),
    room_size_m=(7.0, 6.0, 3.0),
    landmarks_per_room=600,
    identical_rooms=True,
    distinct_share=0.0,
)
CITY = WorldOptions(
    layout="city",
    blocks=(3, 2),
    room_size_m=(18.0, 14.0, 9.0),
    corridor_width_m=6.0,
    landmarks_per_room=400,
)


def test_a_corridor_between_rooms_that_look_alike_looks_like_neither() -> None:
    world = make_world(ROOMS, np.random.default_rng(0))
    room = np.round(world.p_G[:, 0] / 7.0).astype(int)
    looks = [set(world.look[room == k].tolist()) for k in range(3)]
    assert len(looks[0] & looks[2]) > 550
    assert not looks[1] & (looks[0] | looks[2])
    assert np.abs(world.p_G[room == 1, 1]).max() < 1.3


@pytest.mark.parametrize("name", ["two_alike_rooms", "alike_floors", "city"])
def test_every_session_has_a_free_way(name: str) -> None:
    scenario = load_scenario(name)
    world = make_world(scenario.world, np.random.default_rng(1))
    for session in scenario.sessions:
        spline = motion_spline(session, scenario.world, np.random.default_rng(2))
        check_free_way(spline, world, "sessions")


def test_floors_that_look_alike_repeat_what_is_not_cut_by_stairs() -> None:
    options = dataclasses.replace(load_scenario("alike_floors").world, landmarks_per_room=1000)
    world = make_world(options, np.random.default_rng(0))
    looks, count = np.unique(world.look, return_counts=True)
    np.testing.assert_array_equal(looks, np.arange(len(looks)))
    single = np.isin(world.look, looks[count == 1])
    assert 0.0 < single.mean() < 0.1
    assert np.all(np.abs(world.normal_G[single, 2]) > 0.5)  # floors and ceilings at the stairs
    pairs = np.flatnonzero(np.isin(world.look, looks[count == 2]))
    order = pairs[np.argsort(world.look[pairs], kind="stable")].reshape(-1, 2)
    np.testing.assert_allclose(
        world.p_G[order[:, 1]] - world.p_G[order[:, 0]], [[0.0, 0.0, 3.0]] * len(order), atol=1e-9
    )
    others = make_world(
        dataclasses.replace(options, identical_floors=False), np.random.default_rng(0)
    )
    assert len(np.unique(others.look)) == len(others.look)


def test_landmarks_of_a_city_are_on_facades_and_pavement() -> None:
    world = make_world(CITY, np.random.default_rng(0))
    boxes = block_boxes(CITY)
    assert len(boxes) == 6
    inside = np.all(
        (world.p_G[:, None] > boxes[:, 0] + 1e-4) & (world.p_G[:, None] < boxes[:, 1] - 1e-4),
        axis=2,
    )
    assert not inside.any()
    on_ground = world.p_G[:, 2] < 1e-4
    assert 0.1 < on_ground.mean() < 0.6
    low, high = street_bounds(CITY)
    assert np.all(world.p_G >= low - 1e-6)
    assert np.all(world.p_G <= high + 1e-6)


def test_a_route_goes_round_its_blocks_in_the_middle_of_the_streets() -> None:
    route = street_route(CITY, (1, 0), (2, 1))
    np.testing.assert_allclose(route.min(axis=0), [12.0, -10.0], atol=1e-6)
    np.testing.assert_allclose(route.max(axis=0), [60.0, 30.0], atol=1e-6)
    step = np.diff(np.concatenate([route, route[:1]]), axis=0)
    assert np.linalg.norm(step, axis=1).max() < 0.06
    x, y = route.T
    area = 0.5 * np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)
    assert area == pytest.approx(48.0 * 40.0 - (4.0 - np.pi) * 2.0**2, rel=1e-3)


@pytest.mark.parametrize(
    ("world", "motion", "message"),
    [
        (CITY, {"kind": "room_scan"}, "room_scan needs world.layout: rooms"),
        (CITY, {"kind": "hover"}, "in a city only streets is possible"),
        (CITY, {"kind": "streets", "last_block": (3, 0)}, "must be blocks of world.blocks"),
        (CITY, {"kind": "streets", "first_block": (2, 0), "last_block": (1, 0)}, "in order"),
        (CITY, {"kind": "streets", "height_m": 0.1}, "through the ground"),
        (ROOMS, {"kind": "streets"}, "streets needs world.layout: city"),
        (dataclasses.replace(CITY, blocks=(0, 2)), {"kind": "streets"}, "world.blocks"),
        (
            dataclasses.replace(ROOMS, corridor_rooms=(3,)),
            {},
            "corridor_rooms: must be from 0 to 2",
        ),
        (dataclasses.replace(ROOMS, corridor_rooms=(0, 1, 2)), {}, "leaves no room"),
        (dataclasses.replace(ROOMS, corridor_width_m=9.0), {}, "corridor_width_m"),
    ],
)
def test_worlds_that_cannot_be_are_refused(world, motion, message) -> None:
    session = SessionOptions(**dataclasses.asdict(MotionOptions(**motion)))
    with pytest.raises(UserError, match=message):
        check_scenario(Scenario(world=world, sessions=(session,)))
