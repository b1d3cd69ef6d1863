"""Syntax colouring of command lines."""

from __future__ import annotations

from maplab_py.console.commands.command import Command
from maplab_py.console.commands.flags import looks_like_flag, resolve_name
from maplab_py.console.commands.lines import Word, scan
from maplab_py.console.commands.registry import Registry
from maplab_py.console.scripts.runner import LEAVE
from maplab_py.errors import FlagError


def coloured_parts(line: str, registry: Registry) -> list[tuple[str, str]]:
    """Split a line into (style, text) whose texts joined are the line.

    Styles are command, flag, value, unknown (a command or flag that does not exist) or empty.
    """
    parts: list[tuple[str, str]] = []
    position = 0
    for words in scan(line):
        command: Command | None = None
        for number, word in enumerate(words):
            parts.append(("", line[position : word.start]))
            raw = line[word.start : word.end]
            if number == 0:
                known = word.text in registry.names
                command = registry.find(word.text) if known else None
                style = "command" if known or word.text in LEAVE else "unknown"
                parts.append((style, raw))
            else:
                parts += _argument_parts(word, raw, command)
            position = word.end
    parts.append(("", line[position:]))
    return [part for part in parts if part[1]]


def _argument_parts(word: Word, raw: str, command: Command | None) -> list[tuple[str, str]]:
    if not looks_like_flag(word.text) or command is None:
        return [("value", raw)]
    name, equals, value = raw.partition("=")
    style = "flag"
    if not command.raw_arguments:
        try:
            resolve_name(name.lstrip("-"), command.flags, command.name)
        except FlagError:
            style = "unknown"
    return [(style, name + equals), ("value", value)]
