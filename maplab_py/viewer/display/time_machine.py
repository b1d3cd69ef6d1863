"""The undo history of the map as a slider in the panel, with the errors of its states."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from maplab_py.viewer import building, history
from maplab_py.viewer.display import parts

if TYPE_CHECKING:
    from maplab_py.viewer.display.viewer import Viewer


class TimeMachine:
    """The widgets; they are there when the map has more than one state."""

    def __init__(self, viewer: Viewer) -> None:
        """Make the widgets."""
        self._lock, gui = viewer.lock, viewer.server.gui
        self._folder = gui.add_folder("History", order=1.5, visible=False)
        with self._folder:
            self.slider: Any = gui.add_slider(
                "state", 0, 1, 1, 1, hint="the map before and after each command"
            )
            self.swipe: Any = gui.add_checkbox(
                "swipe line", False, hint="the state left of a line, the map right of it"
            )
            self.chart = gui.add_html("")
        show = viewer.by_user(lambda _: viewer.set_state(int(self.slider.value)))
        self.swipe.on_update(show)
        self.slider.on_update(show)
        self._is_stopped = False
        self._subject: building.Subject | None = None
        self._curves: tuple[history.Curve, ...] = ()
        self._measured: building.Subject | None = None  # that the curves belong to

    @property
    def swipes(self) -> bool:
        """Tell whether states are shown left of a swipe line."""
        return bool(self.swipe.value)

    def show(self, subject: building.Subject) -> None:
        """Show the history of a subject, with the curves that are known of it."""
        self._subject = subject
        states = subject.history
        parts.update(self._folder, visible=len(states) > 1)
        if len(states) < 2:
            return
        is_swiped = subject.other is not None and subject.arrangement == "swipe"
        parts.update(self.swipe, value=is_swiped)
        parts.update(self.slider, max=len(states) - 1)
        place = subject.place
        if place < 0:  # another map is left of the swipe line
            place = max(subject.replace(other=None).place, 0)
        parts.update(self.slider, value=place)
        is_known = self._measured is not None and self._measured.history is states
        self.chart.content = history.history_chart(states, self._curves if is_known else (), place)

    def stop(self) -> None:
        """Change nothing any more: the server is about to stop."""
        self._is_stopped = True

    def measure(self) -> None:
        """Compute the curves of what is shown, unless they are known: this takes a moment in large maps."""
        subject = self._subject
        if subject is None or len(subject.history) < 2:
            return
        if self._measured is not None and self._measured.history is subject.history:
            return
        curves = history.error_curves(subject.history, subject.truth)
        with self._lock:
            if self._is_stopped:
                return
            self._curves, self._measured = curves, subject
            if self._subject is not None:
                self.show(self._subject)
