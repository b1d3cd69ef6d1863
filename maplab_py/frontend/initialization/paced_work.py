"""Work that is done in parts, so that no frame waits for all of it.

How much is done at a time is counted in units of work and not in time, so that the same frames always
give the same results. A unit takes about a millisecond on an ordinary machine.
"""

from collections.abc import Generator
from typing import Generic, TypeVar

R = TypeVar("R")

Work = Generator[float, None, R]
"""Yields the units of work done since it was resumed; returns the result."""


def each_step(steps: Generator[None, None, R], units: float) -> Work[R]:
    """Count so many units for every step; return the result of the steps."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            result: R = end.value
            return result
        yield units


def finished(work: Work[R]) -> R:
    """Do all of the work; return its result."""
    while True:
        try:
            next(work)
        except StopIteration as end:
            result: R = end.value
            return result


class PacedWork(Generic[R]):
    """Work under way."""

    def __init__(self, work: Work[R]) -> None:
        """Begin; nothing is done yet."""
        self._work = work
        self._allowed = 0.0

    def advance(self, units: float) -> R | None:
        """Do so many units, or a few more, for which later calls do less; return the result at the end.

        The result must not be None.
        """
        self._allowed += units
        while self._allowed > 0.0:
            try:
                self._allowed -= next(self._work)
            except StopIteration as end:
                result: R = end.value
                return result
        return None
