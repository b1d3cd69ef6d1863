"""Drawing the blocks of a report as lines of text, for a terminal or for a pipe."""

from __future__ import annotations

import textwrap

from maplab_py.console.terminal.fitting import GAP, fitted, text_width
from maplab_py.console.terminal.layout import Block, Pairs, Paragraph, Table

_NARROWEST_TABLE_OF_ENTRIES = 100
_NARROWEST_EXPLANATION = 36
_TITLE, _HEAD, _NAME, _FAINT = "\x1b[1m", "\x1b[1;36m", "\x1b[36m", "\x1b[2m"
_END = "\x1b[0m"


def plain_text(block: Block) -> str:
    """Draw a block at its full width without any control code."""
    return "\n".join(_Drawing(None, coloured=False).lines(block))


def drawn(block: Block, width: int, *, coloured: bool) -> str:
    """Draw a block for a terminal of a width; long lines are folded at spaces.

    Args:
        block: What to draw.
        width: Columns of the terminal.
        coloured: Use control codes for colours.
    """
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
                for folded_line in self._folded(line, hanging=indent)
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
            first, *others = self._folded(value, name_width + GAP)
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
            first, *others = self._folded(f"{term}  {note}".rstrip(), hanging=4)
            lines += [self._in(_NAME, term) + first.removeprefix(term), *others]
            lines += [" " * 4 + line for line in self._folded(text, 4)] if text else []
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
            lines += [self._in(_FAINT, line) for line in self._folded(hint)]
        return lines

    def _folded(self, text: str, indent: int = 0, hanging: int = 0) -> list[str]:
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
