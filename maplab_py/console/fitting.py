"""Fitting tables to the width of a terminal: words and numbers are never cut in two."""

from __future__ import annotations

import dataclasses

from maplab_py.console.layout import Table

GAP = 3
"""Characters between two columns, as rich draws them."""
_LONGEST_WORD = 40
"""Longer words (paths, ids) may be cut."""


@dataclasses.dataclass(frozen=True)
class Panel:
    """Some columns of a table with the widths they are drawn in."""

    table: Table
    widths: list[int]


def fitted(table: Table, width: int) -> list[Panel]:
    """Split a table into as few panels of neighbouring columns as fit beside each other.

    Text is folded at its spaces before columns are moved to another panel; every panel begins with
    the table's first column, which names the row.
    """
    least = _widths(table, by_words=True)
    groups: list[list[int]] = [[]]
    for column in range(len(table.heads)):
        begun = groups[-1]
        if len(begun) > 1 and _total([least[i] for i in [*begun, column]]) > width:
            groups.append([0])
        groups[-1].append(column)
    natural = _widths(table, by_words=False)
    return [
        Panel(
            _columns(table, group, table.title if not number else ""),
            _narrowed([natural[i] for i in group], [least[i] for i in group], width),
        )
        for number, group in enumerate(groups)
    ]


def _widths(table: Table, *, by_words: bool) -> list[int]:
    """Return the width of every column: of its longest text, or of its longest word."""
    widths = []
    for column, head in enumerate(table.heads):
        texts = [head, *(row[column] for row in table.rows)]
        pieces = [word for text in texts for word in text.split()] if by_words else texts
        longest = max(map(len, pieces), default=0)
        widths.append(max(1, min(longest, _LONGEST_WORD) if by_words else longest))
    return widths


def _narrowed(natural: list[int], least: list[int], width: int) -> list[int]:
    """Take characters from the widest columns that can be folded until all fit."""
    widths = list(natural)
    for _ in range(max(0, _total(widths) - width)):
        spare = [i for i, least_width in enumerate(least) if widths[i] > least_width]
        if not spare:
            break
        widths[max(spare, key=lambda i: widths[i])] -= 1
    return widths


def _total(widths: list[int]) -> int:
    return sum(widths) + GAP * len(widths)


def _columns(table: Table, group: list[int], title: str) -> Table:
    return Table(
        title,
        [table.heads[i] for i in group],
        [[row[i] for i in group] for row in table.rows],
        [table.is_number[i] for i in group],
    )
