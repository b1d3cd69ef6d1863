"""The time line under the scene: slider, plots along the played mission, and its image."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, Protocol

import viser

from maplab_py.viewer.display import text
from maplab_py.viewer.display.callbacks import by_user
from maplab_py.viewer.display.camera import RIDES

_WIDTH_PX = 640
_MARGIN_PX = 15
_HINT = "Move the slider to play the missions: plots of the first one appear here."


class Playing(Protocol):
    """Requests of the time line."""

    def set_step(self, step: int) -> None:
        """Show the map as it was after a step."""

    def set_playing(self, is_playing: bool) -> None:
        """Play or pause."""

    def choose_mission(self, label: str) -> None:
        """Plot another mission."""

    def set_ride(self, ride: str) -> None:
        """Let the view ride along, one of `RIDES`."""


class TimeLine:
    """The widgets, in a window of their own that a user can move, minimise and dock."""

    def __init__(
        self,
        server: viser.ViserServer,
        playing: Playing,
        lock: threading.RLock,
        say: Callable[[str], None],
    ) -> None:
        """Make the widgets."""
        self._playing = playing
        self._steps = 200
        self._is_sliding = False
        self.panel = server.gui.add_panel()
        with self.panel.add_tab("Time line"):
            self.slider: Any = server.gui.add_slider("step", 0, self._steps, 1, self._steps)
            self.play: Any = server.gui.add_checkbox("play", False)
            self.ride: Any = server.gui.add_dropdown(
                "view", RIDES, hint="let the view ride along with the plotted mission"
            )
            self.mission: Any = server.gui.add_dropdown("plots of", ("",), visible=False)
            self.time = server.gui.add_html(text.hint("the whole map"))
            self.plots = server.gui.add_html(text.hint(_HINT))
        self.panel.float(x=_MARGIN_PX, y=-_MARGIN_PX, width=_WIDTH_PX)
        self.panel.minimize()
        for widget, action in (
            (self.slider, self._slide),
            (self.play, lambda event: playing.set_playing(event.target.value)),
            (self.ride, lambda event: playing.set_ride(event.target.value)),
            (self.mission, lambda event: playing.choose_mission(event.target.value)),
        ):
            widget.on_update(by_user(lock, action, say))

    def _slide(self, event: Any) -> None:
        """Follow the slider, which the user may hold: it must not be pushed back meanwhile."""
        self._is_sliding = True
        try:
            self._playing.set_step(int(event.target.value))
        finally:
            self._is_sliding = False

    def open(self) -> None:
        """Open the window."""
        self.panel.expand()

    def show_missions(self, labels: tuple[str, ...], chosen: str) -> None:
        """Offer missions to plot; one alone needs no list."""
        options = labels or ("",)
        if tuple(self.mission.options) != options:
            self.mission.options = options
        if labels and self.mission.value != chosen:
            self.mission.value = chosen
        if self.mission.visible != (len(labels) > 1):
            self.mission.visible = len(labels) > 1

    def show_step(self, step: int, steps: int, note: str, plots: str = "") -> None:
        """Move the slider, which may have another number of steps now, unless it moved us.

        Args:
            step: Where playback is; the last step is the whole map.
            steps: Their number.
            note: Words beside the slider.
            plots: HTML of the plots; empty = the hint.
        """
        if steps != self._steps:
            self.slider.max = steps
            self._steps = steps
        if not self._is_sliding and int(self.slider.value) != step:
            self.slider.value = step
        self.time.content = text.hint(note)
        self.plots.content = plots or text.hint(_HINT)

    def show_ride(self, ride: str) -> None:
        """Show how the view rides along."""
        if self.ride.value != ride:
            self.ride.value = ride

    @property
    def is_playing(self) -> bool:
        """Tell whether the box is ticked."""
        return bool(self.play.value)

    def set_playing(self, is_playing: bool) -> None:
        """Tick the box or not."""
        if self.play.value != is_playing:
            self.play.value = is_playing
