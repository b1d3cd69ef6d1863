"""Landmarks lie on surfaces and look into the room; boxes hide what is behind them."""

from __future__ import annotations

import numpy as np
import pytest

from maplab_py.simulation.scenario import WorldOptions
from maplab_py.simulation.world import is_hidden, make_world


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
    assert world.extent_m[0] == rooms * size[0]


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
