"""Flags of commands and the parsing of words into flags."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from maplab_py.console.commands.flag_types import BOOL, FLOAT, FlagType, format_value
from maplab_py.console.commands.maplab_flags import explanation
from maplab_py.console.commands.suggest import did_you_mean
from maplab_py.errors import FlagError

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
