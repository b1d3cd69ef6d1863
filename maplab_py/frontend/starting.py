"""What finds the state with which odometry starts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from maplab_py.estimation.window.frame import StartState, WindowFrame
from maplab_py.interop.recordings.protocol import RecordedSensors


class Starter(Protocol):
    """Takes frames until it knows the state of the newest."""

    @property
    def reason(self) -> str:
        """Why there is no state so far, in plain words."""

    def push(self, frame: WindowFrame) -> StartState | None:
        """Take the next frame; return its state, None while it is not known."""


MakeStarter = Callable[[RecordedSensors], Starter]
"""Makes a starter, each time that the estimator starts."""
