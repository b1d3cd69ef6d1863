"""Light and dark pages: each follows its system until its user chooses."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from maplab_py.viewer.display.viewer import Viewer

KEY = "maplab_theme"
"""Item of local storage in whose place `page.js` gives the theme of the page: its own, or its system's."""
_DARK, _LIGHT = "dark", "light"
_ANSWER_S = 300.0
"""Longest wait for a page that is opened to tell its theme."""


class Themes:
    """The theme of each page."""

    def __init__(self, viewer: Viewer, folder: Any, *, is_dark: bool) -> None:
        """Add the button to a folder of the panel.

        Args:
            viewer: Of the pages.
            folder: Where the button is.
            is_dark: Let all pages be dark at first, whatever their systems are.
        """
        self._server = server = viewer.server
        self._is_dark = is_dark
        self._of_page: dict[int, bool] = {}
        configure(server.gui, is_dark=is_dark)
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
        configure(self._server.gui, is_dark=is_dark)
        for client in self._server.get_clients().values():
            self._set(client, is_dark=is_dark)

    def _toggle(self, client: Any) -> None:
        if client is None:
            return
        is_dark = not self.is_dark(client)
        self._set(client, is_dark=is_dark)
        client.local_storage.set_item(KEY, _DARK if is_dark else _LIGHT)

    def _follow_system(self, client: Any) -> None:
        """Give a page that is opened the theme that it wants."""
        try:
            wanted = client.local_storage.get_item(KEY, timeout=_ANSWER_S)
        except (RuntimeError, TimeoutError):  # the page is gone
            return
        is_dark = wanted == _DARK or (self._is_dark and wanted != _LIGHT)
        if is_dark != self._is_dark:
            self._set(client, is_dark=is_dark)

    def _forget(self, client: Any) -> None:
        self._of_page.pop(client.client_id, None)

    def _set(self, client: Any, *, is_dark: bool) -> None:
        self._of_page[client.client_id] = is_dark
        configure(client.gui, is_dark=is_dark)


def configure(gui: Any, *, is_dark: bool) -> None:
    """Send the look of the panel to one page or to all."""
    gui.configure_theme(
        dark_mode=is_dark, show_share_button=False, show_logo=False, control_width="medium",
        brand_color=(76, 141, 214),
    )  # fmt: skip
