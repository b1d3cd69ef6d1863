"""How fast this machine is just now, so that bars in seconds mean the same on every one."""

from __future__ import annotations

import time

_REFERENCE_SECONDS = 0.04
"""Time of the loop below on an ordinary machine that is not throttled."""


def slowness() -> float:
    """Return how many times slower than an ordinary machine this one is now; at least 1.

    A plain loop of the interpreter is the measure: nothing that the project does can change it.
    """
    best = min(_loop_seconds() for _ in range(3))
    return max(1.0, best / _REFERENCE_SECONDS)


def _loop_seconds() -> float:
    start = time.process_time()
    total = 0
    for number in range(1_000_000):
        total += number
    assert total == 499_999_500_000
    return time.process_time() - start
