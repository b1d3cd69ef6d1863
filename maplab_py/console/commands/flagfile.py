"""Flag files: flags one per line, with comments, that may include further flag files."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from maplab_py.console.commands.flag_types import expand_path
from maplab_py.console.commands.flags import looks_like_flag
from maplab_py.console.commands.lines import split_commands, variable_lookup
from maplab_py.errors import FlagError
from maplab_py.input_files import SCRIPT_MAX_BYTES, read_text

DEPTH_LIMIT = 8


@dataclasses.dataclass(frozen=True)
class FileWords:
    """The words of one line of a flag file and where it stands."""

    words: tuple[str, ...]
    origin: str  # path:line


def read_flagfile(path: Path, depth: int = 0) -> list[FileWords]:
    """Read a flag file and all that it includes, in the order in which they apply.

    `#` starts a comment, quotes protect as in a shell, `$NAME` is a variable of the environment,
    `--flagfile=other` includes a file whose path is relative to the including one.

    Raises:
        FlagError: A file is missing or unreadable, a line is not a flag, or files include each
            other more than `DEPTH_LIMIT` deep.
    """
    if depth >= DEPTH_LIMIT:
        raise FlagError(f"{path}: flag files include each other more than {DEPTH_LIMIT} deep")
    try:
        remedy = "flag files are shorter"
        text = read_text(path, SCRIPT_MAX_BYTES, remedy=remedy, error=FlagError)
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not a text file"
        raise FlagError(f"--flagfile={path}: cannot be read: {reason}") from None
    lines: list[FileWords] = []
    lookup = variable_lookup({})
    for number, line in enumerate(text.splitlines(), start=1):
        origin = f"{path}:{number}"
        try:
            words = [word for command in split_commands(line, lookup) for word in command]
        except FlagError as error:
            raise FlagError(f"{origin}: {error}") from None
        if not words or words[0].startswith("//"):
            continue
        if not looks_like_flag(words[0]):
            raise FlagError(f"{origin}: '{words[0]}' is not a flag (write --name=value)")
        included = _include(words)
        if included is None:
            lines.append(FileWords(tuple(words), origin))
        else:
            lines += _read_included(_relative_to(path, included, origin), depth + 1, origin)
    return lines


def _read_included(path: Path, depth: int, origin: str) -> list[FileWords]:
    """Read an included file; that it cannot be read is an error of the line that includes it."""
    try:
        return read_flagfile(path, depth)
    except FlagError as error:
        if str(error).startswith("--flagfile="):
            raise FlagError(f"{origin}: {error}") from None
        raise


def _include(words: list[str]) -> str | None:
    name, _, value = words[0].lstrip("-").partition("=")
    if name != "flagfile":
        return None
    return value or (words[1] if len(words) > 1 else "")


def _relative_to(including: Path, text: str, origin: str) -> Path:
    try:
        path = expand_path(text)
    except ValueError as error:
        raise FlagError(f"{origin}: --flagfile={text}: {error}") from None
    if path is None:
        raise FlagError(f"{origin}: --flagfile needs a path")
    return path if path.is_absolute() else including.parent / path
