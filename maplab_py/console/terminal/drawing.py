"""Drawing the blocks of a report as lines of text, for a terminal or for a pipe."""

import dataclasses
import textwrap

from maplab_py.console.terminal.layout import Block, Pairs, Paragraph, Table

_NARROWEST_TABLE_OF_ENTRIES = 100
_NARROWEST_EXPLANATION = 36
_TITLE, _HEAD, _NAME, _FAINT = "\x1b[1m", "\x1b[1;36m", "\x1b[36m", "\x1b[2m"
_END = "\x1b[0m"


def plain_text(block: Block) -> str:
    """Draw a block at its full width without any control code."""
    return "\n".join(_Drawing(None, coloured=False).lines(block))


def drawn(block: Block, width: int, *, coloured: bool) -> str:
    """Draw a block for a terminal of a width; long lines are folded at spaces."""
    return "\n".join(_Drawing(width, coloured=coloured).lines(block))


def folded(text: str, width: int, hanging: int = 0) -> str:
    """Return text with lines of at most a width, broken at spaces; longer words are kept whole.

    Args:
        text: One line or several.
        width: Columns.
        hanging: Indentation of the lines that continue one [columns].
    """
    lines = []
    for line in text.split("\n"):
        if text_width(line) <= width:
            lines.append(line)
            continue
        lines += textwrap.wrap(
            line,
            width,
            subsequent_indent=" " * hanging,
            break_long_words=False,
            break_on_hyphens=False,
            replace_whitespace=False,
        ) or [""]
    return "\n".join(lines)


class _Drawing:
    """Draws blocks for one width; None = as wide as they are."""

    def __init__(self, width: int | None, *, coloured: bool) -> None:
        self._width = width
        self._coloured = coloured
        self._rule = "-" if width is None else "─"

    def lines(self, block: Block) -> list[str]:
        if isinstance(block, Paragraph):
            lines = block.text.split("\n")
            if block.is_verbatim:
                return lines
            indents = [len(line) - len(line.lstrip()) for line in lines]
            return [
                folded_line
                for line, indent in zip(lines, indents, strict=True)
                for folded_line in self._fold(line, hanging=indent)
            ]
        title = [self._in(_TITLE, block.title)] if block.title else []
        if isinstance(block, Pairs):
            return title + self._pairs(block)
        if block.are_entries and self._width and _is_too_narrow(block, self._width):
            return title + self._entries(block)
        return title + self._table(block)

    def _pairs(self, pairs: Pairs) -> list[str]:
        name_width = max((text_width(name) for name, _ in pairs.rows), default=0)
        lines = []
        for name, value in pairs.rows:
            first, *others = self._fold(value, name_width + GAP)
            shown = self._in(_NAME, name) + " " * (name_width - text_width(name) + GAP)
            lines += [(shown + first).rstrip()]
            lines += [" " * (name_width + GAP) + line for line in others]
        return lines

    def _entries(self, table: Table) -> list[str]:
        """Draw each row as its term with the short cells, and the explanation below."""
        lines = []
        for term, *facts, text in table.rows:
            named = zip(table.heads[1:-1], facts, strict=True)
            note = ", ".join(
                cell if head == table.heads[1] else f"{head} {cell}" for head, cell in named if cell
            )
            first, *others = self._fold(f"{term}  {note}".rstrip(), hanging=4)
            lines += [self._in(_NAME, term) + first.removeprefix(term), *others]
            lines += [" " * 4 + line for line in self._fold(text, 4)] if text else []
        return lines

    def _table(self, table: Table) -> list[str]:
        shown = fitted(table, self._width or 10**9)
        lines = [
            self._in(_HEAD, line) for line in _row(shown.table.heads, shown.widths, shown.table)
        ]
        rule = (" " * GAP).join(self._rule * width for width in shown.widths)
        lines.append(self._in(_FAINT, rule))
        for row in shown.table.rows:
            lines += _row(row, shown.widths, shown.table)
        if shown.omitted:
            hint = f"no room for: {', '.join(shown.omitted)} (all columns: | less -S, or --json)"
            lines += [self._in(_FAINT, line) for line in self._fold(hint)]
        return lines

    def _fold(self, text: str, indent: int = 0, hanging: int = 0) -> list[str]:
        if self._width is None:
            return [text]
        return folded(text, max(20, self._width - indent), hanging).split("\n")

    def _in(self, style: str, text: str) -> str:
        return f"{style}{text}{_END}" if self._coloured else text


def _is_too_narrow(entries: Table, width: int) -> bool:
    """Return whether a table of entries would leave too little room for the explanations."""
    if width < _NARROWEST_TABLE_OF_ENTRIES:
        return True
    shown = fitted(entries, width)
    longest = max((text_width(row[-1]) for row in entries.rows), default=0)
    return bool(shown.omitted) or shown.widths[-1] < min(_NARROWEST_EXPLANATION, longest)


def _row(cells: list[str], widths: list[int], table: Table) -> list[str]:
    """Draw one row; cells are folded at their spaces."""
    folded = [
        textwrap.wrap(cell, width, break_long_words=False, break_on_hyphens=False)
        if text_width(cell) > width
        else [cell]
        for cell, width in zip(cells, widths, strict=True)
    ]
    height = max(map(len, folded), default=1)
    lines = []
    for number in range(height):
        parts = []
        for texts, width, right in zip(folded, widths, table.is_number, strict=True):
            text = texts[number] if number < len(texts) else ""
            padding = " " * (width - text_width(text))
            parts.append(padding + text if right else text + padding)
        lines.append((" " * GAP).join(parts).rstrip())
    return lines


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
        turned = _transpose(table)
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


def _transpose(table: Table) -> Table:
    """Return a table whose rows are the columns; the first column gives the heads."""
    heads = [table.heads[0], *(row[0] for row in table.rows)]
    rows = [
        [head, *(row[column] for row in table.rows)]
        for column, head in enumerate(table.heads)
        if column
    ]
    return Table(table.title, heads, rows, [False] * len(heads))
