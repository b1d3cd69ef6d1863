"""The viser server, and the cameras of its clients."""

from __future__ import annotations

import functools
import gzip
import logging
import re
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import resources
from typing import Any

import numpy as np
import rich
import viser
import websockets.asyncio.server

from maplab_py.array_types import F64
from maplab_py.errors import UserError
from maplab_py.geometry import se3, so3
from maplab_py.viewer.drawing import Drawing
from maplab_py.viewer.layers.cameras import mission_cameras
from maplab_py.viewer.scene import Extent

LOOPBACK = "127.0.0.1"
_LOCAL_ORIGINS = (None, re.compile(r"https?://(localhost|127\.0\.0\.1|\[::1\])(:\d+)?"))
"""Origins that may open a connection: pages of this viewer on any forwarded port, and programs."""

logger = logging.getLogger(__name__)
_rich_print = rich.print
_patching = threading.Lock()


def _print_unless_viser(*objects: object, **settings: Any) -> None:
    """Stand in for `rich.print`: what viser would print goes to the log."""
    if str(sys._getframe(1).f_globals.get("__name__", "")).startswith("viser"):
        logger.debug("viser: %s", " ".join(str(o) for o in objects if isinstance(o, str)))
    else:
        _rich_print(*objects, **settings)


class _Forwarder(logging.Handler):
    """Sends records of a library to the console's log, so that no traceback disturbs the prompt."""

    def emit(self, record: logging.LogRecord) -> None:
        """Forward one record."""
        logger.info("%s: %s", record.name, record.getMessage(), exc_info=record.exc_info)


def start_server(port: int) -> viser.ViserServer:
    """Start a server on the loopback interface.

    Args:
        port: Wanted port; a busy one is replaced by the next that is free, 0 = any.

    Raises:
        UserError: The port is not one, or none is free.
    """
    if not 0 <= port <= 65535:
        raise UserError(f"--viewer_port={port}: a port is 0 (any) to 65535")
    _hush_libraries()
    with (
        _patching,
        _patch(websockets.asyncio.server, "serve", _restricted_serve()),
    ):
        try:
            server = viser.ViserServer(host=LOOPBACK, port=port, verbose=False, label="maplab")
        except OSError as error:
            raise UserError(f"--viewer_port={port}: cannot be served ({error})") from None
    server.request_share_url = _no_sharing  # type: ignore[method-assign]
    server.gui.configure_theme(show_share_button=False, show_logo=False)
    return server


def _restricted_serve() -> Any:
    """Return the function that opens the socket, restricted to connections of the viewer's pages.

    The page that it serves carries the script `page.js` and the style `page.css`.
    """
    serve = websockets.asyncio.server.serve

    def restricted(*arguments: Any, process_request: Any = None, **settings: Any) -> Any:
        if process_request is not None:
            process_request = with_page_script(process_request)
        return serve(
            *arguments, origins=_LOCAL_ORIGINS, process_request=process_request, **settings
        )

    return restricted


@functools.cache
def page_script() -> str:
    """Return the script that the page runs beside viser's."""
    return f"<script>{_display_file('page.js')}</script>"


@functools.cache
def page_style() -> str:
    """Return the style that the page has beside viser's."""
    return f"<style>{_display_file('page.css')}</style>"


def _display_file(name: str) -> str:
    return resources.files("maplab_py.viewer.display").joinpath(name).read_text("utf-8")


def with_page_script(process_request: Any) -> Any:
    """Return a server of files that adds our script and style to the page; all else is passed on."""
    pages: dict[bytes, bytes] = {}
    head = f"<head>{page_style()}{page_script()}".encode()

    def process(connection: Any, request: Any) -> Any:
        response = process_request(connection, request)
        if response is None or not response.headers.get("Content-Type", "").startswith("text/html"):
            return response
        if response.body not in pages:
            is_packed = response.headers.get("Content-Encoding") == "gzip"
            page = gzip.decompress(response.body) if is_packed else response.body
            page = page.replace(b"<head>", head, 1)
            pages[response.body] = gzip.compress(page) if is_packed else page
        response.body = pages[response.body]
        del response.headers["Content-Length"]
        response.headers["Content-Length"] = str(len(response.body))
        return response

    return process


def _no_sharing(*_: object, **__: object) -> None:
    """Stand in for viser's tunnel through a public server."""
    logger.warning("a page asked for a public address and got none")


def _hush_libraries() -> None:
    rich.print = _print_unless_viser
    for name in ("websockets", "websockets.server"):
        library = logging.getLogger(name)
        if not any(isinstance(handler, _Forwarder) for handler in library.handlers):
            library.addHandler(_Forwarder())
        library.propagate = False


@contextmanager
def _patch(owner: Any, name: str, value: Any) -> Iterator[None]:
    before = getattr(owner, name)
    setattr(owner, name, value)
    try:
        yield
    finally:
        setattr(owner, name, before)


FIELD_OF_VIEW_RAD = float(np.radians(45.0))
_ELEVATIONS_DEG = {"overview": 38.0, "top": 89.9, "side": 8.0}
VIEWS = tuple(_ELEVATIONS_DEG)
FREE, BEHIND, INSIDE = "free", "ride behind", "through the camera"
RIDES = (FREE, BEHIND, INSIDE)
"""Camera mode of a page for a mission that is played."""
_ASPECT = 1.35
"""Width by height that a view of everything is sure to fit."""
_MARGIN = 1.08
_FREE = 0.74
"""Part of a page's width that the panel leaves free."""


def view_of(
    extent: Extent, view: str = "overview", *, beside_panel: bool = False
) -> tuple[F64, F64]:
    """Return camera position (3,) and target (3,) that just show the whole outline; z is up.

    The overview and the view from the side look across the longest direction of the map.

    Args:
        extent: What to show.
        view: One of `VIEWS`.
        beside_panel: Leave the part of the page free that the panel covers.
    """
    azimuth = _across(extent.outline)
    if view == "overview":
        azimuth -= np.radians(22.0)
    elevation = np.radians(_ELEVATIONS_DEG[view])
    back = np.array(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
    )
    right = np.cross([0.0, 0.0, 1.0], back)
    right = right / np.linalg.norm(right)
    axes = np.stack([right, np.cross(back, right), back])
    p = (extent.outline - extent.centre) @ axes.T
    tangent = np.tan(0.5 * FIELD_OF_VIEW_RAD) * np.array([_ASPECT, 1.0]) / _MARGIN
    if beside_panel:
        tangent[0] *= _FREE
    middle = 0.5 * (p[:, :2].min(axis=0) + p[:, :2].max(axis=0))
    for _ in range(3):  # near points need more room: centre what is seen, not what is there
        distance = _distance(p, middle, tangent)
        seen = (p[:, :2] - middle) / (distance - p[:, 2:])
        middle = middle + 0.5 * distance * (seen.min(axis=0) + seen.max(axis=0))
    distance = max(_distance(p, middle, tangent), 0.2 * extent.radius_m)
    if beside_panel:
        middle[0] += distance * (1.0 - _FREE) * _ASPECT * np.tan(0.5 * FIELD_OF_VIEW_RAD)
    target = extent.centre + middle @ axes[:2]
    return target + distance * back, target


def _distance(p: F64, middle: F64, tangent: F64) -> float:
    """Return from how far points (N, 3), right, up and back, fit into the opening (2,)."""
    return max(float((np.abs(p[:, :2] - middle) / tangent + p[:, 2:]).max()), 0.1)


def _across(outline: F64) -> float:
    """Return the direction [rad] from which the outline (N, 3) is widest, on the side of -y."""
    flat = outline[:, :2] - outline[:, :2].mean(axis=0)
    _, axes = np.linalg.eigh(flat.T @ flat + 1e-12 * np.eye(2))
    normal = axes[:, 0] if axes[1, 0] <= 0.0 else -axes[:, 0]
    return float(np.arctan2(normal[1], normal[0]))


def aim(camera: Any, extent: Extent, view: str = "overview", *, beside_panel: bool = True) -> None:
    """Point the camera of a page."""
    position, target = view_of(extent, view, beside_panel=beside_panel)
    camera.up_direction = (0.0, 0.0, 1.0)
    camera.position = position
    camera.look_at = target
    camera.fov = FIELD_OF_VIEW_RAD
    camera.near = max(1e-3, 2e-4 * extent.radius_m)
    camera.far = 100.0 * extent.radius_m


def approach(camera: Any, p: F64, distance_m: float) -> None:
    """Look at a point (3,) of the scene from a distance, in the direction of the present view."""
    back = np.asarray(camera.position) - np.asarray(camera.look_at)
    length = float(np.linalg.norm(back))
    back = back / length if length > 1e-9 else np.array([0.0, -0.8, 0.6])
    camera.position = p + distance_m * back
    camera.look_at = p


def ride(camera: Any, drawing: Drawing, vertex: int, how: str) -> None:
    """Move the camera of a page along with a vertex (row), behind it or where its camera is.

    It looks where the first camera of the mission looks; without cameras where the path leads.
    """
    centre, forward = _line_of_sight(drawing, vertex)
    length = 0.3 * drawing.unit_m
    if how == BEHIND:
        level = np.array([forward[0], forward[1], 0.0])
        norm = float(np.linalg.norm(level))
        back = level / norm if norm > 1e-6 else np.array([0.0, 1.0, 0.0])
        camera.position = centre + length * (np.array([0.0, 0.0, 0.6]) - back)
        camera.look_at = centre + 0.2 * length * back
    else:
        camera.position = centre
        camera.look_at = centre + 0.1 * length * forward


def _line_of_sight(drawing: Drawing, vertex: int) -> tuple[F64, F64]:
    """Return from where (3,) and in which direction (3,) the camera of a vertex looks."""
    vi_map = drawing.vi_map
    p = drawing.p_vertices[vertex]
    mission = int(vi_map.vertices.mission[vertex])
    cameras = mission_cameras(vi_map, mission)
    if cameras:
        T_G_C = se3.compose(vi_map.T_G_I[vertex], cameras[0].T_I_C)
        offset = T_G_C[4:] - vi_map.T_G_I[vertex, 4:]
        return p + offset, so3.rotate(T_G_C[:4], np.array([0.0, 0.0, 1.0]))
    start, stop = vi_map.vertex_start[mission : mission + 2].tolist()
    step = (
        drawing.p_vertices[min(vertex + 1, stop - 1)] - drawing.p_vertices[max(vertex - 1, start)]
    )
    length = float(np.linalg.norm(step))
    return p, step / length if length > 1e-9 else np.array([1.0, 0.0, 0.0])


def aim_initially(camera: Any, extent: Extent, *, beside_panel: bool = True) -> None:
    """Set what new pages begin with (its field for the up direction has another name)."""
    position, target = view_of(extent, beside_panel=beside_panel)
    camera.position = tuple(position.tolist())
    camera.look_at = tuple(target.tolist())
    camera.up = (0.0, 0.0, 1.0)
    camera.fov = FIELD_OF_VIEW_RAD
    camera.near = max(1e-3, 2e-4 * extent.radius_m)
    camera.far = 100.0 * extent.radius_m
