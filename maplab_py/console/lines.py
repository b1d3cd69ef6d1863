"""Splitting what a user types: commands at `;` and line ends, words as a shell does."""

from __future__ import annotations

import dataclasses

from maplab_py.errors import FlagError


@dataclasses.dataclass(frozen=True)
class Word:
    """One word of a line with its place (character offsets) in the text."""

    text: str
    start: int
    end: int
    is_open: bool = False  # a quote is not closed, or a backslash ends the text


def split_commands(text: str) -> list[list[str]]:
    """Split text into commands, each a list of words; empty commands are left out.

    Words are separated by blanks; quotes and backslashes protect as in a shell; `;` and a line
    end separate commands; `#` at the start of a word comments out the rest of the line; a
    backslash at a line end continues the line.

    Raises:
        FlagError: A quote is not closed.
    """
    commands = []
    for words in scan(text):
        if words and words[-1].is_open:
            raise FlagError(f"unclosed quote or backslash in: {words[-1].text}")
        if words:
            commands.append([word.text for word in words])
    return commands


def scan(text: str) -> list[list[Word]]:
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
        else:
            word = _scan_word(text, position)
            commands[-1].append(word)
            position = word.end
    return commands


def _scan_word(text: str, start: int) -> Word:
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
        if character == quote:
            quote = ""
        elif not quote and character in "'\"":
            quote = character
        else:
            parts.append(character)
        position += 1
    return Word("".join(parts), start, position, is_open=bool(quote))
