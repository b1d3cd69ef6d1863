"""Printing reports: plain text, colours on a terminal, or JSON."""

import dataclasses
import json
import os
import re
import shutil
from collections.abc import Iterable, Mapping
from typing import IO

from maplab_py.console.terminal.drawing import drawn, plain_text
from maplab_py.console.terminal.layout import Block, Pairs, Paragraph, blocks_of
from maplab_py.report import SCHEMA_VERSION, Report


def wants_colour(stream: IO[str]) -> bool:
    """Tell whether control codes may be written: to a terminal, unless NO_COLOR is set."""
    return stream.isatty() and not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb"


def render(
    report: Report, stream: IO[str], names: Mapping[str, str] | None = None, page: str = ""
) -> None:
    """Print a report as text; see `rendered`."""
    stream.write(rendered(report, stream, names, page))
    stream.flush()


def rendered(
    report: Report, stream: IO[str], names: Mapping[str, str] | None = None, page: str = ""
) -> str:
    """Return a report as text for a stream: fitted to a terminal, else at full width.

    Args:
        report: What to print.
        stream: Where it goes.
        names: Names of missions by their ids, which they replace.
        page: Address of a page that shows what ids mean; empty = there is none.
    """
    blocks = with_names(blocks_of(report), names or {})
    if stream.isatty():
        width, coloured = shutil.get_terminal_size().columns, wants_colour(stream)
        texts = [drawn(block, width, coloured=coloured) for block in blocks]
        if page and coloured:
            texts = [with_links(text, page) for text in texts]
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


# Missions are shown by name: their ids in reports and messages are replaced.

SHORT_ID_DIGITS = 8
_ID_ITSELF = "id"
"""A value of this name stays an id."""
_ID = re.compile(rf"\b[0-9a-f]{{{SHORT_ID_DIGITS}}}(?:[0-9a-f]{{24}})?\b")


_LINKED_ID = re.compile(rf"(?=\d*[a-f]){_ID.pattern}")
"""An id that is no number of eight digits."""


def with_links(text: str, page: str) -> str:
    """Return a text whose ids are links (OSC 8) that let an open page of the viewer show them."""
    return _LINKED_ID.sub(
        lambda match: f"\x1b]8;;{page}/go/{match[0]}\x1b\\{match[0]}\x1b]8;;\x1b\\", text
    )


def names_by_id(missions: Iterable[tuple[str, str]]) -> dict[str, str]:
    """Return the names of missions by their ids and by the short forms of the ids.

    Args:
        missions: Id (32 hexadecimal digits) and label of each mission; later ones take precedence.
    """
    names: dict[str, str] = {}
    owners: dict[str, set[str]] = {}
    for id_, label in missions:
        names[id_] = names[id_[:SHORT_ID_DIGITS]] = label
        owners.setdefault(id_[:SHORT_ID_DIGITS], set()).add(id_)
    for short, ids in owners.items():
        if len(ids) > 1:
            del names[short]
    return names


def with_names(blocks: list[Block], names: Mapping[str, str]) -> list[Block]:
    """Return blocks in which the ids of missions are replaced by the names."""
    if not names:
        return blocks
    return [_name(block, names) for block in blocks]


def text_with_names(text: str, names: Mapping[str, str]) -> str:
    """Return a text in which the ids of missions are replaced by the names."""
    return _ID.sub(lambda match: names.get(match[0], match[0]), text) if names else text


def _name(block: Block, names: Mapping[str, str]) -> Block:
    def named(text: str) -> str:
        return text_with_names(text, names)

    if isinstance(block, Paragraph):
        return dataclasses.replace(block, text=named(block.text))
    if isinstance(block, Pairs):
        pairs = [(named(n), value if n == _ID_ITSELF else named(value)) for n, value in block.rows]
        return Pairs(pairs, block.title)
    rows = [[named(cell) for cell in row] for row in block.rows]
    return dataclasses.replace(block, heads=[named(head) for head in block.heads], rows=rows)
