"""Progress of long computations, and their cancellation."""

from typing import Protocol


class Progress(Protocol):
    """Progress bar, lines of text and cancellation of a running algorithm."""

    def step(self, done: float, total: float, what: str = "") -> None:
        """Say that `done` of `total` is finished; raises Cancelled when the user wants to stop."""

    def line(self, text: str) -> None:
        """Print one line of intermediate result (a solver iteration)."""

    def check(self) -> None:
        """Raise Cancelled when the user wants to stop; cheap, call it in every long loop."""


class SilentProgress:
    """Progress that nobody watches and nobody cancels."""

    def step(self, done: float, total: float, what: str = "") -> None:
        """Do nothing."""

    def line(self, text: str) -> None:
        """Do nothing."""

    def check(self) -> None:
        """Do nothing."""


SILENT: Progress = SilentProgress()
