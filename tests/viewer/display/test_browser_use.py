"""What the viewer leaves behind, and what browsers may do to it, each test with a viewer of its own."""

import dataclasses
import os
import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from maplab_py.algorithms.loop_closure.closure_record import (
    ClosureRecord,
    read_record,
    write_record,
)
from maplab_py.algorithms.loop_closure.closure_table import VERDICTS
from maplab_py.algorithms.loop_closure.reports import Verdict
from maplab_py.geometry import se3
from maplab_py.online_calibration.suggestions import MOTIONS
from maplab_py.viewer import colours
from maplab_py.viewer.building import Subject
from maplab_py.viewer.display import picture
from maplab_py.viewer.display.picture import find_browser
from maplab_py.viewer.display.viewer import Viewer
from maplab_py.viewer.history import State
from maplab_py.viewer.layers.closures import REFUSED
from maplab_py.viewer.options import VisualizationOptions
from maplab_py.viewer.picking import Pick
from maplab_py.viewer.scene import Entity
from maplab_py.vimap import VIMap
from maplab_py.vimap.ids import random_ids
from tests.support.waiting import wait_until
from tests.viewer.display.browsing import IN_BROWSER, Page, chromium, colour_count, is_blank
from tests.vimap.builders import walk_map

pytestmark = IN_BROWSER

MAP = walk_map(vertices=14, landmarks=300, seed=3)
SUBJECT = Subject(MAP, "walk", VisualizationOptions(scale=2.0))


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as started:
        yield started


def _width_px(page: Page, *, turned: bool = False) -> int:
    """Return the width of the picture, after a movement of the mouse if it is to be turned."""
    if turned:
        page.page.mouse.move(300.0, 400.0)
        page.page.mouse.move(320.0, 400.0)
    return int(
        page.page.evaluate(
            "Math.max(...[...document.querySelectorAll('canvas')].map(c => c.width))"
        )
    )


def test_a_view_opens_from_a_file(browser: Any, tmp_path: Path) -> None:
    viewer = Viewer(0)
    viewer.show(SUBJECT)
    target = tmp_path / "view.html"
    size = viewer.export(target)
    assert size == target.stat().st_size < 5_000_000
    viewer.stop()
    page = Page(browser, target.as_uri())
    assert page.wait_until(lambda: colour_count(page.picture(), colours.MISSIONS[0]) > 100)
    assert page.outside_requests("file:") == []
    assert page.page.get_by_text("walk", exact=True).count() == 1
    path = colour_count(page.still_picture(), colours.MISSIONS[0])
    for layer in ("trajectories", "vertices"):
        page.click(page.page.locator(f"input[data-layer={layer}]"))
    assert page.wait_until(
        lambda: colour_count(page.picture(), colours.MISSIONS[0]) < path - 50, 60.0
    )
    hidden = page.still_picture()
    page.click(page.page.locator("input[data-layer=frusta]"))  # not visible when it was written
    assert page.wait_until(lambda: not np.array_equal(page.picture(), hidden), 60.0)

    whole = _width_px(page)  # of the picture at rest; it has fewer pixels while it is turned
    page.page.mouse.move(300.0, 400.0)
    page.page.mouse.down()
    assert page.wait_until(lambda: _width_px(page, turned=True) < 0.6 * whole, 60.0)
    page.page.mouse.up()
    assert page.wait_until(lambda: _width_px(page) == whole, 60.0)
    assert page.errors == []
    page.page.close()


def test_the_history_is_a_slider_in_the_page_and_in_a_file(browser: Any, tmp_path: Path) -> None:
    T = np.array(MAP.vertices.T_M_I)
    T[:, 6] += np.linspace(0.0, 4.0, len(T))
    bent = MAP.replace(vertices=MAP.vertices.replace(T_M_I=T))
    viewer = Viewer(0)
    viewer.show(SUBJECT.replace(history=(State("", bent), State("relax", MAP))))
    page = Page(browser, viewer.url)
    assert page.wait_until(lambda: page.page.get_by_text("2 of 2: relax").count() == 1)
    viewer.set_state(0)
    assert page.wait_until(lambda: page.page.get_by_text("1 of 2: before").count() == 1)
    assert page.wait_until(lambda: page.page.get_by_text("reprojection, median").count() == 1)
    assert viewer.wait()
    assert viewer.drawing.vi_map is bent
    page.page.close()

    viewer.set_state(1)
    assert viewer.wait()
    target = tmp_path / "view.html"
    viewer.export(target)
    viewer.stop()
    page = Page(browser, target.as_uri())
    assert page.wait_until(lambda: colour_count(page.picture(), colours.MISSIONS[0]) > 100)
    now = page.still_picture()
    page.page.locator("input[data-states]").fill("0")
    assert page.wait_until(lambda: not np.array_equal(page.picture(), now), 60.0)
    past = page.still_picture()
    assert colour_count(past, colours.MISSIONS[0]) > 50
    page.page.locator("input[data-states]").fill("1")
    beside = np.s_[:, 320:]  # the slider has the focus now
    assert page.wait_until(lambda: np.array_equal(page.picture()[beside], now[beside]), 60.0)
    assert page.errors == []
    page.page.close()


_CONTRASTS = """[...document.querySelectorAll("label")].filter((label) => label.offsetWidth).map((label) => {
  const light = (colour) => colour.match(/[0-9.]+/g).slice(0, 3).map((c) => c / 255)
    .map((c) => (c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4))
    .reduce((sum, c, i) => sum + c * [0.2126, 0.7152, 0.0722][i], 0);
  const [text, ground] = [getComputedStyle(label).color, getComputedStyle(document.body).backgroundColor]
    .map(light).map((l) => l + 0.05);
  return Math.max(text, ground) / Math.min(text, ground);
})"""
"""Contrast of the words beside widgets (WCAG 2.1)."""


def test_the_panel_suits_phones_and_its_words_can_be_read(browser: Any) -> None:
    viewer = Viewer(0)
    viewer.show(SUBJECT)
    page = Page(browser, viewer.url, (390, 844))
    header = page.page.get_by_text("walk", exact=True)
    assert page.wait_until(lambda: header.count() == 1)
    assert page.wait_until(lambda: header.bounding_box()["y"] > 0.55 * 844)
    assert page.page.locator("div[style*='max-height: 60%']").bounding_box()["width"] == 390
    for width, height in ((800, 600), (1440, 900)):
        page.page.set_viewport_size({"width": width, "height": height})
        # the panel is made again, and has no box meanwhile
        is_beside = lambda w=width: (header.bounding_box() or {"x": 0.0})["x"] > w - 340  # noqa: E731
        assert page.wait_until(is_beside)
    for is_dark in (False, True):
        viewer.set_dark(is_dark)
        page.settle()
        contrasts = page.page.evaluate(_CONTRASTS)
        assert len(contrasts) > 5
        assert min(contrasts) >= 4.5
    assert page.errors == []
    viewer.stop()
    page.page.close()


def test_the_motion_that_a_calibration_lacks_is_asked_for(browser: Any) -> None:
    viewer = Viewer(0)
    viewer.show(SUBJECT)
    page = Page(browser, viewer.url, (390, 844))
    bar = page.page.get_by_role("progressbar", name="calibration known")
    for words, share, tips in ((MOTIONS[0].words, 0.25, 1), (MOTIONS[4].words, 0.75, 2)):
        viewer.motion.show(words, share)
        arrows = page.page.get_by_role("img", name=words)
        assert page.wait_until(lambda a=arrows: a.count() == 1)
        assert page.wait_until(lambda a=arrows: (a.bounding_box() or {"height": 0})["height"] > 60)
        assert arrows.locator("path[marker-end]").count() == tips
        box, filled = bar.bounding_box(), bar.locator("div").bounding_box()
        assert filled["width"] == pytest.approx(share * box["width"], abs=2.0)
        # on a phone it can be seen without scrolling, as soon as the sheet has slid up
        assert page.wait_until(lambda: (b := bar.bounding_box())["y"] + b["height"] < 844)
    viewer.motion.show("", 1.0)
    assert page.wait_until(lambda: page.page.get_by_text("known as well as wanted").count() == 1)
    assert page.page.get_by_role("img", name=MOTIONS[4].words).count() == 0
    assert page.errors == []
    viewer.stop()
    page.page.close()


def test_a_page_has_the_theme_of_its_system_until_another_is_chosen(browser: Any) -> None:
    viewer = Viewer(0)
    viewer.show(SUBJECT)
    light = Page(browser, viewer.url)
    dark = Page(_OfSystem(browser, "dark"), viewer.url)
    assert light.wait_until(lambda: dark.picture().mean() < 80)
    assert light.wait_until(lambda: light.picture().mean() > 200)
    dark.click(dark.page.get_by_text("View", exact=True))
    dark.click(dark.page.get_by_text("light or dark", exact=True))
    assert dark.wait_until(lambda: dark.picture().mean() > 200)
    dark.page.reload()
    assert dark.wait_until(lambda: not is_blank(dark.picture()))
    assert dark.wait_until(lambda: dark.picture().mean() > 200)
    assert light.errors == dark.errors == []
    viewer.stop()
    light.page.close()
    dark.page.context.close()


class _OfSystem:
    """A browser on a system with a theme."""

    def __init__(self, browser: Any, theme: str) -> None:
        self._context = browser.new_context(color_scheme=theme)

    def new_page(self, viewport: dict[str, int]) -> Any:
        page = self._context.new_page()
        page.set_viewport_size(viewport)
        return page


def test_another_state_is_left_of_the_swipe_line(browser: Any) -> None:
    """The path is wide and blue, the landmarks are grey; first the other path is shown, then the map's."""
    viewer = Viewer(0)
    viewer.set_ground(False)  # an axis of it is blue, too
    subject = SUBJECT.replace(
        options=SUBJECT.options.with_colouring("grey"), other=MAP.replace(), arrangement="swipe"
    )
    viewer.show(subject.replace(only_layers=("swiped_trajectories", "landmarks")))
    page = Page(browser, viewer.url)
    line = page.page.locator(".maplab-swipe")
    assert page.wait_until(lambda: line.count() == 1)

    def has_path() -> tuple[bool, bool]:
        picture, cut = page.picture(), round(line.bounding_box()["x"] + 15)
        sides = picture[:, : cut - 20], picture[:, cut + 20 :]
        left, right = (colour_count(side, colours.MISSIONS[0]) > 30 for side in sides)
        return left, right

    def move_line(x: float) -> None:
        page.page.mouse.move(line.bounding_box()["x"] + 15, 300)
        page.page.mouse.down()
        page.page.mouse.move(x, 300, steps=2)
        page.page.mouse.up()
        assert page.wait_until(lambda: abs(line.bounding_box()["x"] + 15 - x) < 2)

    move_line(350)
    assert page.wait_until(lambda: has_path() == (True, False))
    viewer.set_layers({"trajectories", "swiped_landmarks"})
    assert page.wait_until(lambda: has_path() == (False, True))
    move_line(40)
    viewer.set_layers({"swiped_trajectories"})
    assert page.wait_until(lambda: has_path() == (False, False))
    viewer.show(SUBJECT)
    assert page.wait_until(lambda: line.count() == 0)
    assert page.errors == []
    viewer.stop()
    page.page.close()


_OVERFLOWING = """[...document.querySelectorAll(".mantine-ScrollArea-viewport")]
  .filter((area) => area.scrollHeight > area.clientHeight).length"""


def test_the_panel_of_many_layers_needs_no_scrolling(browser: Any) -> None:
    viewer = Viewer(0)
    subject = SUBJECT.replace(other=MAP.replace(), arrangement="beside")
    scene = viewer.show(subject)
    assert len(scene.layers) == 13
    page = Page(browser, viewer.url, (1280, 720))
    assert page.wait_until(lambda: page.page.get_by_text("more layers").count() == 1)
    assert page.wait_until(lambda: page.page.evaluate(_OVERFLOWING) == 0, 30.0)
    assert not page.checkbox("Cameras 14").is_visible()
    page.click(page.page.get_by_text("more layers"))
    assert page.wait_until(lambda: page.checkbox("Cameras 14").is_visible())
    page.click(page.checkbox("Cameras 14"))
    assert page.wait_until(lambda: "frusta" in viewer.visible_layers)
    page.page.close()
    viewer.stop()


def test_pictures_are_saved_with_and_without_a_page(browser: Any, tmp_path: Path) -> None:
    viewer = Viewer(0)
    viewer.show(SUBJECT)
    alone = tmp_path / "alone.png"
    assert viewer.save_picture(alone, (640, 480), "top") == 0
    image = cv2.imread(str(alone))
    assert image is not None
    assert image.shape == (480, 640, 3)
    assert not is_blank(image)
    assert colour_count(image[:, :, ::-1], colours.MISSIONS[0]) > 100
    page = Page(browser, viewer.url)
    assert page.wait_until(lambda: viewer.pages == 1)
    page.settle()
    results: list[int] = []
    taker = threading.Thread(
        target=lambda: results.append(viewer.save_picture(tmp_path / "page.jpg", (400, 300)))
    )
    taker.start()
    assert page.wait_until(lambda: bool(results))
    taker.join()
    assert results == [1]
    page.page.close()
    shown = cv2.imread(str(tmp_path / "page.jpg"))
    assert shown is not None
    assert shown.shape == (300, 400, 3)
    viewer.stop()


def test_a_killed_browser_does_no_harm(capfd: pytest.CaptureFixture[str]) -> None:
    viewer = Viewer(0)
    viewer.show(SUBJECT)
    path = find_browser()
    assert path is not None
    with picture.headless_browser(path, viewer.url, (300, 200)) as process:
        assert wait_until(lambda: viewer.pages == 1, 60.0)
        os.killpg(process.pid, signal.SIGKILL)
        assert wait_until(lambda: viewer.pages == 0, 60.0)
    viewer.follow(SUBJECT.replace(vi_map=MAP.replace()))
    assert viewer.wait(10.0)
    viewer.stop()
    assert capfd.readouterr() == ("", "")


def _with_closures() -> VIMap:
    """Return the map with three recorded closures, the last two refused for different reasons."""
    count = 3
    closures = ClosureRecord.filled(
        count,
        id=random_ids(count, np.random.default_rng(0)),
        query=MAP.vertices.id[[0, 1, 2]],
        place=MAP.vertices.id[[11, 12, 13]],
        T_A_B=se3.relative(MAP.T_G_I[[0, 1, 2]], MAP.T_G_I[[11, 12, 13]]),
        matches=np.full(count, 40, dtype=np.int32),
        inliers=np.array([30, 5, 30], dtype=np.int32),
        tilt_deg=np.array([0.1, 0.1, 9.0], dtype=np.float32),
        verdict=np.array(
            [VERDICTS.index(v) for v in (Verdict.ACCEPTED, Verdict.FEW_INLIERS, Verdict.TILTED)],
            dtype=np.int8,
        ),
    )
    return write_record(MAP, dataclasses.replace(read_record(MAP), closures=closures))


_FAINT = """() => {
  let faint = 0;
  const nodes = window.__viserMutable.nodeRefFromName;
  Object.keys(nodes).filter((name) => name.startsWith("/map/refused_closures/")).forEach((name) =>
    nodes[name].traverse(({ isLineSegments2, material }) => {
      if (isLineSegments2 && material.transparent && material.opacity < 0.5) faint += 1;
    }));
  return faint;
}"""


def test_refused_closures_are_faint_and_tell_why(browser: Any) -> None:
    vi_map = _with_closures()
    viewer = Viewer(0)
    viewer.show(Subject(vi_map, "closed", VisualizationOptions(scale=2.0)))
    page = Page(browser, viewer.url)
    assert page.wait_until(lambda: viewer.pages == 1)
    viewer.set_layer(REFUSED, True)
    assert page.wait_until(lambda: page.page.evaluate(_FAINT) == 1)
    viewer.set_refused_reason("gravity")
    assert viewer.wait(30.0)
    assert viewer.scene is not None
    assert viewer.scene.layer(REFUSED).drawn == 1
    assert page.wait_until(lambda: page.page.evaluate(_FAINT) == 1)
    chosen = page.page.locator("xpath=//*[text()='refused for']/ancestor::*[.//input][1]//input")
    assert page.wait_until(lambda: chosen.first.input_value() == "gravity deviates")
    viewer.select(Pick(Entity.CLOSURE, 1, viewer.drawing.p_vertices[1], 0.0))
    assert page.wait_until(lambda: page.page.get_by_text("failed: inliers").count() == 1)
    assert page.errors == []
    page.page.close()
    viewer.stop()
