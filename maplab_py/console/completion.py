"""What could come next on a line: commands, flags of the command, values. Fuzzy, best first."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterable
from pathlib import Path

from maplab_py.console.command import Command
from maplab_py.console.flags import Flag, looks_like_flag, normalise
from maplab_py.console.lines import Word, scan
from maplab_py.console.session import Session
from maplab_py.errors import UserError

_MAP_KEY_FLAGS = ("map_key", "target_map_key")
_MISSION_FLAGS = ("map_mission", "map_mission_list")
_COMMAND_FLAGS = ("command_name",)


@dataclasses.dataclass(frozen=True)
class Candidate:
    """One way to complete the word at the cursor."""

    text: str  # replaces the word from `start` to the cursor
    start: int
    shown: str
    help: str = ""


def match_rank(typed: str, name: str) -> int | None:
    """Return how well a name fits what was typed (0 best), None if it does not.

    A prefix is best, then a part, then the letters in order (`ovi` fits optvi).
    """
    typed, name = typed.lower(), name.lower()
    if name.startswith(typed):
        return 0
    if typed in name:
        return 1
    letters = iter(name)
    return 2 if all(letter in letters for letter in typed) else None


def complete(text: str, session: Session) -> list[Candidate]:
    """Return the candidates for the text before the cursor."""
    words = scan(text)[-1]
    at_new_word = not words or (words[-1].end < len(text) and not words[-1].is_open)
    current = Word("", len(text), len(text)) if at_new_word else words[-1]
    earlier = words if at_new_word else words[:-1]
    if not earlier:
        return _commands(current, session)
    try:
        command = session.registry.find(earlier[0].text)
    except UserError:
        return []
    return _complete_argument(command, earlier[1:], current, session)


def _commands(current: Word, session: Session) -> list[Candidate]:
    found = []
    for name in session.registry.names:
        command = session.registry.find(name)
        note = command.summary if name == command.name else f"{command.summary} ({command.name})"
        found.append((name, Candidate(name, current.start, name, note)))
    return _ranked(current.text, found)


def _complete_argument(
    command: Command, earlier: list[Word], current: Word, session: Session
) -> list[Candidate]:
    flags = session.registry.all_flags() if command.raw_arguments else dict(command.flags)
    if looks_like_flag(current.text) or current.text == "-":
        name, has_value, value = current.text.lstrip("-").partition("=")
        flag = flags.get(normalise(name))
        if not has_value:
            return _flags(flags, current, set() if command.raw_arguments else _used(earlier))
        if flag is None:
            return []
        return _values(flag, value, current, f"--{flag.name}=", session)
    previous = earlier[-1].text if earlier else ""
    if looks_like_flag(previous) and "=" not in previous:
        flag = flags.get(normalise(previous.lstrip("-")))
        if flag is not None and not flag.type.is_bool:
            return _values(flag, current.text, current, "", session)
    if command.raw_arguments:
        return _flags(flags, current, set())
    place = sum(not looks_like_flag(word.text) for word in earlier)
    if place < len(command.positional):
        positional = flags[command.positional[place]]
        found = _values(positional, current.text, current, "", session)
        if found or current.text:
            return found
    return _flags(flags, current, _used(earlier))


def _used(earlier: list[Word]) -> set[str]:
    return {
        normalise(word.text.lstrip("-").partition("=")[0])
        for word in earlier
        if looks_like_flag(word.text)
    }


def _flags(flags: dict[str, Flag], current: Word, used: set[str]) -> list[Candidate]:
    typed = normalise(current.text.lstrip("-"))
    found = []
    for name, flag in flags.items():
        if name in used:
            continue
        unit = f" [{flag.unit}]" if flag.unit else ""
        note = f"{flag.type.name}{unit} = {flag.default_text or '(empty)'}  {flag.help}".rstrip()
        text = f"--{name}" if flag.type.is_bool else f"--{name}="
        found.append((name, Candidate(text, current.start, text, note)))
    return _ranked(typed, found)


def _values(
    flag: Flag, typed: str, current: Word, before: str, session: Session
) -> list[Candidate]:
    if flag.type.name == "path":
        return [
            Candidate(before + _quoted(path), current.start, shown) for path, shown in _paths(typed)
        ]
    head = ""
    if flag.name == "map_mission_list" or flag.type.name.endswith(",..."):
        head, comma, typed = typed.rpartition(",")
        head += comma
    found = [
        (value, Candidate(before + head + value, current.start, value, note))
        for value, note in _known_values(flag, session)
    ]
    return _ranked(typed, found)


def _known_values(flag: Flag, session: Session) -> Iterable[tuple[str, str]]:
    if flag.type.choices:
        return [(value, "") for value in flag.type.choices]
    if flag.name in _MAP_KEY_FLAGS:
        return [(entry.key, str(entry.folder or "")) for entry in session.maps]
    if flag.name in _MISSION_FLAGS and session.maps.selected_key:
        from maplab_py.vimap.ids import to_hex_list

        vi_map = session.vi_map
        ids = to_hex_list(vi_map.missions.id)
        return [(id_, f"mission {row}") for row, id_ in enumerate(ids)]
    if flag.name in _COMMAND_FLAGS:
        names = session.registry.names
        return [(name, session.registry.find(name).summary) for name in names]
    return []


def _paths(typed: str) -> list[tuple[str, str]]:
    """List the files and folders that continue a typed path, folders with a slash."""
    head, separator, tail = typed.rpartition("/")
    folder = Path(os.path.expanduser(os.path.expandvars(head + separator)) or ".")
    found = []
    try:
        entries = sorted(os.scandir(folder), key=lambda entry: entry.name)
    except OSError:
        return []
    for entry in entries:
        if not entry.name.startswith(tail) or (entry.name.startswith(".") and not tail):
            continue
        shown = entry.name + ("/" if entry.is_dir() else "")
        found.append((head + separator + shown, shown))
    return found


def _quoted(path: str) -> str:
    return "".join(f"\\{c}" if c in " \t;#'\"\\" else c for c in path)


def _ranked(typed: str, found: list[tuple[str, Candidate]]) -> list[Candidate]:
    ranked = [(match_rank(typed, name), name, candidate) for name, candidate in found]
    fitting = [(rank, name, candidate) for rank, name, candidate in ranked if rank is not None]
    if any(rank == 0 for rank, _, _ in fitting) and typed:
        fitting = [entry for entry in fitting if entry[0] == 0]
    return [candidate for _, _, candidate in sorted(fitting, key=lambda e: (e[0], e[1]))]
