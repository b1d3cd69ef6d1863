"""Ranking of names by the typed text: prefixes first, then letters in order."""

from __future__ import annotations

Rank = tuple[int, int]
"""Kind of the match and number of pieces; smaller is better."""
_FEW_PIECES = 2


def match_rank(typed: str, name: str) -> Rank | None:
    """Return how well a name fits what was typed, None if it does not.

    The kinds, best first: the whole name, its beginning, the beginning of one of its words, letters
    in order from the first one on (`ovi` fits optvi), a part, letters in order. Letters in order
    are better if they form fewer pieces.
    """
    typed, name = typed.lower(), name.lower()
    if name.startswith(typed):
        return (0 if len(typed) == len(name) else 1), 1
    if f"_{typed}" in name:
        return 2, 1
    is_part = typed in name
    letters = iter(name)
    if not all(letter in letters for letter in typed):
        return None
    if name[:1] == typed[:1]:
        pieces = _pieces(typed, name)
        return (3, pieces) if not is_part or pieces == _FEW_PIECES else (4, 1)
    return (4, 1) if is_part else (5, _pieces(typed, name))


def _pieces(typed: str, name: str) -> int:
    """Return the least number of pieces of a name that make up what was typed."""
    # best[j]: fewest pieces for the letters so far, of which the last one stands at name[j]
    none = len(name) + 1
    best = [1 if letter == typed[:1] else none for letter in name]
    for letter in typed[1:]:
        before, best = best, [none] * len(name)
        fewest = none
        for place, other in enumerate(name):
            if place >= 2:
                fewest = min(fewest, before[place - 2] + 1)
            if other == letter:
                best[place] = min(before[place - 1] if place else none, fewest)
    return min(best, default=none)
