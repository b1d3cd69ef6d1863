"""Playback: the steps of the time line, what the scene and the plots show at each, and the tick."""

from __future__ import annotations

import base64
import logging
import threading
import time
from html import escape
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from maplab_py.array_types import F64, I64, U8
from maplab_py.viewer.building import Subject
from maplab_py.viewer.colours import AXES, hex_codes
from maplab_py.viewer.display import panel, parts
from maplab_py.viewer.display.camera import FREE, RIDES, ride
from maplab_py.viewer.display.player import Player
from maplab_py.viewer.options import PlaybackOptions
from maplab_py.viewer.playback import Signal, step_seconds, vertex_signals

if TYPE_CHECKING:
    from maplab_py.viewer.display.viewer import Viewer

logger = logging.getLogger(__name__)


class Playback:
    """Playback, if there is one."""

    def __init__(self, viewer: Viewer) -> None:
        self._viewer = viewer
        self.time_line = TimeLine(viewer, self)
        # the nodes of the steps; None while the whole map is shown
        self.player: Player | None = None
        self.options = PlaybackOptions()  # how missions are played
        self._ride = FREE
        self._mission = -1  # row whose plots are shown, -1 = the first that is played
        self._signals: tuple[Signal, ...] = ()
        self._curves: list[tuple[str, tuple[str, ...]]] = []
        self._seconds = np.zeros(2)  # of the steps
        self._is_stopped = False
        self._ticker = threading.Thread(target=self._tick, name="maplab playback", daemon=True)
        self._ticker.start()

    def configure(self, options: PlaybackOptions) -> None:
        """Play another way."""
        self.options = options
        self._mission = -1

    def set_step(self, step: int) -> None:
        """Show the map as it was after a step; the last step is the whole map."""
        if self._viewer.subject is None:
            return
        if step >= self.options.steps:
            self.stop()
            self._viewer.redraw()
            return
        if self.player is None:
            self._begin(self._viewer.subject)
        if self.player is not None:
            self.player.go(max(step, 0))
            self._show(self.player)

    def set_time(self, time_s: float) -> None:
        """Show the map as it was at a time of the longest mission; at its end the whole map."""
        self.set_step(int(np.searchsorted(self._seconds, time_s - 1e-6)))

    def set_playing(self, is_playing: bool) -> None:
        """Play or pause; playing from the end starts again at the beginning."""
        if is_playing and self.player is None:
            self.set_step(0)
        self.time_line.set_playing(is_playing)

    def choose_mission(self, label: str) -> None:
        """Plot another mission."""
        names = self._viewer.drawing.mission_names
        if label in names and self.player is not None:
            self._mission = names.index(label)
            self._curves = self._make_curves(self.player)
            self._show(self.player)

    def set_ride(self, ride: str) -> None:
        """Let the view ride along, one of `RIDES`."""
        self._ride = ride
        self.time_line.show_ride(ride)
        if self.player is not None:
            self._show(self.player)

    def stop(self) -> None:
        """Show the whole map again."""
        if self.player is not None:
            self.player.remove()
            self.player = None
            self._signals, self._curves = (), []
        self.time_line.set_playing(False)
        if self._viewer.subject is not None:
            self._seconds = step_seconds(self._viewer.drawing, self.options)
        self.time_line.show_step(self._seconds, self.options.steps, "the whole map")

    def end(self) -> None:
        """End the thread that plays."""
        self._is_stopped = True

    def _begin(self, subject: Subject) -> None:
        """Send the nodes of all steps, and compute what is plotted."""
        drawing = self._viewer.drawing
        self.player = Player(
            self._viewer.server,
            drawing,
            self._viewer.visible_missions,
            self.options,
            subject.clouds,
        )
        self._viewer.redraw()
        played = self.player.missions()
        if self._mission not in played.tolist():
            self._mission = int(played[0]) if len(played) else -1
        labels = tuple(drawing.mission_names[row] for row in played.tolist())
        chosen = drawing.mission_names[self._mission] if self._mission >= 0 else ""
        self.time_line.show_missions(labels, chosen)
        self._signals = vertex_signals(drawing, subject.truth)
        self._curves = self._make_curves(self.player)

    def _make_curves(self, player: Player) -> list[tuple[str, tuple[str, ...]]]:
        """Return the plots of the chosen mission; their x axis is that of the slider."""
        if self._mission < 0:
            return []
        vertices = self._vertices_of_mission()
        progress = self._share(player.timeline.vertex_step[vertices])
        return [(s.title, plot_paths(s, vertices, progress)) for s in self._signals]

    def _share(self, step: I64) -> F64:
        """Return where steps are along the slider, in [0, 1]."""
        return np.asarray(self._seconds[step] / max(float(self._seconds[-1]), 1e-9))

    def _vertices_of_mission(self) -> I64:
        start = self._viewer.drawing.vi_map.vertex_start
        return np.arange(start[self._mission], start[self._mission + 1])

    def _show(self, player: Player) -> None:
        """Show a step on the time line, and move the view if it rides along."""
        vertex = player.head(self._mission)
        image = self._viewer.drawing.images(vertex) if vertex >= 0 else None
        rows = [
            (title, paths, value_text(signal, vertex) if vertex >= 0 else "")
            for signal, (title, paths) in zip(self._signals, self._curves, strict=True)
        ]
        at = float(self._share(np.array(player.step)))
        plots = strip_chart(rows, at, "" if image is None else image_tag(image))
        self.time_line.show_step(self._seconds, player.step, player.note(), plots)
        if vertex >= 0 and self._ride != FREE:
            for client in self._viewer.server.get_clients().values():
                with client.atomic():
                    ride(client.camera, self._viewer.drawing, vertex, self._ride)

    def _tick(self) -> None:
        """Move the slider while it plays."""
        while not self._is_stopped:
            time.sleep(1.0 / self.options.vertex_frequency)
            try:
                with self._viewer.lock:
                    if not self._is_stopped and self.time_line.is_playing and self.player:
                        self.set_step(self.player.step + 1)
            except Exception:
                logger.exception("the viewer cannot play on")
                with self._viewer.lock:
                    self.time_line.set_playing(False)
                    self._viewer.say("playing stopped: the log file has the reason")


_WIDTH, _HEIGHT = 1000, 100
"""Units of a plot's drawing, which is stretched to the room that there is."""
_ROW_PX = 26
_POINTS = 250
_SINGLE = ("#4c8dd6",)
_IMAGE_PX = 320


def plot_paths(signal: Signal, vertices: I64, progress: F64) -> tuple[str, ...]:
    """Return the curves of a signal, one SVG path per component, in a box of `_WIDTH` x `_HEIGHT`.

    Args:
        vertices: Rows (N,) of one mission, in order.
        progress: Where (N,) each of them is along the time line, in [0, 1].
    """
    values = signal.values[vertices]
    low, high = _range(values)
    y = _HEIGHT * (0.94 - 0.88 * (values - low) / (high - low))
    return tuple(_path(_WIDTH * progress, column) for column in y.T)


def _range(values: F64) -> tuple[float, float]:
    """Return between which values a plot extends; a hundredth at each end may lie outside."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return 0.0, 1.0
    low, high = np.percentile(finite, [1.0, 99.0]).tolist()
    if high - low < 1e-12:
        return low - 0.5, high + 0.5
    margin = 0.1 * (high - low)
    return low - margin, high + margin


def _path(x: F64, y: F64) -> str:
    """Return a polyline of at most twice `_POINTS` corners that keeps the extremes; NaN is a gap."""
    keep = np.arange(len(x))
    if len(x) > 2 * _POINTS:
        cell = np.minimum((x * (_POINTS / _WIDTH)).astype(np.int64), _POINTS - 1)
        order = np.lexsort((np.nan_to_num(y, nan=0.5 * _HEIGHT), cell))
        first = np.flatnonzero(np.diff(cell[order], prepend=-1))
        last = np.append(first[1:], len(order)) - 1
        keep = np.unique(np.concatenate([order[first], order[last]]))
    is_known = np.isfinite(y[keep])
    starts = is_known & ~np.append(False, is_known[:-1])
    return "".join(
        f"{'M' if start else 'L'}{px:.0f} {py:.0f}"
        for px, py, start, known in zip(
            x[keep].tolist(), np.clip(y[keep], -50, 150).tolist(), starts.tolist(), is_known.tolist(),
            strict=True,
        )
        if known
    )  # fmt: skip


def value_text(signal: Signal, vertex: int) -> str:
    """Return the values of a signal at a vertex, with its unit; a dash where they are unknown."""
    values = signal.values[vertex]
    if not np.isfinite(values).all():
        return "-"
    return " ".join(f"{value:.{signal.decimals}f}" for value in values.tolist()) + (
        f" {signal.unit}" if signal.unit else ""
    )


def image_tag(image: U8) -> str:
    """Return an image (H, W, 3) or (H, W) as a tag that carries its data."""
    scale = min(1.0, _IMAGE_PX / max(image.shape[1], 1))
    size = (max(1, round(scale * image.shape[1])), max(1, round(scale * image.shape[0])))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    if small.ndim == 3:
        small = np.ascontiguousarray(small[:, :, ::-1])
    _, data = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 80])
    code = base64.b64encode(data.tobytes()).decode()
    return (
        f"<img src='data:image/jpeg;base64,{code}' alt='image of the vertex' "
        "style='height:100%;max-width:40%;object-fit:contain;border-radius:4px'>"
    )


def strip_chart(rows: list[tuple[str, tuple[str, ...], str]], at: float, image: str = "") -> str:
    """Return the plots below each other with a line at the present position, and an image beside.

    Args:
        rows: Title, curves and present values of each plot.
        at: The present position along the time line, in [0, 1].
        image: A tag that is shown beside the plots.
    """
    lines = "".join(_row(title, paths, value, at) for title, paths, value in rows)
    height = _ROW_PX * max(len(rows), 1)
    return (
        f"<div style='display:flex;gap:0.8em;padding:0.1em 0.9em 0.4em 0.9em;height:{height}px;"
        "font-size:0.74em;line-height:1.1'>"
        f"<div style='flex:1;min-width:0'>{lines}</div>{image}</div>"
    )


def _row(title: str, paths: tuple[str, ...], value: str, at: float) -> str:
    colours = _SINGLE if len(paths) == 1 else hex_codes(AXES)
    curves = "".join(
        f"<path d='{path}' fill='none' stroke='{colour}' stroke-width='1.3' "
        "vector-effect='non-scaling-stroke'/>"
        for path, colour in zip(paths, colours, strict=False)
    )
    x = _WIDTH * at
    return (
        f"<div style='display:flex;align-items:center;height:{_ROW_PX}px'>"
        f"<span style='width:11em;white-space:nowrap;opacity:0.65'>{escape(title)}</span>"
        f"<svg viewBox='0 0 {_WIDTH} {_HEIGHT}' preserveAspectRatio='none' "
        f"style='flex:1;min-width:0;height:{_ROW_PX - 4}px;background:rgba(128,128,128,0.09)'>"
        f"{curves}<path d='M{x:.1f} 0V{_HEIGHT}' stroke='currentColor' stroke-width='1' "
        "vector-effect='non-scaling-stroke'/></svg>"
        "<span style='width:15.5em;padding-left:0.7em;white-space:nowrap;"
        f"font-variant-numeric:tabular-nums'>{escape(value)}</span></div>"
    )


_WIDTH_PX = 640
_SLIDER_STEP_S = 0.01
_PLAY, _PAUSE = "play", "pause"
_MARGIN_PX = 15
_HINT = "Move the slider to play the missions: plots of the first one appear here."


class TimeLine:
    """The widgets, in a window of their own that a user can move, minimise and dock."""

    def __init__(self, viewer: Viewer, playback: Playback) -> None:
        self._playback, gui = playback, viewer.server.gui
        self._is_sliding = False
        self.is_playing = False
        self.panel = gui.add_panel()
        with self.panel.add_tab("Time line"):
            self.slider: Any = gui.add_slider("time [s]", 0.0, 1.0, _SLIDER_STEP_S, 1.0)
            self.play: Any = gui.add_button(_PLAY, hint="space bar")
            self.ride: Any = gui.add_dropdown(
                "view", RIDES, hint="let the view ride along with the plotted mission"
            )
            self.mission: Any = gui.add_dropdown("plots of", ("",), visible=False)
            self.time = gui.add_html(panel.hint("the whole map"))
            self.plots = gui.add_html(panel.hint(_HINT))
        self.panel.float(x=_MARGIN_PX, y=-_MARGIN_PX, width=_WIDTH_PX)
        self.panel.minimize()
        for widget, action in (
            (self.slider, self._slide),
            (self.ride, lambda event: playback.set_ride(event.target.value)),
            (self.mission, lambda event: playback.choose_mission(event.target.value)),
        ):
            widget.on_update(viewer.by_user(action))
        toggle = viewer.by_user(lambda _: playback.set_playing(not self.is_playing))
        self.play.on_click(toggle)
        gui.add_command("play or pause the missions", hotkey="space").on_trigger(toggle)

    def _slide(self, event: Any) -> None:
        """Follow the slider, which the user may hold: it must not be pushed back meanwhile."""
        self._is_sliding = True
        try:
            self._playback.set_time(float(event.target.value))
        finally:
            self._is_sliding = False

    def open(self) -> None:
        """Open the window."""
        self.panel.expand()

    def show_missions(self, labels: tuple[str, ...], chosen: str) -> None:
        """Offer missions to plot; one alone needs no list."""
        options = labels or ("",)
        parts.update(self.mission, options=options, visible=len(labels) > 1)
        if labels:
            parts.update(self.mission, value=chosen)

    def show_step(self, seconds: F64, step: int, note: str, plots: str = "") -> None:
        """Move the slider, which may have another length now, unless it moved us.

        Args:
            seconds: Times (N,) of all steps; the last one is the whole map.
            step: Where playback is.
            plots: HTML of the plots; empty = the hint.
        """
        length = max(_SLIDER_STEP_S, float(np.ceil(seconds[-1] / _SLIDER_STEP_S)) * _SLIDER_STEP_S)
        if abs(float(self.slider.max) - length) > 0.5 * _SLIDER_STEP_S:
            self.slider.max = length
        value = length if step >= len(seconds) - 1 else float(seconds[step])
        if not self._is_sliding and abs(float(self.slider.value) - value) > 1e-6:
            self.slider.value = value
        self.time.content = panel.hint(note)
        self.plots.content = plots or panel.hint(_HINT)

    def show_ride(self, ride: str) -> None:
        """Show how the view rides along."""
        parts.update(self.ride, value=ride)

    def set_playing(self, is_playing: bool) -> None:
        """Show whether it plays."""
        self.is_playing = is_playing
        parts.update(self.play, label=_PAUSE if is_playing else _PLAY)
