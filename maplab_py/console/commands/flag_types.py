"""Types of flag values: text to value and back, with errors of one line."""

import dataclasses
import math
import os
import types
import typing
from collections.abc import Callable
from enum import Enum
from pathlib import Path
from typing import Any

from maplab_py.console.commands.suggest import did_you_mean

_TRUE = ("true", "1", "yes", "on", "t", "y")
_PATH_BYTES, _NAME_BYTES = 4095, 255
"""Longest path that file systems take; no call to one is needed to refuse more."""
_FALSE = ("false", "0", "no", "off", "f", "n")


@dataclasses.dataclass(frozen=True)
class FlagType:
    """Name, parser and check of one kind of flag value.

    `parse` raises ValueError whose text completes "--flag=value: ...". `accepts` tells whether a
    value that comes from Python needs no conversion.
    """

    name: str
    parse: Callable[[str], Any]
    accepts: Callable[[Any], bool]
    choices: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """The type for people: its name, or the words to choose from."""
        return "|".join(self.choices) if self.choices and not self.is_bool else self.name

    @property
    def is_bool(self) -> bool:
        """Tell whether the flag can be given without a value."""
        return self.name == "bool"


def _parse_bool(text: str) -> bool:
    lowered = text.lower()
    if lowered in _TRUE:
        return True
    if lowered in _FALSE:
        return False
    raise ValueError("wants true or false")


def _parse_int(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise ValueError("wants a whole number") from None


def _parse_float(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise ValueError("wants a number") from None
    if math.isnan(value):
        raise ValueError("wants a number, not nan")
    return value


def expand_path(text: str) -> Path | None:
    """Expand ~ and environment variables in a path; empty text means no path.

    Raises:
        ValueError: A variable is not set.
    """
    if not text:
        return None
    expanded = os.path.expandvars(text)
    if "$" in expanded:
        raise ValueError("an environment variable in the path is not set")
    return _parse_path(expanded)


def _parse_path(text: str) -> Path:
    """Read a path of which variables have been expanded, where they shall be."""
    if not text:
        raise ValueError("wants a path")
    if "\0" in text:
        raise ValueError("a path cannot contain the character NUL")
    path = os.path.expanduser(text)
    encoded = os.fsencode(path)
    if len(encoded) > _PATH_BYTES or max(map(len, encoded.split(b"/"))) > _NAME_BYTES:
        raise ValueError(f"a path has at most {_PATH_BYTES} bytes, a name in it {_NAME_BYTES}")
    return Path(path)


BOOL = FlagType("bool", _parse_bool, lambda value: isinstance(value, bool), ("true", "false"))
INT = FlagType(
    "int", _parse_int, lambda value: isinstance(value, int) and not isinstance(value, bool)
)
FLOAT = FlagType(
    "float",
    _parse_float,
    lambda value: isinstance(value, (int, float)) and not isinstance(value, bool),
)
STR = FlagType("str", str, lambda value: isinstance(value, str))
PATH = FlagType("path", _parse_path, lambda value: isinstance(value, Path))
_SCALARS: dict[Any, FlagType] = {bool: BOOL, int: INT, float: FLOAT, str: STR, Path: PATH}


def choice(choices: tuple[str, ...]) -> FlagType:
    """Return the type of a flag that takes one of a few words."""

    def parse(text: str) -> str:
        if text in choices:
            return text
        raise ValueError(
            f"must be one of {', '.join(filter(None, choices))}{did_you_mean(text.lower(), choices)}"
        )

    return FlagType("choice", parse, lambda value: value in choices, choices)


def enumeration(enum_type: type[Enum]) -> FlagType:
    """Return the type of a flag that takes a member of an Enum, by its lower-case name."""
    names = tuple(member.name.lower() for member in enum_type)

    def parse(text: str) -> Enum:
        lowered = text.lower().replace("-", "_")
        for member in enum_type:
            if lowered == member.name.lower() or text == str(member.value):
                return member
        raise ValueError(f"must be one of {', '.join(names)}{did_you_mean(lowered, names)}")

    return FlagType("choice", parse, lambda value: isinstance(value, enum_type), names)


def _optional(inner: FlagType) -> FlagType:
    return FlagType(
        inner.name,
        lambda text: None if text == "" else inner.parse(text),
        lambda value: value is None or inner.accepts(value),
        inner.choices,
    )


def _listing(inner: FlagType) -> FlagType:
    def parse(text: str) -> tuple[Any, ...]:
        return tuple(inner.parse(part.strip()) for part in text.split(",") if part.strip())

    def accepts(value: Any) -> bool:
        return isinstance(value, tuple) and all(inner.accepts(item) for item in value)

    return FlagType(f"{inner.name},...", parse, accepts, inner.choices)


def flag_type(annotation: Any, choices: tuple[str, ...] = ()) -> FlagType:
    """Return the flag type of an annotation.

    Args:
        annotation: bool, int, float, str, Path, Literal, Enum, `X | None` or `tuple[X, ...]`.
        choices: Allowed words of a str.

    Raises:
        TypeError: The annotation cannot be a flag (a mistake of the command's author).
    """
    if choices:
        return choice(choices)
    if annotation in _SCALARS:
        return _SCALARS[annotation]
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Literal:
        return choice(tuple(str(word) for word in arguments))
    if origin in (typing.Union, types.UnionType):
        inner = [argument for argument in arguments if argument is not type(None)]
        if len(inner) == 1 and len(arguments) == 2:
            return _optional(flag_type(inner[0]))
    if origin is tuple and len(arguments) == 2 and arguments[1] is Ellipsis:
        return _listing(flag_type(arguments[0]))
    if isinstance(annotation, type) and issubclass(annotation, Enum):
        return enumeration(annotation)
    raise TypeError(f"a flag cannot have the type {annotation}")


def format_value(value: Any) -> str:
    """Write a flag's value as the user would type it."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, Enum):
        return value.name.lower()
    if isinstance(value, float):
        return f"{value:g}" if float(f"{value:g}") == value else repr(value)
    if isinstance(value, (tuple, list)):
        return ",".join(format_value(item) for item in value)
    return str(value)
