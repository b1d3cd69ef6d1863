"""Flags of commands and the parsing of words into flags."""

import dataclasses
import enum
import re
from collections.abc import Callable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from maplab_py.console.commands.flag_types import BOOL, FLOAT, FlagType, expand_path, format_value
from maplab_py.console.commands.lines import split_commands, variable_lookup
from maplab_py.console.commands.suggest import did_you_mean
from maplab_py.errors import FlagError
from maplab_py.input_files import SCRIPT_MAX_BYTES, read_text

REQUIRED: Any = object()
"""Default of a flag that must be given."""

_NUMBER = re.compile(r"^-\.?\d")
COMMON_BOOL_FLAGS = ("help", "keep_gflags", "dry_run")
"""Flags that every command has and that the console itself handles; they take no value."""
COMMON_FLAGS = (*COMMON_BOOL_FLAGS, "flagfile", "v", "max_memory_gb")


@dataclasses.dataclass(frozen=True)
class Flag:
    """One flag of a command."""

    name: str
    type: FlagType
    default: Any
    documentation: str | Callable[[], str] = ""  # read when the help is asked for
    unit: str = ""
    path: tuple[str, ...] = ()  # parameter, then the fields of option groups down to the value

    @property
    def help(self) -> str:
        """Help of the flag; like an entry of a table it ends without a full stop."""
        text = self.documentation if isinstance(self.documentation, str) else self.documentation()
        return text.strip().removesuffix(".")

    @property
    def is_required(self) -> bool:
        """Tell whether the user must give it."""
        return self.default is REQUIRED

    @property
    def default_text(self) -> str:
        """The default as the user would type it."""
        return "(required)" if self.is_required else format_value(self.default)

    def convert(self, value: Any) -> Any:
        """Turn text, or a value from Python, into the flag's type.

        Raises:
            FlagError: It does not fit.
        """
        if not isinstance(value, str):
            if self.type.accepts(value):
                return value
            value = format_value(value)
        try:
            return self.type.parse(value)
        except ValueError as error:
            raise FlagError(f"--{self.name}={value}: {error}") from None


CONSOLE_FLAGS = {
    flag.name: flag
    for flag in (
        Flag(
            "advice", BOOL, True, "After a command, one line on what to do next where it is known"
        ),
        Flag(
            "auto_fix",
            BOOL,
            False,
            "After a refusal with a known remedy, run the remedy and the command again (see fix)",
        ),
        Flag(
            "checkpoint_seconds",
            FLOAT,
            30.0,
            "Work of a script after which its unsaved maps are kept for `recover`, in case it is killed",
            unit="s",
        ),
        Flag(
            "complete_while_typing",
            BOOL,
            False,
            "Show the completions while typing, not only after Tab",
        ),
    )
}
"""Flags of the console itself; `set` changes them."""


@dataclasses.dataclass(frozen=True)
class Given:
    """One flag as it was typed: its name as the command spells it, and its text."""

    name: str
    text: str


def normalise(name: str) -> str:
    """Return a flag's name with underscores for dashes."""
    return name.replace("-", "_")


def looks_like_flag(word: str) -> bool:
    """Tell whether a word is a flag; a negative number is a value."""
    return len(word) > 1 and word.startswith("-") and not _NUMBER.match(word)


def parse_words(
    words: Sequence[str], flags: Mapping[str, Flag], owner: str
) -> tuple[list[Given], list[str]]:
    """Split the words after a command into flags and plain words.

    Accepts `--f=v`, `--f v`, `-f v`, `--flag`, `--noflag`; dashes equal underscores; `--` ends
    the flags.

    Args:
        words: The words, without the command.
        flags: The command's flags by name.
        owner: The command's name, for messages; empty where the flags are those of all commands.

    Raises:
        FlagError: A flag is unknown or lacks its value.
    """
    given: list[Given] = []
    plain: list[str] = []
    rest = list(words)
    while rest:
        word = rest.pop(0)
        if word == "--":
            return given, plain + rest
        if not looks_like_flag(word):
            plain.append(word)
            continue
        typed, has_value, text = word.lstrip("-").partition("=")
        name, implied = resolve_name(typed, flags, owner)
        if implied == "false" and has_value:
            raise FlagError(f"--{typed} takes no value (write --{name}={text})")
        if not has_value:
            text = implied or _take_value(name, rest)
            if implied == "true" and rest and rest[0].lower() in ("true", "false"):
                text = rest.pop(0)
        given.append(Given(name, text))
    return given, plain


def resolve_name(typed: str, flags: Mapping[str, Flag], owner: str) -> tuple[str, str]:
    """Return the flag that a typed name means and the value implied by the bare name.

    Raises:
        FlagError: The command has no such flag.
    """
    name = normalise(typed)
    if name in flags:
        return name, "true" if flags[name].type.is_bool else ""
    if name in COMMON_FLAGS:
        return name, "true" if name in COMMON_BOOL_FLAGS else ""
    for prefix in ("no_", "no"):
        positive = name.removeprefix(prefix)
        if positive != name and positive in flags and flags[positive].type.is_bool:
            return positive, "false"
    proposal = explanation(name) or did_you_mean(name, [*flags, *COMMON_FLAGS], "--")
    if not owner:
        raise FlagError(f"no command has a flag --{name}{proposal}")
    raise FlagError(f"{owner} has no flag --{name}{proposal or f' (see: help {owner})'}")


def _take_value(name: str, rest: list[str]) -> str:
    if not rest or looks_like_flag(rest[0]):
        raise FlagError(f"--{name} needs a value (write --{name}=value)")
    return rest.pop(0)


# maplab's flags that have no namesake here: what they are called, or why they were dropped.

TABLE = "maplab_flags.tsv"


class Fate(enum.Enum):
    """Fate of a flag of maplab."""

    RENAMED = "renamed"
    DROPPED = "dropped"


@dataclasses.dataclass(frozen=True)
class FormerFlag:
    """One flag of maplab."""

    fate: Fate  # what became of it
    new_name: str  # its name here without dashes; empty for a dropped one
    note: str  # how the new one differs, may be empty; why it was dropped


def former_flags() -> dict[str, FormerFlag]:
    """Return the flags by maplab's names.

    Raises:
        ValueError: The table is wrong.
    """
    text = resources.files(__package__).joinpath(TABLE).read_text(encoding="utf-8")
    return parse_table(text)


def parse_table(text: str) -> dict[str, FormerFlag]:
    """Parse lines of names (separated by ", "), fate and text, separated by tabs.

    Raises:
        ValueError: A line is wrong, or a name is in two lines.
    """
    flags: dict[str, FormerFlag] = {}
    for line in text.splitlines():
        names, fate, note = line.split("\t")
        new_name = ""
        if fate == Fate.RENAMED.value:
            new_name, _, note = note.removeprefix("--").partition(": ")
        for name in names.split(", "):
            if name in flags or not (new_name or note):
                raise ValueError(f"{TABLE}: the line of '{name}' is wrong")
            flags[name] = FormerFlag(Fate(fate), new_name, note)
    return flags


def explanation(name: str) -> str:
    """Return the end of an error about an unknown flag; empty where maplab has no such flag."""
    flag = former_flags().get(name)
    if flag is None:
        return ""
    if flag.fate is Fate.RENAMED:
        return f": here it is --{flag.new_name}{f' ({flag.note})' if flag.note else ''}"
    return f": maplab's flag is not needed here: {flag.note}"


# Flag files: flags one per line, with comments, that may include further flag files.

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
