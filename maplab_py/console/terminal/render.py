"""Printing reports: plain text, colours on a terminal, or JSON."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping
from typing import IO

from maplab_py.console.terminal.drawing import drawn, plain_text
from maplab_py.console.terminal.layout import blocks_of
from maplab_py.console.terminal.naming import with_names
from maplab_py.report import SCHEMA_VERSION, Report


def wants_colour(stream: IO[str]) -> bool:
    """Tell whether control codes may be written: to a terminal, unless NO_COLOR is set."""
    return stream.isatty() and not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb"


def render(report: Report, stream: IO[str], names: Mapping[str, str] | None = None) -> None:
    """Print a report as text; see `rendered`."""
    stream.write(rendered(report, stream, names))
    stream.flush()


def rendered(report: Report, stream: IO[str], names: Mapping[str, str] | None = None) -> str:
    """Return a report as text for a stream: fitted to a terminal, else at full width.

    Args:
        report: What to print.
        stream: Where it goes.
        names: Names of missions by their ids, which they replace.
    """
    blocks = with_names(blocks_of(report), names or {})
    if stream.isatty():
        width, coloured = shutil.get_terminal_size().columns, wants_colour(stream)
        texts = [drawn(block, width, coloured=coloured) for block in blocks]
    else:
        texts = [plain_text(block) for block in blocks]
    return "".join(("\n" if number else "") + text + "\n" for number, text in enumerate(texts))


def render_json(report: Report, command: str, seconds: float | None, stream: IO[str]) -> None:
    """Print a report as one JSON object on one line; see docs/json.md."""
    line = {
        "schema": SCHEMA_VERSION,
        "command": command,
        "status": 1 if report.failure else 0,
        "error": report.failure or None,
        "seconds": None if seconds is None else round(seconds, 3),
        "report": report.as_dict(),
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
