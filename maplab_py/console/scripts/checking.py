"""Errors of a chain of commands that can be seen before anything of it runs."""

import itertools
import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from maplab_py.console.commands import flags, lines
from maplab_py.console.scripts.aliases import expanded
from maplab_py.console.session.call import Call, call_from_words
from maplab_py.console.session.maps import key_of_folder
from maplab_py.console.session.session import Session
from maplab_py.console.session.settings import Layer
from maplab_py.errors import UserError
from maplab_py.output_files import check_creatable, check_writable

LEAVE = ("q", "quit", "exit")
_MAKERS_OF_ANY_KEY = ("recover",)
"""Commands whose maps have keys that their lines do not name."""
_NO_KEY = re.compile(r"[^A-Za-z0-9_-]+")
"""Characters between the words that keys of maps may be made of."""
_MAX_DEPTH = 8
_MOST_FOLDERS = 2000
"""Folders below others that are looked at for maps; in larger trees any map may be."""


def check_commands(text: str, session: Session, written: list[Path] | None = None) -> list[str]:
    """Return the errors of a text of commands, each with its place; nothing is run.

    Names, flags, types, values that are missing, variables, files, folders and maps that a command reads and
    that no command before it can have made, and output files that exist or cannot be made.

    Args:
        text: The commands.
        session: Gives aliases, variables and lasting flags; it does not change.
        written: Files that texts before it may write; those of this text are appended.
    """
    return check_script(text, session, written)[0]


def check_script(
    text: str, session: Session, written: list[Path] | None = None
) -> tuple[list[str], list[tuple[str, Call | None]]]:
    """Return the errors as `check_commands`, and the commands with their calls; None for a help page."""
    checker = _Checker(session, [] if written is None else written)
    checker.check(text)
    return checker.problems, checker.steps


class _Checker:
    """Follows what earlier commands of the chain would do to variables, aliases and flags."""

    def __init__(self, session: Session, written: list[Path]) -> None:
        self.problems: list[str] = []
        self.steps: list[tuple[str, Call | None]] = []
        self._registry = session.registry
        # clicks in the viewer set it while the chain runs
        self._variables = {"pick": "pick", **session.variables}
        self._aliases = dict(session.aliases)
        self._settings = session.settings.copy()
        self._written = written
        self._keys = set(session.maps.keys)  # and beginnings of keys that commands may make
        self._makes_any_key = False
        self._runs_shell = False  # a shell command can make any file

    def check(self, text: str, place: str = "", depth: int = 0) -> None:
        """Check the commands of a text; `place` is that of the alias that it stands for."""
        try:
            commands = lines.typed_commands(text)
        except UserError as error:
            self.problems.append(_placed(str(error), place))
            return
        position = 0
        for command in commands:
            position = text.index(command.source, position)
            where = place or (_place(text, position) if len(commands) > 1 else "")
            try:
                if self._check_command(command, where, depth):
                    return
            except UserError as error:
                self.problems.append(_placed(str(error), where))
            position += len(command.source)

    def _check_command(self, typed: lines.TypedCommand, place: str, depth: int) -> bool:
        """Check one command; return whether it ends the chain."""
        (command,) = lines.typed_commands(typed.source, lines.variable_lookup(self._variables))
        if command.assignment is not None:
            self._variables.update([command.assignment])
            return False
        self._runs_shell |= bool(command.shell)
        if not command.words:
            return False
        if command.words[0] in LEAVE and len(command.words) == 1:
            return True
        alias = expanded(command, self._aliases)
        if alias is not None:
            if depth >= _MAX_DEPTH:
                raise UserError(f"alias '{command.words[0]}' contains itself")
            self.check(alias, place, depth + 1)
            return False
        call = call_from_words(command.words, self._registry, self._settings)
        self.steps.append((typed.source, None if call.wants_help else call))
        if not call.wants_help:
            call.arguments()
            self._check_files(call)
            self._follow(call, command.words[1:])
        return False

    def _check_files(self, call: Call) -> None:
        for name in () if self._runs_shell else call.command.reads:
            value = call.values.get(name)
            fault = self._missing(Path(value), is_key=isinstance(value, str)) if value else ""
            if fault:
                raise UserError(f"{call.command.name}: --{name}={value}: {fault}")
        if not self._runs_shell:
            self._check_output(call)
        defaults = {name: flag.default for name, flag in call.command.flags.items()}
        paths = [p for p in (defaults | dict(call.values)).values() if isinstance(p, Path)]
        self._written += paths
        names = [os.path.basename(os.path.realpath(path)) for path in paths]  # behind links
        texts = (*call.given.values(), *call.values.values(), call.command.name, *names)
        self._keys.update(word for text in texts for word in _NO_KEY.split(str(text)) if word)
        self._makes_any_key |= call.command.name in _MAKERS_OF_ANY_KEY
        self._makes_any_key |= not self._registry.is_built_in(call.command)

    def _missing(self, path: Path, *, is_key: bool) -> str:
        """Return why a file, or the map of a key, is not there; empty if it may be by then."""
        fault, key = _fault(path), str(path)
        if not fault or any(_is_related(path, other) for other in self._written):
            return ""
        if not is_key:
            return fault
        known = tuple(word.lstrip("_") for word in self._keys)
        if self._makes_any_key or key.lstrip("_").startswith(known):
            return ""
        below = list(itertools.islice(_folders_below(self._written), _MOST_FOLDERS))
        if len(below) == _MOST_FOLDERS or key in map(key_of_folder, below):
            return ""
        return "there is no such map, neither in memory nor on disk"

    def _check_output(self, call: Call) -> None:
        """Refuse an output file that exists already, or whose folder cannot be made."""
        path = call.values.get(call.command.output)
        if not isinstance(path, Path) or any(_is_related(path, other) for other in self._written):
            return
        if os.path.isfile(path) and "overwrite" in call.command.flags:
            check_writable(path, overwrite=bool(call.values.get("overwrite")))
        elif not os.path.lexists(path):
            check_creatable(path)

    def _follow(self, call: Call, words: Sequence[str]) -> None:
        """Do to the copies of the session's state what a command would do to it."""
        name = call.command.name
        if name == "set" and words:
            self._settings.assign(words, Layer.SET, "set")
        elif name == "unset":
            for word in words:
                self._settings.unset(flags.normalise(word.lstrip("-")))
        elif name == "alias" and words:
            alias, _, text = words[0].partition("=")
            self._aliases[alias] = text
        elif name == "unalias" and words:
            self._aliases.pop(words[0], None)
        if call.keeps_flags:
            kept = [f"--{flag}={text}" for flag, text in call.given.items()]
            self._settings.assign(kept, Layer.SET, "--keep_gflags")


def _fault(path: Path) -> str:
    """Return why a path cannot be read, as without permission for its folder; empty if it is there."""
    try:
        return "" if path.exists() else "there is no such file or folder"
    except OSError as error:
        return error.strerror or "it cannot be read"


def _folders_below(parents: list[Path]) -> Iterator[Path]:
    """Iterate over the folders below some, whose names maps may get as keys."""
    for parent in set(parents):
        for where, names, _ in os.walk(parent):
            names[:] = (name for name in names if not name.startswith("."))
            yield from (Path(where, name) for name in names)


def _is_related(path: Path, other: Path) -> bool:
    """Return whether one path is the other, or lies below it."""
    first, second = path.absolute(), other.absolute()
    return first == second or first in second.parents or second in first.parents


def _place(text: str, position: int) -> str:
    line = text.count("\n", 0, position) + 1
    column = position - (text.rfind("\n", 0, position) + 1) + 1
    return f"line {line}, column {column}" if "\n" in text.strip() else f"column {column}"


def _placed(message: str, place: str) -> str:
    return f"{place}: {message}" if place else message
