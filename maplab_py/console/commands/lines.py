"""Parsing of command lines: commands end at `;` and line ends, words are split as in a shell."""

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
    is_redirection: bool = False  # `>` or `>>`


@dataclasses.dataclass(frozen=True)
class TypedCommand:
    """One command as it was typed."""

    source: str
    words: list[str]
    shell: str = ""  # what `!` or `|` gives to the shell
    in_background: bool = False
    output: str = ""  # file that receives the report
    appends: bool = False  # to the file

    @property
    def assignment(self) -> tuple[str, str] | None:
        """The name and value of a line `NAME=value`; None when it is something else."""
        if len(self.words) != 1 or not _ASSIGNMENT.match(self.words[0]):
            return None
        name, _, value = self.words[0].partition("=")
        return name, value


def escaped(word: str) -> str:
    """Return a word with a backslash before every character that has a meaning in a line."""
    return "".join(f"\\{c}" if c in " \t;#'\"\\" else c for c in word)


def split_commands(text: str, lookup: Lookup | None = None) -> list[list[str]]:
    """Split text into commands, each a list of words; empty commands are left out.

    Words are separated by blanks; quotes and backslashes protect as in a shell; `;` and a line
    end separate commands; `#` at the start of a word comments out the rest of the line; a
    backslash at a line end continues the line.

    Args:
        text: What was typed.
        lookup: As for `typed_commands`.

    Raises:
        FlagError: A quote is not closed, or a variable is not set.
    """
    return [command.words for command in typed_commands(text, lookup) if command.words]


def typed_commands(text: str, lookup: Lookup | None = None) -> list[TypedCommand]:
    """Split text into commands, with shell commands, pipes and background jobs.

    As `split_commands`, and: `!` at the start of a command gives the rest of it to the shell, `|`
    as a word of its own pipes the command's output into the rest of it, `&` ends a command that
    shall run in the background, `> FILE` and `>> FILE` send its report to a file. What goes to the
    shell, too, ends at a `;` outside quotes.

    Args:
        text: What was typed.
        lookup: Gives the value of `$NAME` and `${NAME}` outside single quotes; they stay as they
            are when it is not given.

    Raises:
        FlagError: A quote is not closed, a variable is not set, or there is a NUL character.
    """
    if "\0" in text:
        raise FlagError("the text contains the character NUL, which no command can take")
    commands = []
    for scanned in scan(text, lookup):
        if not scanned:
            continue
        if scanned[-1].is_open:
            raise FlagError(f"unclosed quote or backslash in: {scanned[-1].text}")
        source = text[scanned[0].start : scanned[-1].end]
        output, appends, words = _without_redirection(scanned)
        plain = [w.text for w in words if not (w.is_shell or w.is_background)]
        shell = next((w.text[1:].strip() for w in words if w.is_shell), "")
        if words[0].is_background or (words[0].is_shell and words[0].text.startswith("|")):
            raise FlagError(f"there is no command before '{words[0].text[:1]}'")
        in_background = words[-1].is_background
        if output and (shell or in_background):
            raise FlagError(f"a command with '> {output}' takes neither '|' nor '&'")
        commands.append(TypedCommand(source, plain, shell, in_background, output, appends))
    return commands


def _without_redirection(words: list[Word]) -> tuple[str, bool, list[Word]]:
    """Return the file that receives the report, whether it is appended to, and the other words.

    Raises:
        FlagError: No command precedes it, no file follows, or there are two.
    """
    places = [place for place, word in enumerate(words) if word.is_redirection]
    if not places:
        return "", False, words
    (place, *more), arrow = places, words[places[0]].text
    if place == 0:
        raise FlagError(f"there is no command before '{arrow}'")
    file = words[place + 1] if place + 1 < len(words) else None
    if file is None or file.is_shell or file.is_background or not file.text:
        raise FlagError(f"no file is named after '{arrow}'")
    if more:
        raise FlagError("a report can go to one file only")
    return file.text, arrow == ">>", words[:place] + words[place + 2 :]


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
            end = _shell_end(text, position)
            commands[-1].append(Word(text[position:end], position, end, is_shell=True))
            position = end
        elif character == ">":
            end = position + (2 if text.startswith(">>", position) else 1)
            commands[-1].append(Word(text[position:end], position, end, is_redirection=True))
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


def _shell_end(text: str, start: int) -> int:
    """Return where a shell command ends: at a line end, or at a `;` that nothing protects."""
    quote, position = "", start
    while position < len(text) and text[position] != "\n":
        character = text[position]
        if character == ";" and not quote:
            break
        if character == "\\" and quote != "'":
            position += 1
        elif character == quote:
            quote = ""
        elif not quote and character in "'\"":
            quote = character
        position += 1
    return min(position, len(text))


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
