"""Splitting what a user types: commands at `;` and line ends, words as a shell does."""

from __future__ import annotations

import dataclasses
import os
import re
from collections.abc import Callable, Mapping

from maplab_py.errors import FlagError

_NAME = re.compile(r"\$(?:(\w+)|\{(\w+)\})")
_ASSIGNMENT = re.compile(r"^[A-Za-z_]\w*=")

Lookup = Callable[[str], str]


@dataclasses.dataclass(frozen=True)
class Word:
    """One word of a line with its place (character offsets) in the text."""

    text: str
    start: int
    end: int
    is_open: bool = False  # a quote is not closed, or a backslash ends the text
    is_shell: bool = False  # `!` or `|` with all that goes to the shell
    is_background: bool = False  # `&`


@dataclasses.dataclass(frozen=True)
class TypedCommand:
    """One command as it was typed."""

    source: str
    words: list[str]
    shell: str = ""  # what `!` or `|` gives to the shell
    in_background: bool = False

    @property
    def assignment(self) -> tuple[str, str] | None:
        """The name and value of a line `NAME=value`; None when it is something else."""
        if len(self.words) != 1 or not _ASSIGNMENT.match(self.words[0]):
            return None
        name, _, value = self.words[0].partition("=")
        return name, value


def split_commands(text: str) -> list[list[str]]:
    """Split text into commands, each a list of words; empty commands are left out.

    Words are separated by blanks; quotes and backslashes protect as in a shell; `;` and a line
    end separate commands; `#` at the start of a word comments out the rest of the line; a
    backslash at a line end continues the line.

    Raises:
        FlagError: A quote is not closed.
    """
    return [command.words for command in typed_commands(text) if command.words]


def typed_commands(text: str, lookup: Lookup | None = None) -> list[TypedCommand]:
    """Split text into commands with what the console itself makes of them.

    As `split_commands`, and: `!` at the start of a command gives the rest of the line to the
    shell, `|` as a word of its own pipes the command's output into the rest of the line, `&` ends
    a command that shall run in the background.

    Args:
        text: What was typed.
        lookup: Gives the value of `$NAME` and `${NAME}` outside single quotes; they stay as they
            are when it is not given.

    Raises:
        FlagError: A quote is not closed, or a variable is not set.
    """
    commands = []
    for words in scan(text, lookup):
        if not words:
            continue
        if words[-1].is_open:
            raise FlagError(f"unclosed quote or backslash in: {words[-1].text}")
        plain = [w.text for w in words if not (w.is_shell or w.is_background)]
        shell = next((w.text[1:].strip() for w in words if w.is_shell), "")
        if words[0].is_background or (words[0].is_shell and words[0].text.startswith("|")):
            raise FlagError(f"there is no command before '{words[0].text[:1]}'")
        source = text[words[0].start : words[-1].end]
        commands.append(TypedCommand(source, plain, shell, words[-1].is_background))
    return commands


def variable_lookup(variables: Mapping[str, str]) -> Lookup:
    """Return a lookup in a session's variables, then in the environment."""

    def lookup(name: str) -> str:
        value = variables.get(name, os.environ.get(name))
        if value is None:
            raise FlagError(f"variable ${name} is not set (write {name}=value, or '${name}')")
        return value

    return lookup


def scan(text: str, lookup: Lookup | None = None) -> list[list[Word]]:
    """Split text into commands of words with their places; the last command may be empty."""
    commands: list[list[Word]] = [[]]
    position = 0
    while position < len(text):
        character = text[position]
        if character in ";\n":
            commands.append([])
            position += 1
        elif character.isspace():
            position += 1
        elif text.startswith("\\\n", position):
            position += 2
        elif character == "#":
            end = text.find("\n", position)
            position = len(text) if end < 0 else end
        elif _is_operator(text, position, "|") or (character == "!" and not commands[-1]):
            end = text.find("\n", position)
            end = len(text) if end < 0 else end
            commands[-1].append(Word(text[position:end], position, end, is_shell=True))
            position = end
        elif _is_operator(text, position, "&"):
            commands[-1].append(Word("&", position, position + 1, is_background=True))
            commands.append([])
            position += 1
        else:
            word = _scan_word(text, position, lookup)
            commands[-1].append(word)
            position = word.end
    return commands


def _is_operator(text: str, position: int, operator: str) -> bool:
    """Tell whether an operator stands by itself here."""
    if text[position] != operator:
        return False
    following = text[position + 1 : position + 2]
    return not following or following.isspace() or following == ";"


def _scan_word(text: str, start: int, lookup: Lookup | None) -> Word:
    parts: list[str] = []
    quote = ""
    position = start
    while position < len(text):
        character = text[position]
        if not quote and (character.isspace() or character == ";"):
            break
        if character == "\\" and quote != "'":
            if position + 1 == len(text):
                return Word("".join(parts), start, len(text), is_open=True)
            following = text[position + 1]
            if quote and following not in '"\\$`\n':
                parts.append(character)
            if following != "\n":
                parts.append(following)
            position += 2
            continue
        if character == "$" and lookup and quote != "'" and (name := _NAME.match(text, position)):
            parts.append(lookup(name.group(1) or name.group(2)))
            position = name.end()
            continue
        if character == quote:
            quote = ""
        elif not quote and character in "'\"":
            quote = character
        else:
            parts.append(character)
        position += 1
    return Word("".join(parts), start, position, is_open=bool(quote))
