"""Playback: the steps of the time line, what the scene and the plots show at each, and the tick."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from typing import Protocol

import numpy as np
import viser

from maplab_py.array_types import I64
from maplab_py.viewer.building import Subject
from maplab_py.viewer.display.camera import FREE, ride
from maplab_py.viewer.display.player import Player
from maplab_py.viewer.display.selection import ImageOf, no_image
from maplab_py.viewer.display.strip_chart import image_tag, plot_paths, strip_chart, value_text
from maplab_py.viewer.display.time_line import TimeLine
from maplab_py.viewer.drawing import Drawing
from maplab_py.viewer.options import PlaybackOptions
from maplab_py.viewer.signals import Signal, vertex_signals

logger = logging.getLogger(__name__)


class Played(Protocol):
    """The view whose map is played."""

    @property
    def drawing(self) -> Drawing:
        """The map as it is drawn."""

    @property
    def subject(self) -> Subject | None:
        """Shown view."""

    @property
    def visible_missions(self) -> set[str]:
        """Ids of the missions that are drawn."""

    def redraw(self) -> None:
        """Draw the whole map, or without what playback draws while it plays."""


class Playback:
    """Playback, if there is one.

    Attributes:
        player: The nodes of the steps; None while the whole map is shown.
        options: How missions are played.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        view: Played,
        lock: threading.RLock,
        say: Callable[[str], None],
    ) -> None:
        """Show the whole map at first."""
        self._server = server
        self._view = view
        self._lock = lock
        self._say = say
        self.time_line = TimeLine(server, self, lock, say)
        self.player: Player | None = None
        self.options = PlaybackOptions()
        self._image_of: ImageOf = no_image
        self._ride = FREE
        self._mission = -1  # row whose plots are shown, -1 = the first that is played
        self._signals: tuple[Signal, ...] = ()
        self._curves: list[tuple[str, tuple[str, ...]]] = []
        self._is_stopped = False
        self._ticker = threading.Thread(target=self._tick, name="maplab playback", daemon=True)
        self._ticker.start()

    def configure(self, options: PlaybackOptions, image_of: ImageOf) -> None:
        """Play another way, with images from elsewhere."""
        self.options = options
        self._image_of = image_of
        self._mission = -1

    def set_step(self, step: int) -> None:
        """Show the map as it was after a step; the last step is the whole map."""
        if self._view.subject is None:
            return
        if step >= self.options.steps:
            self.stop()
            self._view.redraw()
            return
        if self.player is None:
            self._begin(self._view.subject)
        if self.player is not None:
            self.player.go(max(step, 0))
            self._show(self.player)

    def set_playing(self, is_playing: bool) -> None:
        """Play or pause; playing from the end starts again at the beginning."""
        if is_playing and self.player is None:
            self.set_step(0)
        self.time_line.set_playing(is_playing)

    def choose_mission(self, label: str) -> None:
        """Plot another mission."""
        names = self._view.drawing.mission_names
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
        steps = self.options.steps
        self.time_line.show_step(steps, steps, "the whole map")

    def end(self) -> None:
        """End the thread that plays."""
        self._is_stopped = True

    def _begin(self, subject: Subject) -> None:
        """Send the nodes of all steps, and compute what is plotted."""
        drawing = self._view.drawing
        self.player = Player(
            self._server, drawing, self._view.visible_missions, self.options, subject.clouds
        )
        self._view.redraw()
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
        progress = player.timeline.vertex_step[vertices] / self.options.steps
        return [(s.title, plot_paths(s, vertices, progress)) for s in self._signals]

    def _vertices_of_mission(self) -> I64:
        start = self._view.drawing.vi_map.vertex_start
        return np.arange(start[self._mission], start[self._mission + 1])

    def _show(self, player: Player) -> None:
        """Show a step on the time line, and move the view if it rides along."""
        vertex = player.head(self._mission)
        image = self._image_of(vertex) if vertex >= 0 else None
        rows = [
            (title, paths, value_text(signal, vertex) if vertex >= 0 else "")
            for signal, (title, paths) in zip(self._signals, self._curves, strict=True)
        ]
        at = player.step / self.options.steps
        plots = strip_chart(rows, at, "" if image is None else image_tag(image))
        self.time_line.show_step(player.step, self.options.steps, player.note(), plots)
        if vertex >= 0 and self._ride != FREE:
            for client in self._server.get_clients().values():
                with client.atomic():
                    ride(client.camera, self._view.drawing, vertex, self._ride)

    def _tick(self) -> None:
        """Move the slider while it plays."""
        while not self._is_stopped:
            time.sleep(1.0 / self.options.vertex_frequency)
            try:
                with self._lock:
                    if not self._is_stopped and self.time_line.is_playing and self.player:
                        self.set_step(self.player.step + 1)
            except Exception:
                logger.exception("the viewer cannot play on")
                with self._lock:
                    self.time_line.set_playing(False)
                    self._say("playing stopped: the log file has the reason")
