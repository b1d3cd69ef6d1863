"""Wait for a condition instead of a fixed time."""

import time
from collections.abc import Callable

_PAUSE_S = 0.01


def wait_until(condition: Callable[[], object], at_most_s: float = 30.0) -> bool:
    """Wait until a condition holds; return whether it does.

    Args:
        condition: Called again and again until its result is true.
        at_most_s: Longest time to wait [s].
    """
    deadline = time.monotonic() + at_most_s
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(_PAUSE_S)
    return True
