"""What the viewer leaves behind, and what browsers may do to it, each test with a viewer of its own."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from maplab_py.viewer import colours
from maplab_py.viewer.building import Subject
from maplab_py.viewer.display import picture
from maplab_py.viewer.display.picture import find_browser
from maplab_py.viewer.display.viewer import Viewer
from maplab_py.viewer.options import VisualizationOptions
from tests.support.machine import slowness
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


_OVERFLOWING = """[...document.querySelectorAll(".mantine-ScrollArea-viewport")]
  .filter((area) => area.scrollHeight > area.clientHeight).length"""


def test_the_panel_of_many_layers_needs_no_scrolling(browser: Any) -> None:
    viewer = Viewer(0)
    subject = SUBJECT.replace(other=MAP.replace(), side_by_side=True)
    scene = viewer.show(subject)
    assert len(scene.layers) == 13
    page = Page(browser, viewer.url, (1280, 720))
    assert page.wait_until(lambda: page.page.get_by_text("more layers").count() == 1)
    page.settle(2000)
    assert page.page.evaluate(_OVERFLOWING) == 0
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


def test_many_pages_do_no_harm(browser: Any) -> None:
    viewer = Viewer(0)
    viewer.show(SUBJECT)
    pages = [Page(browser, viewer.url, (240, 160), frame_ms=1500) for _ in range(10)]
    assert pages[0].wait_until(lambda: viewer.pages == 10)
    viewer.set_layer("imu_edges", True)
    for opened in pages[:9]:
        opened.page.close()
    assert pages[9].wait_until(lambda: viewer.pages == 1)
    began = time.perf_counter()
    viewer.follow(SUBJECT.replace(vi_map=MAP.replace()))
    assert viewer.wait(10.0)
    assert time.perf_counter() - began < 5.0 * slowness()
    assert pages[9].errors == []
    pages[9].page.close()
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
