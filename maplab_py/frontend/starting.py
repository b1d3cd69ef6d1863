"""Search for the state with which odometry starts."""

import dataclasses
from collections.abc import Callable
from typing import Protocol

from maplab_py.estimation.window.frame import StartState, WindowFrame
from maplab_py.interop.recordings.protocol import RecordedSensors


@dataclasses.dataclass(frozen=True, eq=False)
class Start:
    """The state of a frame, and the frames that have come since."""

    frame: WindowFrame
    state: StartState
    later: tuple[WindowFrame, ...] = ()  # in the order of time
    is_resting: bool = False  # the device rests since a while
    scale_sigma: float = 0.0  # standard deviation of the scale of the motion, as a share of it


class Starter(Protocol):
    """Takes frames until it knows the state of the newest, or of one shortly before."""

    @property
    def reason(self) -> str:
        """Reason why there is no state so far, in plain words."""

    def push(self, frame: WindowFrame) -> Start | None:
        """Take the next frame; return a start whose last frame it is, None while there is none."""


MakeStarter = Callable[[RecordedSensors], Starter]
"""Makes a starter, each time that the estimator starts."""
