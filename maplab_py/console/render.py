"""Printing reports: plain text, colours on a terminal, or JSON."""

from __future__ import annotations

import io
import json
import os
from typing import IO, TYPE_CHECKING, Literal

from maplab_py.console.fitting import Panel, fitted
from maplab_py.console.layout import Block, Pairs, Paragraph, Table, blocks_of
from maplab_py.report import SCHEMA_VERSION, Report

if TYPE_CHECKING:
    from rich.console import Console as RichConsole


def wants_colour(stream: IO[str]) -> bool:
    """Tell whether control codes may be written: a terminal, and NO_COLOR is not set."""
    return stream.isatty() and not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb"


def render(report: Report, stream: IO[str]) -> None:
    """Print a report for people."""
    blocks = blocks_of(report)
    if wants_colour(stream):
        _render_rich(blocks, stream)
    else:
        for number, block in enumerate(blocks):
            stream.write(("\n" if number else "") + plain_text(block) + "\n")
    stream.flush()


def rendered(report: Report, stream: IO[str]) -> str:
    """Return a report as `render` would print it to a stream."""
    text = io.StringIO()
    if wants_colour(stream):
        _render_rich(blocks_of(report), text, forced=True)
    else:
        render(report, text)
    return text.getvalue()


def render_json(report: Report, command: str, seconds: float | None, stream: IO[str]) -> None:
    """Print a report as one JSON object on one line; see docs/json.md."""
    line = {
        "schema": SCHEMA_VERSION,
        "command": command,
        "status": 1 if report.failure else 0,
        "error": report.failure or None,
        "seconds": None if seconds is None else round(seconds, 3),
        "report": report.as_json(),
    }
    stream.write(json.dumps(line) + "\n")
    stream.flush()


def render_json_error(text: str, command: str, status: int, stream: IO[str]) -> None:
    """Print that a command failed as one JSON object on one line."""
    line = {
        "schema": SCHEMA_VERSION,
        "command": command,
        "status": status,
        "error": text,
        "seconds": None,
        "report": None,
    }
    stream.write(json.dumps(line) + "\n")
    stream.flush()


def plain_text(block: Block) -> str:
    """Lay out a block without any control code."""
    if isinstance(block, Paragraph):
        return block.text
    if isinstance(block, Pairs):
        width = max((len(name) for name, _ in block.rows), default=0)
        lines = [f"{name:<{width}}  {value}".rstrip() for name, value in block.rows]
        return "\n".join([block.title, *lines] if block.title else lines)
    return _plain_table(block)


def _plain_table(table: Table) -> str:
    cells = [table.heads, *table.rows]
    widths = [max(len(row[i]) for row in cells) for i in range(len(table.heads))]
    lines = [
        "  ".join(
            f"{cell:>{width}}" if right else f"{cell:<{width}}"
            for cell, width, right in zip(row, widths, table.is_number, strict=True)
        ).rstrip()
        for row in cells
    ]
    lines.insert(1, "  ".join("-" * width for width in widths))
    return "\n".join([table.title, *lines] if table.title else lines)


def _render_rich(blocks: list[Block], stream: IO[str], *, forced: bool = False) -> None:
    from rich.console import Console

    console = Console(file=stream, highlight=False, force_terminal=forced or None)
    for number, block in enumerate(blocks):
        if number:
            console.print()
        _print_block(block, console)


def _print_block(block: Block, console: RichConsole) -> None:
    from rich.table import Table as RichTable
    from rich.text import Text

    if isinstance(block, Paragraph):
        console.print(Text(block.text))
        return
    if block.title:
        console.print(Text(block.title, style="bold"))
    if isinstance(block, Table):
        for panel in fitted(block, console.width):
            _print_panel(panel, console)
        return
    grid = RichTable.grid(padding=(0, 2))
    for name, value in block.rows:
        grid.add_row(Text(name, style="cyan"), Text(value))
    console.print(grid)


def _print_panel(panel: Panel, console: RichConsole) -> None:
    from rich import box
    from rich.table import Table as RichTable
    from rich.text import Text

    table = panel.table
    shown = RichTable(box=box.SIMPLE_HEAD, header_style="bold cyan", pad_edge=False)
    for head, right, width in zip(table.heads, table.is_number, panel.widths, strict=True):
        justify: Literal["left", "right"] = "right" if right else "left"
        shown.add_column(Text(head), justify=justify, overflow="fold", width=width)
    for row in table.rows:
        shown.add_row(*(Text(cell) for cell in row))
    console.print(shown)
