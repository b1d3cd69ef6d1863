"""The closure court: refused closures, the nearest misses first, for a person to accept or refuse.

A page only collects verdicts. The command judge_closures applies them to the map.
"""

from __future__ import annotations

from functools import partial
from html import escape
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from maplab_py.algorithms.loop_closure.closure_record import USES, read_record
from maplab_py.algorithms.loop_closure.closure_table import VERDICTS
from maplab_py.algorithms.loop_closure.listing import near_miss_order
from maplab_py.algorithms.loop_closure.reports import Verdict
from maplab_py.array_types import I64
from maplab_py.errors import MapError
from maplab_py.viewer import facts, picking, scene
from maplab_py.viewer.display import camera, panel, parts
from maplab_py.viewer.layers.closures import closure_ends
from maplab_py.vimap import VIMap, to_hex, to_hex_list

if TYPE_CHECKING:
    from maplab_py.viewer.display.viewer import Viewer

Colour = tuple[int, int, int]

_MAX_CASES = 30
_NO_VERDICT = (VERDICTS.index(Verdict.ACCEPTED), VERDICTS.index(Verdict.REMOVED))

_BUTTONS: tuple[tuple[str, Literal["J", "Y", "N"], bool | None, Colour | None, str], ...] = (
    ("next case", "J", None, None, "show the next refused closure, its images and its gates"),
    ("accept", "Y", True, (63, 163, 114), "it is the same place"),
    ("refuse", "N", False, (210, 69, 90), "it is another place"),
)


def cases_of(vi_map: VIMap) -> I64:
    """Return the closures (rows of the record) to judge: refused by a gate, the nearest misses first."""
    try:
        closures = read_record(vi_map).closures
    except MapError:
        return np.zeros(0, dtype=np.int64)
    is_open = ~np.isin(closures.verdict, _NO_VERDICT) & (closures.use == USES.index(""))
    is_open &= np.isfinite(closures.sigma).all(axis=1)
    rows = np.flatnonzero(is_open)
    if not len(rows):
        return rows
    order: I64 = rows[np.argsort(near_miss_order(closures)[rows], kind="stable")]
    return order[:_MAX_CASES]


class Court:
    """The widgets, the case that is open, and the verdicts."""

    def __init__(self, viewer: Viewer) -> None:
        self._viewer = viewer
        self._cases = np.zeros(0, dtype=np.int64)
        self._map: VIMap | None = None
        self._place = -1
        self._verdicts: dict[str, bool] = {}  # by id of the closure; True = accepted
        gui = viewer.server.gui
        self._folder = gui.add_folder(
            "Closure court", order=0.5, visible=False, expand_by_default=False
        )
        with self._folder:
            self.image = gui.add_image(np.zeros((8, 8, 3), dtype=np.uint8), visible=False)
            self.text = gui.add_html("")
            for label, key, verdict, colour, hint in _BUTTONS:
                button = gui.add_button(label, color=colour, hint=f"{hint} (key {key})")
                callback = viewer.by_user(partial(self.judge, verdict))
                button.on_click(callback)
                gui.add_command(f"closure court: {label}", hotkey=key).on_trigger(callback)

    def show(self, vi_map: VIMap) -> None:
        """Call the cases of a map; verdicts that were given stay."""
        if vi_map is self._map:
            return
        self._map, self._cases, self._place = vi_map, cases_of(vi_map), -1
        parts.update(self._folder, visible=bool(len(self._cases)))
        self._show_images()
        self._say()

    def take_verdicts(self) -> dict[str, bool]:
        """Return the verdicts by id, True = accepted, and forget them."""
        verdicts, self._verdicts = self._verdicts, {}
        self._say()
        return verdicts

    def judge(self, verdict: bool | None, event: Any) -> None:
        """Note a verdict on the case that is open, None = none, and open the next one."""
        if self._map is None or not len(self._cases):
            return
        closures = read_record(self._map).closures
        if verdict is not None and self._place < 0:
            self._say("open a case first (J)")
            return
        if verdict is not None:
            self._verdicts[to_hex(closures.id[self._cases[self._place]])] = verdict
        self._place = (self._place + 1) % len(self._cases)
        row = int(self._cases[self._place])
        drawing = self._viewer.drawing
        ends = np.concatenate(closure_ends(drawing, closures.take(np.array([row]))))
        p = drawing.p_vertices[ends]
        self._viewer.select(picking.Pick(scene.Entity.CLOSURE, row, p.mean(axis=0), 0.0))
        self._show_images()
        if event.client is not None:
            distance_m = 1.5 * float(np.linalg.norm(p[1] - p[0])) + 0.4 * drawing.extent.radius_m
            with event.client.atomic():
                camera.approach(event.client.camera, p.mean(axis=0), distance_m)
        self._say()

    def _show_images(self) -> None:
        """Show both images of the open case with lines between what they have in common."""
        picture = self._viewer.selection.picture if self._place >= 0 else None
        if picture is not None:
            self.image.image = picture
        parts.update(self.image, visible=picture is not None)

    def _say(self, note: str = "") -> None:
        """Write which case is open, and what was decided."""
        lines, table = [note] if note else [], ""
        if self._place >= 0 and self._map is not None:
            closures = read_record(self._map).closures
            row = int(self._cases[self._place])
            verdict = self._verdicts.get(name := to_hex_list(closures.id)[row])
            decided = {None: "", True: ", you accept it", False: ", you refuse it"}[verdict]
            refused = VERDICTS[closures.verdict[row]].value
            lines.append(
                f"<b>{self._place + 1} of {len(self._cases)}: {name[:8]}</b> {escape(refused)}{decided}"
            )
            gates = [
                fact
                for fact in facts.gate_facts(self._map, row)
                if not fact[0].startswith("passed")
            ]
            table = panel.fact_table(tuple(gates))
        elif len(self._cases):
            lines.append(f"{len(self._cases)} refused closures that were near to be accepted")
        if self._verdicts:
            accepted = sum(self._verdicts.values())
            refused_count = len(self._verdicts) - accepted
            lines.append(
                f"{accepted} accepted, {refused_count} refused. At the prompt: <b>judge_closures</b>"
            )
        self.text.content = panel.small("<br>".join(lines)) + table
