"""Processor times beside the speed of the machine."""

import dataclasses
import time
from collections.abc import Callable
from typing import TypeVar

from tests.support.machine import slowness

T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class Times:
    """Processor times [s] of some runs."""

    processor_s: tuple[float, ...]
    slowness: tuple[float, ...]  # of the machine around each
    ordinary_s: float  # least quotient of the two


def timed(action: Callable[[], T], repeats: int) -> tuple[T, Times]:
    """Return the last result of an action, and the times of all runs."""
    seconds, factors = [], []
    for _ in range(repeats):
        before, begin = slowness(), time.process_time()
        result = action()
        seconds.append(time.process_time() - begin)
        factors.append((before + slowness()) / 2)
    ordinary = min(s / f for s, f in zip(seconds, factors, strict=True))
    return result, Times(tuple(seconds), tuple(factors), ordinary)
