"""A motion that is asked of the person who carries the device: an arrow, and a bar that fills."""

from __future__ import annotations

import threading
from html import escape
from typing import TYPE_CHECKING

import viser

from maplab_py.viewer.display.panel import small

if TYPE_CHECKING:
    from maplab_py.online_calibration.suggestions import Motion

_DEVICE = (
    '<rect x="-26" y="-17" width="52" height="34" rx="5" fill="none" stroke="currentColor" '
    'stroke-width="2.5"/><circle r="9" fill="none" stroke="currentColor" stroke-width="2.5"/>'
)
"""The camera as it is seen by the person who holds it; it looks away from them."""
_TURNS = (
    "M44 -30 C62 -14 62 14 44 30",  # up and down, about x
    "M-34 30 C-16 46 16 46 34 30",  # left and right, about y
    "M-42 8 A43 43 0 1 1 42 8",  # like a steering wheel, about z
)
_MOVES = (
    ("M-34 0 H-72", "M34 0 H72"),
    ("M0 -25 V-54", "M0 25 V54"),
    ("M-30 21 L-62 46", "M30 -21 L62 -46"),
)
"""Paths along x (right), y (down) and z (away) of the camera."""
_WALL = (
    '<rect x="-94" y="-64" width="188" height="128" fill="none" stroke="currentColor" '
    'stroke-width="3" stroke-dasharray="7 6"/>'
)
_NEAR_M = 1.0
"""Motions as close as this to a wall show it."""


class MotionRequest:
    """Place above the layers that asks for the motion which a calibration lacks."""

    def __init__(self, server: viser.ViserServer, lock: threading.RLock) -> None:
        """Ask for nothing."""
        self._lock = lock
        self._html = server.gui.add_html("", order=0.5, visible=False)

    def show(self, words: str, known_share: float) -> None:
        """Show a motion, or that none is missing, in all pages; see `motion_card`."""
        with self._lock:
            self._html.content = motion_card(words, known_share)
            self._html.visible = True


def motion_card(words: str, known_share: float) -> str:
    """Return HTML: arrows of a motion about or along the axes of the camera, and how much is known.

    Args:
        words: Of a motion of `suggestions.MOTIONS`; empty = nothing more is missing.
        known_share: Part of the calibration's way to the wanted deviations.
    """
    from maplab_py.online_calibration.suggestions import MOTIONS

    percent = int(100.0 * min(max(known_share, 0.0), 1.0))
    bar = (
        f"<div role='progressbar' aria-label='calibration known' aria-valuenow='{percent}' "
        "style='height:0.6em;border-radius:0.3em;background:#8886;margin:0.3em 0'><div style='height:100%;"
        f"width:{percent}%;border-radius:0.3em;background:#1f8a4c'></div></div>"
    )
    if not words:
        return small(f"<b>Calibration known as well as wanted</b>{bar}")
    arrows = "".join(_arrows(motion) for motion in MOTIONS if motion.words == words)
    asked = escape(words[0].upper() + words[1:])
    return small(f"<b>{asked}</b>{arrows}{bar}calibration known: {percent} % of what is wanted")


def _arrows(motion: Motion) -> str:
    paths = [path for path, angle in zip(_TURNS, motion.turn_deg, strict=True) if angle]
    paths += [p for pair, each in zip(_MOVES, motion.move_m, strict=True) if each for p in pair]
    tip, both = "marker-end='url(#maplab-tip)'", "marker-start='url(#maplab-tip)'"
    lines = "".join(f"<path d='{p}' {tip} {both if p in _TURNS else ''}/>" for p in paths)
    return (
        f"<svg viewBox='-100 -68 200 136' role='img' aria-label='{escape(motion.words)}' "
        "style='display:block;width:100%;max-height:8em'><defs><marker id='maplab-tip' viewBox='0 0 8 8' "
        "refX='5' refY='4' markerWidth='4' markerHeight='4' orient='auto-start-reverse'>"
        "<path d='M0 0 L8 4 L0 8 z' fill='#d9480f'/></marker></defs>"
        f"{_WALL if motion.wall_m <= _NEAR_M else ''}{_DEVICE}"
        f"<g fill='none' stroke='#d9480f' stroke-width='4' stroke-linecap='round'>{lines}</g></svg>"
    )
