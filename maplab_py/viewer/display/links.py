"""Links that open a view again: map, camera, layers and selection behind the # of the page's address."""

from __future__ import annotations

import dataclasses
import zlib
from html import escape
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qsl, urlencode

import numpy as np

from maplab_py.array_types import F64
from maplab_py.errors import UserError
from maplab_py.viewer.drawing import Drawing
from maplab_py.viewer.picking import id_of

if TYPE_CHECKING:
    from maplab_py.viewer.display.viewer import Viewer

KEY = "maplab_link"
"""Item of local storage in whose place `page.js` reads and writes the page's address."""
MAX_CHARACTERS = 1500
_FARTHEST_M, _NEAREST_M = 1e8, 1e-3
_TEXT = "<!doctype html><title>maplab</title><p style='font-family:system-ui'>{}</p>"
_ANSWER_S = 300.0
"""Longest wait for a page that is opened to tell its address."""


@dataclasses.dataclass(frozen=True, eq=False)
class SharedView:
    """View of a link."""

    map_code: str
    camera_G: F64  # (2, 3) position of the camera, and the point that it looks at
    layers: tuple[str, ...]  # names of the visible ones
    picked_id: str = ""  # empty = nothing is selected


def link_text(view: SharedView) -> str:
    """Return what comes behind the # of an address.

    Raises:
        UserError: The names of the layers are too long.
    """
    fields = {
        "map": view.map_code,
        "camera": ",".join(f"{x:.3f}" for x in view.camera_G.ravel().tolist()),
        "layers": ",".join(view.layers),
        "pick": view.picked_id,
    }
    text = urlencode(fields, safe=",")
    if len(text) > MAX_CHARACTERS:
        raise UserError(f"{len(view.layers)} layers are too many for a link: hide some")
    return text


def read_link(text: str) -> SharedView:
    """Return the view of a link.

    Raises:
        UserError: It is damaged.
    """
    try:
        if len(text) > MAX_CHARACTERS:
            raise ValueError(text[:80])
        pairs = parse_qsl(text, keep_blank_values=True, strict_parsing=True, max_num_fields=4)
        fields = dict(pairs)
        camera = np.array(fields["camera"].split(","), dtype=np.float64).reshape(2, 3)
        is_near = bool((np.abs(camera) < _FARTHEST_M).all())  # NaN is not
        if not is_near or np.linalg.norm(camera[1] - camera[0]) < _NEAREST_M:
            raise ValueError(fields["camera"])
        layers = tuple(filter(None, fields["layers"].split(",")))
        return SharedView(fields["map"], camera, layers, fields["pick"])
    except (KeyError, ValueError):
        raise UserError("this link is damaged: the page opens as without it") from None


def map_code(drawing: Drawing) -> str:
    """Return eight digits that tell maps with other missions apart."""
    return f"{zlib.crc32(''.join(sorted(drawing.mission_ids)).encode()):08x}"


class Links:
    """The button that makes a link, and the pages that are opened by one."""

    def __init__(self, viewer: Viewer, folder: Any) -> None:
        """Add the button to a folder of the panel."""
        self._viewer = viewer
        with folder:
            button = viewer.server.gui.add_button(
                "copy link", hint="a link that opens this map with this camera, layers, selection"
            )
        button.on_click(viewer.by_user(lambda event: self.copy(event.client)))
        viewer.server.on_client_connect(self.restore)

    def copy(self, client: Any) -> None:
        """Turn a page's address into a link to what it shows, and copy it."""
        try:
            drawing = self._viewer.drawing
            camera = np.stack([client.camera.position, client.camera.look_at]) + drawing.origin_G
            layers = tuple(sorted(self._viewer.visible_layers))
            picked = self._viewer.selections.of(client).picked
            picked_id = "" if picked is None else id_of(drawing.vi_map, picked)
            text = link_text(SharedView(map_code(drawing), camera, layers, picked_id))
        except UserError as error:
            _tell(client, str(error))
            return
        client.local_storage.set_item(KEY, text)
        _tell(client, "copied: it is the address of this page, too")

    def go(self, id_: str) -> str:
        """Let all pages show what an id means; return a page that says so, or becomes the first one."""
        try:
            with self._viewer.lock:
                self._viewer.fly_to(id_)
                drawing, picked = self._viewer.drawing, self._viewer.selections.newest.picked
                if self._viewer.server.get_clients() or picked is None:
                    return _TEXT.format(f"{id_[:8]} is selected in the open page of the viewer.")
                distance_m = 0.25 * drawing.extent.radius_m
                position = picked.p + distance_m * np.array([0.0, -0.8, 0.6])
                camera = np.stack([position, picked.p]) + drawing.origin_G
                layers = tuple(sorted(self._viewer.visible_layers))
                picked_id = id_of(drawing.vi_map, picked)
                text = link_text(SharedView(map_code(drawing), camera, layers, picked_id))
        except UserError as error:
            return _TEXT.format(escape(str(error)))
        return f"<script>location.replace('/#{text}')</script>"

    def restore(self, client: Any) -> None:
        """Show what the address of a page that is opened says; the page is told what is wrong with it."""
        try:
            text = client.local_storage.get_item(KEY, timeout=_ANSWER_S)
        except (RuntimeError, TimeoutError):  # the page is gone
            return
        if not text:
            return
        try:
            with self._viewer.lock:
                self._show(client, read_link(text))
        except UserError as error:
            _tell(client, str(error))

    def _show(self, client: Any, shared: SharedView) -> None:
        drawing = self._viewer.drawing
        if shared.map_code != map_code(drawing):
            raise UserError(
                "this link is of a map with other missions: load it, then reload the page"
            )
        position, target = shared.camera_G - drawing.origin_G
        with client.atomic():
            client.camera.position = position
            client.camera.look_at = target
        missing = self._viewer.set_layers(set(shared.layers))
        if shared.picked_id:
            self._viewer.selections.jump(drawing, shared.picked_id, client)
        if missing:
            raise UserError(f"this map has no layer {', '.join(sorted(missing))[:200]}")


def _tell(client: Any, message: str) -> None:
    client.add_notification("Link", message, auto_close_seconds=15.0)
