"""What a run of the tests did not cover, since the machine lacks something."""

from collections import Counter
from collections.abc import Iterable

NO_DATA, NO_BROWSER, NO_ROBOT = "no real data", "no browser", "no robot's programs"
"""How the reasons of tests begin that are skipped for want of it."""

_WORDS = {NO_DATA: "real data", NO_BROWSER: "a browser", NO_ROBOT: "ROS or Foxglove"}


def not_run_here(reasons: Iterable[str]) -> str:
    """Return one line that counts the tests skipped for want of data, a browser or ROS.

    Args:
        reasons: Why tests were skipped, one for each test.
    """
    kinds = [
        kind
        for reason in reasons
        for kind in _WORDS
        if reason.startswith((kind, f"Skipped: {kind}"))
    ]
    count = Counter(kinds)
    if not count:
        return "not run here: no test for want of real data, a browser or ROS"
    parts = [f"{count[kind]} without {words}" for kind, words in _WORDS.items() if count[kind]]
    number, _, rest = ", ".join(parts).partition(" ")
    return f"not run here: {number} test{'s' if number != '1' else ''} {rest}"
