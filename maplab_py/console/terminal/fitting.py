"""Fitting tables to the width of a terminal: words and numbers are never split."""

from __future__ import annotations

import dataclasses

from maplab_py.console.terminal.layout import Table

GAP = 2
"""Characters between two columns."""
_MAX_ROWS_TRANSPOSED = 4


@dataclasses.dataclass(frozen=True)
class FittedTable:
    """A table with the widths of its columns, and the heads of the columns that have no room."""

    table: Table
    widths: list[int]
    omitted: list[str]


def fitted(table: Table, width: int) -> FittedTable:
    """Fit a table to a width.

    Text is folded at its spaces. If that is not enough, a table of few rows is transposed; one of
    many rows keeps its leading columns. A single word that is wider than the terminal keeps its
    width.
    """
    if _total(_widths(table, by_words=True)) <= width:
        return FittedTable(table, narrowed_widths(table, width), [])
    if len(table.rows) <= _MAX_ROWS_TRANSPOSED and len(table.heads) > 1:
        turned = _transposed(table)
        if _total(_widths(turned, by_words=True)) <= width:
            return FittedTable(turned, narrowed_widths(turned, width), [])
    count = len(table.heads)
    while count > 1 and _total(_widths(table, by_words=True)[:count]) > width:
        count -= 1
    kept = Table(
        table.title,
        table.heads[:count],
        [row[:count] for row in table.rows],
        table.is_number[:count],
        table.are_entries,
    )
    return FittedTable(kept, narrowed_widths(kept, width), table.heads[count:])


def narrowed_widths(table: Table, width: int) -> list[int]:
    """Return column widths of which the widest that can be folded give way until all fit."""
    widths, least = _widths(table, by_words=False), _widths(table, by_words=True)
    for _ in range(max(0, _total(widths) - width)):
        spare = [i for i, least_width in enumerate(least) if widths[i] > least_width]
        if not spare:
            break
        widths[max(spare, key=lambda i: widths[i])] -= 1
    return widths


def text_width(text: str) -> int:
    """Return how many columns of a terminal a text takes."""
    if text.isascii():
        return len(text)
    from prompt_toolkit.utils import get_cwidth

    return get_cwidth(text)


def _widths(table: Table, *, by_words: bool) -> list[int]:
    """Return the width of every column: of its longest text, or of its longest word."""
    widths = []
    for column, head in enumerate(table.heads):
        texts = [head, *(row[column] for row in table.rows)]
        pieces = [word for text in texts for word in text.split()] if by_words else texts
        widths.append(max(1, max(map(text_width, pieces), default=0)))
    return widths


def _total(widths: list[int]) -> int:
    return sum(widths) + GAP * (len(widths) - 1)


def _transposed(table: Table) -> Table:
    """Return a table whose rows are the columns; the first column gives the heads."""
    heads = [table.heads[0], *(row[0] for row in table.rows)]
    rows = [
        [head, *(row[column] for row in table.rows)]
        for column, head in enumerate(table.heads)
        if column
    ]
    return Table(table.title, heads, rows, [False] * len(heads))
