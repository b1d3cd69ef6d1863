"""The viser server, and light and dark pages: each follows its system until its user chooses."""

from __future__ import annotations

import asyncio
import functools
import gzip
import http
import logging
import re
import sys
import threading
from collections.abc import Callable
from importlib import resources
from typing import TYPE_CHECKING, Any
from unittest import mock

import rich
import viser
import websockets.asyncio.server

from maplab_py.errors import UserError

if TYPE_CHECKING:
    from maplab_py.viewer.display.viewer import Viewer

LOOPBACK = "127.0.0.1"
_LOCAL_HOST = r"(localhost|127\.0\.0\.1|\[::1\])(:\d+)?"
_LOCAL_ORIGINS = (None, re.compile(f"https?://{_LOCAL_HOST}"))
"""Origins that may open a connection: pages of this viewer on any forwarded port, and programs."""

_THEME = "maplab_theme"
"""Item of local storage in whose place `page.js` gives the theme of the page: its own, or its system's."""
_DARK, _LIGHT = "dark", "light"
_ANSWER_S = 300.0
"""Longest wait for a page that is opened to tell its theme."""

_GO = re.compile(r"/go/([0-9a-f]{1,32})")

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


def start_server(port: int, go: Callable[[str], str]) -> viser.ViserServer:
    """Start a server on the loopback interface.

    Args:
        port: Wanted port; a busy one is replaced by the next that is free, 0 = any.
        go: Shows what an id means, the last part of an address /go/ID, and returns a page that says so.

    Raises:
        UserError: The port is not one, or none is free.
    """
    if not 0 <= port <= 65535:
        raise UserError(f"--viewer_port={port}: a port is 0 (any) to 65535")
    _hush_libraries()
    with (
        _patching,
        mock.patch.object(websockets.asyncio.server, "serve", _restricted_serve(go)),
    ):
        try:
            server = viser.ViserServer(host=LOOPBACK, port=port, verbose=False, label="maplab")
        except OSError as error:
            raise UserError(f"--viewer_port={port}: cannot be served ({error})") from None
    server.request_share_url = _no_sharing  # type: ignore[method-assign]
    server.gui.configure_theme(show_share_button=False, show_logo=False)
    return server


def _restricted_serve(go: Callable[[str], str]) -> Any:
    """Return the function that opens the socket, restricted to connections of the viewer's pages.

    The page that it serves carries the script `page.js` and the style `page.css`.
    """
    serve = websockets.asyncio.server.serve

    def restricted(*arguments: Any, process_request: Any = None, **settings: Any) -> Any:
        if process_request is not None:
            process_request = with_links_to_ids(with_page_script(process_request), go)
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


def with_links_to_ids(process_request: Any, go: Callable[[str], str]) -> Any:
    """Return a server of files that also answers /go/ID, but not to pages of other sites."""

    async def answer(connection: Any, id_: str) -> Any:
        page = await asyncio.get_running_loop().run_in_executor(None, go, id_)
        response = connection.respond(http.HTTPStatus.OK, page)
        del response.headers["Content-Type"]
        response.headers["Content-Type"] = "text/html; charset=utf-8"
        return response

    def process(connection: Any, request: Any) -> Any:
        match = _GO.fullmatch(request.path)
        if match is None:
            return process_request(connection, request)
        host = request.headers.get("Host", "")  # of another site whose name leads here
        is_foreign = request.headers.get("Sec-Fetch-Site", "none") not in ("none", "same-origin")
        if is_foreign or re.fullmatch(_LOCAL_HOST, host, re.IGNORECASE) is None:
            return connection.respond(http.HTTPStatus.FORBIDDEN, "")
        return answer(connection, match[1])

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


class Themes:
    """The theme of each page."""

    def __init__(self, viewer: Viewer, folder: Any, *, is_dark: bool) -> None:
        """Add the button to a folder of the panel.

        Args:
            is_dark: Let all pages be dark at first, whatever their systems are.
        """
        self._server = server = viewer.server
        self._is_dark = is_dark
        self._of_page: dict[int, bool] = {}
        _configure(server.gui, is_dark=is_dark)
        with folder:
            button = server.gui.add_button("light or dark", hint="change the theme of this page")
        button.on_click(viewer.by_user(lambda event: self._toggle(event.client)))
        server.on_client_connect(self._follow_system)
        server.on_client_disconnect(self._forget)

    def is_dark(self, client: Any = None) -> bool:
        """Tell the theme of a page; of none, as new pages are where no system wants another."""
        return (
            self._is_dark if client is None else self._of_page.get(client.client_id, self._is_dark)
        )

    def set_all(self, *, is_dark: bool) -> None:
        """Change the theme of all pages, and of those that will be opened."""
        self._is_dark = is_dark
        _configure(self._server.gui, is_dark=is_dark)
        for client in self._server.get_clients().values():
            self._set(client, is_dark=is_dark)

    def _toggle(self, client: Any) -> None:
        if client is None:
            return
        is_dark = not self.is_dark(client)
        self._set(client, is_dark=is_dark)
        client.local_storage.set_item(_THEME, _DARK if is_dark else _LIGHT)

    def _follow_system(self, client: Any) -> None:
        """Give a page that is opened the theme that it wants."""
        try:
            wanted = client.local_storage.get_item(_THEME, timeout=_ANSWER_S)
        except (RuntimeError, TimeoutError):  # the page is gone
            return
        is_dark = wanted == _DARK or (self._is_dark and wanted != _LIGHT)
        if is_dark != self._is_dark:
            self._set(client, is_dark=is_dark)

    def _forget(self, client: Any) -> None:
        self._of_page.pop(client.client_id, None)

    def _set(self, client: Any, *, is_dark: bool) -> None:
        self._of_page[client.client_id] = is_dark
        _configure(client.gui, is_dark=is_dark)


def _configure(gui: Any, *, is_dark: bool) -> None:
    """Send the look of the panel to one page or to all."""
    gui.configure_theme(
        dark_mode=is_dark, show_share_button=False, show_logo=False, control_width="medium",
        brand_color=(76, 141, 214),
    )  # fmt: skip
