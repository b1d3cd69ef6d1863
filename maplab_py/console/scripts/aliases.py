"""Aliases: user-defined names of command lines."""

import re
from collections.abc import Mapping
from pathlib import Path

from maplab_py.atomic import write_file
from maplab_py.console.commands.lines import TypedCommand
from maplab_py.console.commands.registry import Registry
from maplab_py.errors import UserError
from maplab_py.input_files import SCRIPT_MAX_BYTES, read_text

_NAME = re.compile(r"^[A-Za-z_][A-Za-z0-9_-]*$")
_MAX_DEPTH = 8


def check_name(name: str, registry: Registry) -> None:
    """Refuse a name that cannot be an alias.

    Raises:
        UserError: It has other characters than letters, digits, - and _, or is a command.
    """
    if not _NAME.match(name):
        raise UserError(f"'{name}' cannot be an alias: use letters, digits, - and _")
    if registry.knows(name) or name in ("q", "quit", "exit"):
        raise UserError(f"'{name}' is a command; choose another name")


def expanded(command: TypedCommand, aliases: Mapping[str, str]) -> str | None:
    """Return the text that an alias at the start of a command stands for; None if there is none.

    The words after the alias follow its text, which may itself begin with an alias.

    Raises:
        UserError: Aliases refer to each other in a circle.
    """
    text = command.source
    if not command.words or command.words[0] not in aliases or text[:1] in "'\"\\":
        return None
    for _ in range(_MAX_DEPTH):
        name = re.split(r"[\s;]", text, maxsplit=1)[0]
        if name not in aliases:
            return text
        text = aliases[name] + text[len(name) :]
    raise UserError(f"alias '{command.words[0]}' refers to itself")


def read_aliases(path: Path) -> dict[str, str]:
    """Read a file of lines `name=commands`; a missing file has none.

    Raises:
        UserError: The file cannot be read, or a line has no `=`.
    """
    if not path.is_file():
        return {}
    try:
        lines = read_text(path, SCRIPT_MAX_BYTES, remedy="aliases are shorter").splitlines()
    except (OSError, UnicodeDecodeError):
        raise UserError(f"{path}: cannot be read") from None
    aliases = {}
    for number, line in enumerate(lines, start=1):
        if line.strip() and not line.startswith("#"):
            name, equals, text = line.partition("=")
            if not equals:
                raise UserError(f"{path}:{number}: '{line}' is not name=commands")
            aliases[name.strip()] = text.strip()
    return aliases


def write_aliases(path: Path, aliases: Mapping[str, str]) -> None:
    """Write the file that `read_aliases` reads.

    Raises:
        UserError: It cannot be written.
    """
    text = "".join(f"{name}={line}\n" for name, line in aliases.items())
    write_file(path, [text.encode()])
