"""Notes on layers that draw less than the map has."""

from __future__ import annotations

BAD_QUALITY = "of bad quality"
MAX_POINTS = "by --vis_max_points"
NO_POSITION = "without a finite position"


def omission_notes(title: str, drawn: int, *reasons: tuple[int, str]) -> tuple[str, ...]:
    """Return a line that says how many elements each reason leaves out; nothing if none does.

    Args:
        title: Title of the layer.
        drawn: The number of elements that are drawn.
        reasons: How many elements are left out, and why.
    """
    active = [(count, words) for count, words in reasons if count > 0]
    if not active:
        return ()
    total = drawn + sum(count for count, _ in active)
    causes = ", ".join(f"{count:,} {words}" for count, words in active)
    return (f"{title}: {drawn:,} of {total:,} are drawn (left out: {causes})",)
