"""A real browser for tests: Chromium by playwright, rendering in software."""

import importlib
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import cv2
import numpy as np
import pytest

from maplab_py.viewer.display.picture import HEADLESS_FLAGS, find_browser
from maplab_py.viewer.display.viewer import Viewer
from tests.support.coverage import NO_BROWSER

WIDTH, HEIGHT = 1000, 700
HEADER, PANEL = 160, 340
IN_BROWSER = [
    pytest.mark.browser,
    pytest.mark.slow,
    pytest.mark.flaky(reruns=1, reruns_delay=10),
]
"""Marks of tests in a browser. Chromium that draws in software stands still for up to half a minute
now and then; a test that fails is tried once more, and the summary says so."""

_LAZY = """
const draw = window.requestAnimationFrame;
window.requestAnimationFrame = (f) => setTimeout(() => draw(f), %d);
"""
"""Draws seldom: pages that render in software would take all of a small machine."""

_TWO_FRAMES = "() => new Promise(r => requestAnimationFrame(() => requestAnimationFrame(r)))"


@contextmanager
def chromium() -> Iterator[Any]:
    """Start a browser; skip the test where there is none."""
    api = pytest.importorskip(
        "playwright.sync_api", reason=f"{NO_BROWSER}: playwright is not installed"
    )
    path = find_browser()
    if path is None:
        pytest.skip(f"{NO_BROWSER}: Chromium is not on this machine (apt-get install chromium)")
    flags = [flag for flag in HEADLESS_FLAGS if not flag.startswith("--headless")]
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox", *flags])
        try:
            yield browser
        finally:
            browser.close()


class Page:
    """An open page, what it asked for and what it complained of."""

    def __init__(
        self,
        browser: Any,
        url: str,
        size_px: tuple[int, int] = (WIDTH, HEIGHT),
        *,
        frame_ms: int = 120,
        script: str = "",
    ) -> None:
        """Open a page that draws at most every `frame_ms`, 0 = as it will, and runs a script first."""
        self.page = browser.new_page(viewport={"width": size_px[0], "height": size_px[1]})
        self.page.set_default_timeout(120_000)
        self.page.add_init_script((_LAZY % frame_ms if frame_ms else "") + script)
        self.requests: list[str] = []
        self.errors: list[str] = []
        self._nudges = 0
        self._last_nudge = time.monotonic()
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.on("websocket", lambda socket: self.requests.append(socket.url))
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.goto(url)
        self.page.wait_for_selector("canvas", state="attached")

    def wait_until(self, condition: Any, seconds: float = 240.0) -> bool:
        """Wait until a condition of ours holds, while the page lives on."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if condition():
                return True
            self.page.wait_for_timeout(50)
            self.nudge_now_and_then()
        return bool(condition())

    def nudge_now_and_then(self) -> None:
        if time.monotonic() > self._last_nudge + 5.0:
            self.nudge()

    def nudge(self) -> None:
        """Move the pointer where nothing is: the page then draws, which it else may put off.

        A page that renders in software and has nothing to draw now and then stops to report
        frames for many seconds.
        """
        self._last_nudge = time.monotonic()
        self._nudges += 1
        self.page.mouse.move(20.0 + self._nudges % 8, HEIGHT - 20.0)

    def checkbox(self, label: str) -> Any:
        """Return the checkbox beside a label."""
        row = f"xpath=//*[text()='{label}']/ancestor::*[.//input[@type='checkbox']][1]"
        return self.page.locator(row).locator("input[type=checkbox]").first

    def click(self, target: Any, tries: int = 4) -> None:
        """Click, and click again where the page gave no frame, for which playwright waits."""
        slow = importlib.import_module("playwright.sync_api").TimeoutError
        for number in range(1, tries + 1):
            try:
                target.click(timeout=30_000)
                return
            except slow:
                if number == tries:
                    raise
                self.nudge()

    def settle(self, milliseconds: int = 900) -> None:
        self.page.wait_for_timeout(milliseconds)

    def still_picture(self, seconds: float = 180.0) -> np.ndarray:
        """Return the picture (H, W, 3) once it has stopped changing, however slow the machine is."""
        end = time.monotonic() + seconds
        same, last = 0, self.picture()
        while same < 2:
            assert time.monotonic() < end, "the page does not come to rest"
            self.nudge_now_and_then()
            self.page.evaluate(_TWO_FRAMES)
            self.settle(250)
            now = self.picture()
            same = same + 1 if np.array_equal(now, last) else 0
            last = now
        return last

    def picture(self) -> np.ndarray:
        """Return what is to be seen of the scene (H, W, 3), without panel and messages."""
        data = np.frombuffer(self.page.screenshot(), dtype=np.uint8)
        image = cv2.imdecode(data, cv2.IMREAD_COLOR)
        assert image is not None
        return image[HEADER:, : WIDTH - PANEL, ::-1]

    def outside_requests(self, own: str) -> list[str]:
        """Return what went anywhere else than to our own address."""
        allowed = (own, own.replace("http", "ws", 1), "data:", "blob:", "file:", "about:")
        return [url for url in self.requests if not url.startswith(allowed)]


def place_on_page(viewer: Viewer, p: np.ndarray) -> tuple[float, float]:
    """Return the pixel of a point of the scene on the newest page."""
    camera = sorted(viewer.server.get_clients().items())[-1][1].camera
    w, x, y, z = camera.wxyz
    R = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    q = R.T @ (p - camera.position)
    focal = 0.5 * HEIGHT / np.tan(0.5 * camera.fov)
    return float(WIDTH / 2 + focal * q[0] / q[2]), float(HEIGHT / 2 + focal * q[1] / q[2])


def colour_count(picture: np.ndarray, colour: np.ndarray, tolerance: int = 30) -> int:
    """Return how many pixels have about this colour."""
    distance = np.abs(picture.astype(int) - np.asarray(colour, dtype=int)).max(axis=2)
    return int(np.count_nonzero(distance <= tolerance))


def is_drawn_at(page: Page, viewer: Viewer, p: np.ndarray, colour: np.ndarray) -> list[bool]:
    """Tell for points (N, 3) of the scene whether a line of this colour is to be seen at them."""
    picture = page.picture()
    drawn = []
    for point in p:
        x, y = (round(value) for value in place_on_page(viewer, point))
        y -= HEADER
        patch = picture[max(y - 3, 0) : y + 4, max(x - 3, 0) : x + 4]
        drawn.append(colour_count(patch, colour, 60) >= 8)
    return drawn


def is_blank(picture: np.ndarray) -> bool:
    return len(np.unique(picture.reshape(-1, 3), axis=0)) < 20
