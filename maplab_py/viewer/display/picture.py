"""A picture of the scene, taken by an open page or by a Chromium without a window."""

import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.array_types import U8
from maplab_py.cancellation import check_cancelled, cleaned_up
from maplab_py.child_processes import kill, start
from maplab_py.errors import EstimationError, UserError
from maplab_py.output_files import write_bytes, write_text
from maplab_py.viewer.building import Subject
from maplab_py.viewer.display import panel, parts
from maplab_py.viewer.display.camera import aim, aim_initially, view_of
from maplab_py.viewer.display.server import page_script, page_style
from maplab_py.viewer.drawing import Drawing
from maplab_py.viewer.history import MAX_STATES, error_curves, history_chart, state_layers
from maplab_py.viewer.scene import Extent, Scene

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
HEADLESS_FLAGS = (
    "--headless=new", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--disable-default-apps", "--disable-breakpad",
    "--disable-domain-reliability", "--mute-audio", "--hide-scrollbars",
)  # fmt: skip

_CONNECT_S = 60.0
_SETTLE_S = 0.7
_RENDER_S = 60.0


def find_browser() -> str | None:
    """Return the path of a Chromium, None when there is none."""
    return next((path for name in BROWSERS if (path := shutil.which(name))), None)


def take_picture(
    server: Any, url: str, extent: Extent, view: str, size_px: tuple[int, int], *, is_dark: bool
) -> U8:
    """Return a picture (H, W, 3) RGB of the scene.

    An open page takes it, from where it looks unless a view is wanted; else a Chromium is started
    for as long as it takes.

    Args:
        view: One of `camera.VIEWS`; empty = where the open page looks, or the overview.
        size_px: Width and height.
        is_dark: Colour of the ground.

    Raises:
        UserError: No page is open and no Chromium is installed.
        EstimationError: The browser gave no picture.
    """
    with open_client(server, url, size_px) as client:
        return render(client, size_px, is_dark=is_dark, pose=point_camera(client, extent, view))


@contextmanager
def open_client(server: Any, url: str, size_px: tuple[int, int]) -> Iterator[Any]:
    """Give the newest open page; without one, a page of a Chromium that runs for as long as this lasts.

    Raises:
        UserError: No page is open and no Chromium is installed.
        EstimationError: The browser did not show the page.
    """
    clients = sorted(server.get_clients().items())
    if clients:
        yield clients[-1][1]
        return
    browser = find_browser()
    if browser is None:
        raise UserError(
            f"no page is open and no Chromium is installed: open {url}, or install one "
            "(apt-get install chromium)"
        )
    with headless_browser(browser, url, size_px):
        yield _first_client(server)


def _first_client(server: Any) -> Any:
    deadline = time.monotonic() + _CONNECT_S
    while time.monotonic() < deadline:
        check_cancelled()
        clients = server.get_clients()
        if clients:
            time.sleep(_SETTLE_S)
            return next(iter(clients.values()))
        time.sleep(0.05)
    raise EstimationError(f"the browser did not show the page within {_CONNECT_S:.0f} s")


def point_camera(client: Any, extent: Extent, view: str) -> dict[str, Any]:
    """Let a page look at an extent, "" = where it looks already, and return the pose of its camera."""
    camera = client.camera
    if view:
        with client.atomic():
            aim(camera, extent, view, beside_panel=False)
        time.sleep(_SETTLE_S)
    return {
        "wxyz": np.array(camera.wxyz), "position": np.array(camera.position), "fov": float(camera.fov)
    }  # fmt: skip


def render(client: Any, size_px: tuple[int, int], *, is_dark: bool, pose: dict[str, Any]) -> U8:
    """Return a picture (H, W, 3) RGB that a page takes from a pose.

    Raises:
        EstimationError: The browser gave no picture.
    """
    width, height = size_px
    try:
        picture = client.get_render(
            height=height, width=width, transport_format="png", timeout=_RENDER_S, **pose
        )
    except (TimeoutError, RuntimeError, ConnectionError) as error:
        raise EstimationError(f"the browser gave no picture: {error}") from None
    return on_ground(np.asarray(picture), is_dark=is_dark)


def on_ground(picture: U8, *, is_dark: bool) -> U8:
    """Lay a picture with transparency (H, W, 4) on the theme's ground; return (H, W, 3)."""
    if picture.shape[2] == 3:
        return picture
    ground = np.array(parts.DARK_GROUND if is_dark else parts.LIGHT_GROUND, dtype=np.float64)
    part = picture[:, :, 3:].astype(np.float64) / 255.0
    mixed = part * picture[:, :, :3] + (1.0 - part) * ground
    return np.asarray(np.round(mixed), dtype=np.uint8)


@contextmanager
def headless_browser(
    browser: str, url: str, size_px: tuple[int, int]
) -> Iterator[subprocess.Popen[bytes]]:
    """Run a Chromium without a window on a page; it stores nothing."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        sandbox = ("--no-sandbox",) if hasattr(os, "geteuid") and os.geteuid() == 0 else ()
        width, height = size_px
        process = start(
            [
                browser, *HEADLESS_FLAGS, *sandbox, f"--user-data-dir={profile}",
                f"--window-size={width},{height + 120}", url,
            ],
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        with cleaned_up(partial(kill, process)):
            yield process


def save_picture(picture: U8, path: Path) -> None:
    """Write a picture (H, W, 3) RGB; the suffix says in which format.

    Raises:
        UserError: The file cannot be written or the suffix is unknown.
    """
    import cv2

    try:
        ok, data = cv2.imencode(path.suffix, np.ascontiguousarray(picture[:, :, ::-1]))
    except cv2.error:
        ok = False
    if not ok:
        raise UserError(f"--file={path}: a name ending in .png or .jpg is expected")
    write_bytes(path, [data.tobytes()], overwrite=True)


_OVERLAY = """
<div style="position:fixed;left:14px;bottom:14px;max-width:19em;padding:4px 2px;border-radius:8px;
font-family:system-ui,sans-serif;font-size:15px;z-index:10;pointer-events:none;
background:{ground};color:{ink};max-height:calc(100vh - 40px);overflow:auto">{header}{missions}
{switches}{legend}{chooser}</div>
"""

_SCRIPT = """
<script>
(() => {
  const boxes = [...document.querySelectorAll("input[data-layer]")];
  const slider = document.querySelector("input[data-states]");
  const layerOf = (name) => (name.match(/^(?:\\/labels)?\\/map\\/([^/]+)\\//) || [])[1];
  const show = () => {
    const nodes = window.__viserSceneTree.getState();
    const isPresent = !slider || slider.value === slider.dataset.states;
    for (const name in nodes) {
      const box = boxes.find((box) => box.dataset.layer === layerOf(name));
      const isOfState = /^\\/history\\/\\d+\\//.test(name);
      if (!nodes[name] || !(box || isOfState)) continue;
      const isVisible = isOfState
        ? !isPresent && name.startsWith("/history/" + slider.value + "/")
        : isPresent && box.checked;
      nodes[name].overrideVisibility = nodes[name].effectiveVisibility = isVisible;
    }
    boxes.forEach((box) => (box.disabled = !isPresent));
    document.querySelectorAll("[data-chart]").forEach((chart) => {
      chart.hidden = chart.dataset.chart !== slider.value;
    });
    window.dispatchEvent(new Event("resize"));
  };
  [...boxes, slider].forEach((input) => input && input.addEventListener("input", show));
})();
</script>
"""
"""Switches layers and states by the scene tree that viser's page offers to its tests."""


@contextmanager
def states_to_choose(server: Any, drawing: Drawing, subject: Subject | None) -> Iterator[str]:
    """Send nodes of all states of the map for as long as this lasts, and give the slider that chooses one."""
    states = () if subject is None else subject.history[-MAX_STATES:]
    if subject is None or len(states) < 2:
        yield ""
        return
    curves = error_curves(states, subject.truth)
    place = next((i for i, state in enumerate(states) if state.vi_map is drawing.vi_map), 0)
    handles = []
    for number, state in enumerate(states):
        layers = () if number == place else state_layers(drawing, state, len(states))
        for layer in layers:
            for mission, part in layer.parts.items():
                handles += parts.add_part(server, f"/history/{number}/{layer.name}/{mission}", part)
    for handle in handles:
        handle.visible = False
    charts = "".join(
        f"<div data-chart='{number}'{'' if number == place else ' hidden'}>"
        f"{history_chart(states, curves, number)}</div>"
        for number in range(len(states))
    )
    left_out = len(subject.history) - len(states)
    note = panel.hint(f"{left_out} earlier states are not in this page") if left_out else ""
    try:
        yield (
            f"<div style='pointer-events:auto'><input type='range' data-states='{place}' min='0' "
            f"max='{len(states) - 1}' value='{place}' aria-label='state' "
            f"style='width:calc(100% - 1.4em);margin:0.4em 0.7em'>{charts}{note}</div>"
        )
    finally:
        for handle in handles:
            handle.remove()


def export_html(
    server: Any, scene: Scene, layers: set[str], path: Path, chooser: str, *, is_dark: bool
) -> int:
    """Write what the server shows to a file, with a switch per layer; return its size in bytes.

    Args:
        server: The viser server that shows the scene.
        layers: Names of the layers that are visible at first; the others have nodes that are hidden.
        chooser: HTML of the slider of states, empty = none.

    Raises:
        UserError: The file cannot be written.
    """
    aim_initially(server.initial_camera, scene.extent, view_of(scene.extent))
    page = server.scene.as_html(dark_mode=is_dark)
    entries = [entry for layer in scene.layers if layer.name in layers for entry in layer.legend]
    overlay = _OVERLAY.format(
        ground="rgba(24,26,31,0.82)" if is_dark else "rgba(255,255,255,0.82)",
        ink="#d8dbe0" if is_dark else "#2a2d33",
        header=panel.header(scene),
        missions=panel.mission_legend(scene.missions),
        switches=panel.layer_switches(scene.layers, layers),
        legend=panel.legend(dict.fromkeys(entries)),
        chooser=chooser,
    )
    end = page.rindex("</body>")
    page = f"{page[:end]}{page_style()}{overlay}{_SCRIPT}{page_script()}{page[end:]}"
    write_text(path, [page], overwrite=True)
    return len(page.encode())
