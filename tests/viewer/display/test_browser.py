"""The page in a real browser."""

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from maplab_py.viewer import colours
from maplab_py.viewer.building import Subject
from maplab_py.viewer.display.viewer import Viewer
from maplab_py.viewer.layers.clouds import Cloud
from maplab_py.viewer.options import PlaybackOptions, VisualizationOptions
from maplab_py.viewer.scene import Entity
from tests.viewer.display.browsing import (
    IN_BROWSER,
    Page,
    chromium,
    colour_count,
    is_blank,
    is_drawn_at,
    place_on_page,
)
from tests.vimap.builders import walk_map

pytestmark = IN_BROWSER

MAP = walk_map(vertices=14, landmarks=300, seed=3)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as started:
        yield started


SUBJECT = Subject(MAP, "walk", VisualizationOptions(scale=2.0))


@pytest.fixture(scope="module")
def running() -> Iterator[Viewer]:
    viewer = Viewer(0)
    yield viewer
    viewer.stop()


@pytest.fixture
def viewer(running: Viewer) -> Viewer:
    """The viewer as it is at first."""
    running.set_dark(False)
    running.selections.set_measuring(False)
    running.selections.clear()
    running.show(SUBJECT, playback=PlaybackOptions(steps=20))
    running.look_at_everything()
    return running


@pytest.fixture(scope="module")
def shared_page(browser: Any, running: Viewer) -> Iterator[Page]:
    running.show(SUBJECT)
    opened = Page(browser, running.url)
    assert opened.wait_until(lambda: running.pages == 1)
    yield opened
    opened.page.close()


@pytest.fixture
def page(shared_page: Page, viewer: Viewer) -> Page:
    shared_page.settle(1200)
    shared_page.still_picture()
    return shared_page


def drag_slider(page: Page, start: float, end: float) -> None:
    """Pull the handle with the mouse: its arrow keys would turn the view as well."""
    row = page.page.locator("xpath=//*[text()='time [s]']/ancestor::*[.//*[@role='slider']][1]")
    thumb = row.get_by_role("slider").first
    thumb.scroll_into_view_if_needed()
    box = thumb.locator("xpath=..").bounding_box()
    y = box["y"] + 0.5 * box["height"]
    at = [box["x"] + share * box["width"] for share in (start, end)]
    page.page.mouse.move(at[0], y)
    page.page.mouse.down()
    page.page.mouse.move(0.5 * (at[0] + at[1]), y)
    page.page.mouse.move(at[1], y)
    page.page.mouse.up()


@pytest.fixture
def other_viewer() -> Iterator[Viewer]:
    """A viewer for one test, which may move its windows."""
    viewer = Viewer(0)
    viewer.show(SUBJECT, playback=PlaybackOptions(steps=20))
    yield viewer
    viewer.stop()


@pytest.fixture
def other_page(browser: Any, other_viewer: Viewer) -> Iterator[Page]:
    opened = Page(browser, other_viewer.url)
    assert opened.wait_until(lambda: other_viewer.pages == 1)
    other_viewer.look_at_everything()
    opened.settle(1200)
    opened.still_picture()
    yield opened
    opened.page.close()


def test_the_page_shows_the_map_and_asks_nobody_else(page: Page, viewer: Viewer) -> None:
    assert page.wait_until(lambda: not is_blank(page.picture()))
    # lines and points have the colours that they were given
    assert page.wait_until(lambda: colour_count(page.picture(), colours.MISSIONS[0]) > 200)
    assert page.outside_requests(viewer.url) == []
    assert page.errors == []
    assert page.page.get_by_text("1 mission").count() == 1


def test_checkboxes_toggle_layers(page: Page, viewer: Viewer) -> None:
    before = page.still_picture()
    page.click(page.checkbox("Landmarks 300"))
    assert page.wait_until(lambda: "landmarks" not in viewer.visible_layers)
    pale = colours.mixed(colours.MISSIONS[0], colours.REFERENCE, 0.45)
    many = colour_count(before, pale, 12)
    assert page.wait_until(lambda: colour_count(page.picture(), pale, 12) < 0.5 * many)
    page.click(page.checkbox("Landmarks 300"))
    assert page.wait_until(lambda: "landmarks" in viewer.visible_layers)
    assert page.wait_until(lambda: colour_count(page.picture(), pale, 12) > 0.8 * many)


def test_a_click_picks_the_vertex_under_it(page: Page, viewer: Viewer) -> None:
    row = 7
    viewer.set_layer("loop_closures", False)
    page.page.mouse.click(*place_on_page(viewer, MAP.T_G_I[row, 4:]))
    assert page.wait_until(lambda: viewer.selection.picked is not None)
    picked = viewer.selection.picked
    assert picked is not None
    assert (picked.entity, picked.row) == (Entity.VERTEX, row)
    assert page.wait_until(lambda: page.page.get_by_text(f"{row + 1} of 14").count() == 1)
    assert page.wait_until(lambda: colour_count(page.picture(), colours.PICKED, 70) > 50)


def test_two_picks_measure_a_distance(page: Page, viewer: Viewer) -> None:
    viewer.set_layer("loop_closures", False)
    viewer.selections.set_measuring(True)
    for row in (2, 11):
        page.page.mouse.click(*place_on_page(viewer, MAP.T_G_I[row, 4:]))
        assert page.wait_until(
            lambda row=row: (
                viewer.selection.picked is not None and viewer.selection.picked.row == row
            )
        )
    expected = float(np.linalg.norm(MAP.T_G_I[11, 4:] - MAP.T_G_I[2, 4:]))
    assert viewer.selection.distance_m == pytest.approx(expected, abs=1e-4)
    assert page.wait_until(lambda: page.page.get_by_text(f"{expected:.3f} m").count() >= 1)


def test_the_slider_moves_through_the_mission(other_page: Page, other_viewer: Viewer) -> None:
    """The path is drawn as far as the slider has come; it has 13 pieces and a camera at its head."""
    page, viewer = other_page, other_viewer
    for layer in ("loop_closures", "path_ends"):  # they lie on the path
        viewer.set_layer(layer, False)
    middles = 0.5 * (MAP.T_G_I[1:, 4:] + MAP.T_G_I[:-1, 4:])

    def pieces() -> list[bool]:
        return is_drawn_at(page, viewer, middles, colours.MISSIONS[0])

    assert page.wait_until(lambda: all(pieces()))
    # the time line shall not hide what is looked at
    viewer.playback.time_line.panel.float(x=-15, y=-15, width=320)
    viewer.open_time_line()
    page.settle()
    drag_slider(page, 1.0, 0.0)
    assert page.wait_until(lambda: viewer.player is not None and viewer.player.step == 0)
    assert page.wait_until(lambda: not any(pieces()[3:]))
    drag_slider(page, 0.0, 0.6)
    assert page.wait_until(lambda: viewer.player is not None and viewer.player.step > 0)
    player, duration_s = viewer.player, 1e-9 * np.ptp(MAP.vertices.timestamp_ns)
    assert player is not None
    assert page.wait_until(
        lambda: abs(player.timeline.seconds[player.step] - 0.6 * duration_s) < 0.08 * duration_s
    )
    assert page.wait_until(lambda: all(pieces()[:6]) and not any(pieces()[10:]))
    drag_slider(page, 0.6, 1.0)
    assert page.wait_until(lambda: viewer.player is None)
    assert page.wait_until(lambda: all(pieces()))


def test_a_slow_page_draws_less_while_it_is_turned(page: Page, viewer: Viewer) -> None:
    """Tests draw seldom, so that this page is a slow one."""
    sphere = np.random.default_rng(0).normal(size=(40_000, 3))
    viewer.show(dataclasses.replace(SUBJECT, clouds=(Cloud("dense", sphere),)))

    def drawn() -> int:
        return int(page.page.evaluate("window.__viserTestpoints.rendererInfo.render.points"))

    assert page.wait_until(lambda: drawn() > 40_000)
    resting = page.still_picture()
    page.page.mouse.move(300.0, 400.0)
    page.page.mouse.down()
    fewest = drawn()
    for step in range(60):
        page.page.mouse.move(300.0 + 3.0 * (step % 20), 400.0)
        fewest = min(fewest, drawn())
        if fewest < 30_000:
            break
    page.page.mouse.move(300.0, 400.0)
    page.page.mouse.up()
    assert fewest < 30_000
    assert page.wait_until(lambda: drawn() > 40_000)
    again = page.still_picture()
    assert again.shape == resting.shape
    assert np.count_nonzero((again < 250).all(axis=2)) > 0.5 * np.count_nonzero(
        (resting < 250).all(axis=2)
    )


def test_the_theme_and_the_view_can_be_changed(page: Page, viewer: Viewer) -> None:
    assert page.wait_until(lambda: page.picture().mean() > 200)
    page.click(page.page.get_by_text("View", exact=True))
    page.settle(400)
    page.click(page.page.get_by_text("top", exact=True))
    client = next(iter(viewer.server.get_clients().values()))
    assert page.wait_until(
        lambda: (
            abs(client.camera.position[0] - client.camera.look_at[0]) < 0.2
            and client.camera.position[2] - client.camera.look_at[2] > 3.0
        )
    )
    viewer.set_dark(True)
    assert page.wait_until(lambda: page.picture().mean() < 80)


def test_the_page_follows_the_map(page: Page, viewer: Viewer) -> None:
    before = page.picture()
    T = np.array(MAP.vertices.T_M_I)
    T[:, 5] += np.linspace(0.0, 2.0, len(T))
    moved = MAP.replace(vertices=MAP.vertices.replace(T_M_I=T))
    assert viewer.follow_live(lambda: moved)  # somebody looks, and it was long ago
    assert page.wait_until(lambda: np.abs(page.picture().astype(int) - before).max() > 100)
    page.settle()
    during = page.picture().mean()
    viewer.follow(SUBJECT.replace(vi_map=moved))
    assert viewer.wait(10.0)
    assert page.wait_until(lambda: abs(page.picture().mean() - during) < 3.0)
