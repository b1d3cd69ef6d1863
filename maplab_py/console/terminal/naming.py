"""Missions are shown by name: their ids in reports and messages are replaced."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterable, Mapping

from maplab_py.console.terminal.layout import Block, Pairs, Paragraph

SHORT_ID_DIGITS = 8
_ID_ITSELF = "id"
"""A value of this name stays an id."""
_ID = re.compile(rf"\b[0-9a-f]{{{SHORT_ID_DIGITS}}}(?:[0-9a-f]{{24}})?\b")


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
