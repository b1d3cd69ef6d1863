"""Cameras of pages: a map that grows stays in the picture, unless somebody has moved the camera."""

import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from maplab_py.viewer.display.camera import (
    FIELD_OF_VIEW_RAD,
    Cameras,
    share_of_picture,
    view_of,
    window_of,
)
from maplab_py.viewer.scene import Extent


def extent(radius_m: float, centre: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Extent:
    rng = np.random.default_rng(0)
    outline = np.asarray(centre) + radius_m * rng.uniform(-1.0, 1.0, (40, 3)) * [1.0, 0.6, 0.2]
    return Extent(np.asarray(centre), radius_m, centre[2], outline)


def page(number: int, width_px: int = 1440, height_px: int = 900) -> Any:
    heard: list[Callable[[Any], None]] = []
    camera = SimpleNamespace(
        position=np.zeros(3), look_at=np.zeros(3), aspect=width_px / height_px,
        on_update=heard.append, heard=heard,
    )  # fmt: skip
    return SimpleNamespace(client_id=number, camera=camera, atomic=threading.Lock)


@pytest.mark.parametrize("room", [1.0, 1.25, 2.0])
@pytest.mark.parametrize("radius_m", [0.3, 40.0])
def test_a_view_shows_everything_beside_the_panel(radius_m: float, room: float) -> None:
    seen = extent(radius_m, (5.0, -2.0, 1.0))
    share = share_of_picture(seen, *view_of(seen, beside_panel=True, room=room))
    assert 0.75 / room < share <= 1.0 / room
    position, target = view_of(seen, beside_panel=True)
    assert share_of_picture(seen, target, position) == np.inf  # it looks away


def share(camera: Any, radius_m: float) -> float:
    return share_of_picture(extent(radius_m), camera.position, camera.look_at, window_of(camera))


@pytest.mark.parametrize("size_px", [(1440, 900), (800, 900), (390, 844), (2560, 800)])
def test_a_page_of_any_form_is_filled(size_px: tuple[int, int]) -> None:
    pages = {1: page(1, *size_px)}
    server = SimpleNamespace(
        initial_camera=SimpleNamespace(),
        get_clients=lambda: pages,
        on_client_connect=lambda _: None,
    )
    cameras = Cameras(server)
    cameras.show_all(extent(0.02))
    for radius_m in np.geomspace(0.02, 60.0, 40):
        cameras.keep_in_view(extent(radius_m))
        assert 0.65 <= share(pages[1].camera, radius_m) <= 1.0


def test_pages_follow_a_map_that_grows_until_they_are_moved() -> None:
    pages = {3: page(3), 7: page(7)}
    server = SimpleNamespace(
        initial_camera=SimpleNamespace(),
        get_clients=lambda: pages,
        on_client_connect=lambda _: None,
    )
    cameras = Cameras(server)
    cameras.show_all(extent(0.02))  # before the device moves
    assert pages[7].camera.far >= 100.0
    cameras.show_all(extent(1.0))
    pages[7].camera.position = np.add(
        pages[7].camera.position, [0.5, 0.0, 0.0]
    )  # its user turns it
    moved = pages[7].camera.position.copy()
    looks = []
    for radius_m in (1.02, 2.0, 2.1, 9.0, 2.0):
        cameras.keep_in_view(extent(radius_m))
        looks.append(pages[3].camera.position.copy())
        assert 0.65 <= share(pages[3].camera, radius_m) <= 1.0
        np.testing.assert_array_equal(pages[7].camera.position, moved)
        new = server.initial_camera
        seen = share_of_picture(extent(radius_m), np.array(new.position), np.array(new.look_at))
        assert 0.65 <= seen <= 1.0
    np.testing.assert_array_equal(looks[1], looks[2])  # there is room for growth
    pages[9] = page(9)
    pages[9].camera.position = np.array(server.initial_camera.position)  # opened since
    cameras.keep_in_view(extent(30.0))
    np.testing.assert_array_equal(pages[9].camera.position, pages[3].camera.position)
    assert pages[7].camera.far == pages[3].camera.far == pytest.approx(3000.0)
    cameras.show_all(extent(1.0))  # another map is for all
    np.testing.assert_array_equal(pages[7].camera.position, pages[3].camera.position)


def test_a_page_that_tells_late_where_it_was_put_is_not_moved() -> None:
    pages = {3: page(3)}
    server = SimpleNamespace(
        initial_camera=SimpleNamespace(),
        get_clients=lambda: pages,
        on_client_connect=lambda _: None,
    )
    cameras = Cameras(server)
    cameras.show_all(extent(1.0))
    first = pages[3].camera.position.copy()
    cameras.keep_in_view(extent(9.0))
    pages[3].camera.position = first
    cameras.keep_in_view(extent(30.0))
    assert share_of_picture(extent(30.0), pages[3].camera.position, pages[3].camera.look_at) > 0.5


@pytest.mark.parametrize(
    ("size_px", "right", "lower"),
    [((390, 844), 1.0, -0.16), ((800, 900), 0.15, -1.0), ((900, 700), 0.41, -1.0)],
    ids=["a phone, above its sheet", "a tablet, beside the panel", "a small window"],
)
def test_narrow_pages_see_everything(size_px: tuple[int, int], right: float, lower: float) -> None:
    seen = extent(4.0, (5.0, -2.0, 1.0))
    pages = {1: page(1, *size_px)}
    connected: list[Callable[[Any], None]] = []
    server = SimpleNamespace(
        initial_camera=SimpleNamespace(),
        get_clients=lambda: pages,
        on_client_connect=connected.append,
    )
    cameras = Cameras(server)
    cameras.show_all(seen)
    pages[2] = page(2, 300, 150)  # a page tells this before it is laid out
    pages[2].camera.position = np.array(server.initial_camera.position)
    connected[0](pages[2])
    pages[2].camera.aspect = 0.0  # and this while it is folded away
    pages[2].camera.heard[0](pages[2].camera)
    assert np.isfinite(pages[2].camera.position).all()
    pages[2].camera.aspect = size_px[0] / size_px[1]
    pages[2].camera.heard[0](pages[2].camera)
    aspect = size_px[0] / size_px[1]
    for each in pages.values():
        back = each.camera.position - each.camera.look_at
        back /= np.linalg.norm(back)
        across = np.cross([0.0, 0.0, 1.0], back)
        across /= np.linalg.norm(across)
        axes = np.stack([across, np.cross(back, across), back])
        p = (seen.outline - each.camera.position) @ axes.T
        at = p[:, :2] / (-p[:, 2:] * np.tan(0.5 * FIELD_OF_VIEW_RAD) * [aspect, 1.0])
        assert -1.0 < at[:, 0].min() < at[:, 0].max() < right + 1e-6
        assert lower - 1e-6 < at[:, 1].min() < at[:, 1].max() < 1.0
        assert (0.5 * np.ptp(at, axis=0) / [0.5 * (right + 1.0), 0.5 * (1.0 - lower)]).max() > 0.7
    before = pages[2].camera.position
    cameras.keep_in_view(extent(30.0))  # nobody has moved it
    assert np.linalg.norm(pages[2].camera.position - before) > 10.0
