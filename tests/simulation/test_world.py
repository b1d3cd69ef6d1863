"""Landmarks lie on surfaces and look into the room; boxes hide what is behind them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from maplab_py.simulation.detection import is_hidden
from maplab_py.simulation.scenario import WorldOptions
from maplab_py.simulation.world import make_world


@pytest.mark.parametrize("rooms", [1, 3])
def test_landmarks_are_on_walls_or_furniture(rooms: int) -> None:
    options = WorldOptions(rooms=rooms, landmarks_per_room=500)
    world = make_world(options, np.random.default_rng(0))
    size = np.array(options.room_size_m)
    local = world.p_G - np.array([size[0], 0, 0]) * np.round(world.p_G[:, :1] / size[0])
    on_wall = np.any(np.abs(np.abs(local - [0, 0, size[2] / 2]) - size / 2) < 1e-5, axis=1)
    low, high = world.boxes[:, 0], world.boxes[:, 1]
    inside = np.all((world.p_G[:, None] > low - 1e-5) & (world.p_G[:, None] < high + 1e-5), axis=2)
    assert np.all(on_wall | inside.any(axis=1))
    assert on_wall.any()
    assert not on_wall.all()
    np.testing.assert_allclose(np.linalg.norm(world.normal_G, axis=1), 1.0)
    np.testing.assert_allclose(world.bounds[1] - world.bounds[0], [rooms * size[0], *size[1:]])
    np.testing.assert_array_equal(world.look, np.arange(len(world.p_G)))


def test_wall_normals_look_inwards() -> None:
    world = make_world(WorldOptions(furniture_per_room=0), np.random.default_rng(0))
    middle = np.array([0.0, 0.0, 1.75])
    assert np.all(np.sum((middle - world.p_G) * world.normal_G, axis=1) > 0.0)


def test_a_box_hides_what_is_behind_and_nothing_else() -> None:
    box = np.array([[[1.0, -1.0, -1.0], [2.0, 1.0, 1.0]]])
    eye = np.zeros((5, 3))
    points = np.array(
        [[3.0, 0, 0], [0.5, 0, 0], [3.0, 4.0, 0], [-3.0, 0, 0], [1.0 - 1e-6, 0.3, 0.3]]
    )
    np.testing.assert_array_equal(is_hidden(box, eye, points), [True, False, False, False, False])


def test_rooms_see_each_other_through_the_doorway_only() -> None:
    options = WorldOptions(rooms=2, furniture_per_room=0)
    world = make_world(options, np.random.default_rng(0))
    eye = np.array([[2.0, 0.0, 1.5], [2.0, 0.0, 1.5]])
    points = np.array([[8.0, 0.0, 1.5], [8.0, 3.9, 1.5]])
    np.testing.assert_array_equal(is_hidden(world.boxes, eye, points), [False, True])
    at_door = np.abs(world.p_G[:, 0] - 5.0) < 1e-3
    in_opening = at_door & (np.abs(world.p_G[:, 1]) < 1.0) & (world.p_G[:, 2] < 2.4)
    assert at_door.any()
    assert not in_opening.any()


def test_identical_rooms_share_their_looks_but_for_a_few_points() -> None:
    options = WorldOptions(
        rooms=3, landmarks_per_room=1000, identical_rooms=True, distinct_share=0.1
    )
    world = make_world(options, np.random.default_rng(0))
    _, first, count = np.unique(world.look, return_index=True, return_counts=True)
    assert np.sum(count == 3) > 800
    assert np.sum(world.look >= 900) > 250
    assert np.all(count[world.look[first] >= 900] == 1)
    repeated = np.flatnonzero(world.look == world.look[first[count == 3][0]])
    places = world.p_G[repeated]
    np.testing.assert_allclose(np.diff(places[:, 0]), options.room_size_m[0])
    np.testing.assert_allclose(np.ptp(places[:, 1:], axis=0), 0.0, atol=1e-12)


CORRIDOR = WorldOptions(
    layout="corridor", floors=3, room_size_m=(20.0, 14.0, 3.0), landmarks_per_room=2000
)


def test_corridors_leave_block_and_stairwells_free() -> None:
    world = make_world(CORRIDOR, np.random.default_rng(0))
    assert world.bounds[1, 2] == 9.0
    block = np.all(np.abs(world.p_G[:, :2]) < np.array([7.5, 4.5]) - 1e-3, axis=1)
    assert not block.any()
    at_slab = np.abs(world.p_G[:, 2] - 3.0) < 1e-3
    in_well = (np.abs(world.p_G[:, 0]) > 7.5 + 1e-3) & (np.abs(world.p_G[:, 1]) < 3.0)
    horizontal = np.abs(world.normal_G[:, 2]) > 0.5
    assert np.any(at_slab & horizontal)
    assert not np.any(at_slab & in_well & horizontal)


def test_floors_see_each_other_through_the_stairwell_only() -> None:
    world = make_world(CORRIDOR, np.random.default_rng(0))
    eye = np.array([[8.75, 0.0, 1.5], [0.0, -5.75, 1.5], [0.0, -5.75, 1.5]])
    points = np.array([[8.75, 1.0, 4.5], [0.0, -5.75, 4.5], [0.0, 5.75, 1.5]])
    np.testing.assert_array_equal(is_hidden(world.boxes, eye, points), [False, True, True])


def test_bare_surfaces_carry_few_landmarks() -> None:
    options = WorldOptions(landmarks_per_room=4000, furniture_per_room=0, patchiness=0.0)
    even = make_world(options, np.random.default_rng(1))
    bare = make_world(dataclasses.replace(options, bare_share=0.5), np.random.default_rng(1))

    def per_side(p: np.ndarray, normal: np.ndarray) -> np.ndarray:
        return np.unique(normal, axis=0, return_counts=True)[1]

    ratio = per_side(bare.p_G, bare.normal_G) / per_side(even.p_G, even.normal_G)
    assert ratio.min() < 0.35
    assert ratio.max() > 1.0
