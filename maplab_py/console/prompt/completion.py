"""Completion of commands, flags and values: fuzzy matching, best match first."""

from __future__ import annotations

import dataclasses
from collections import Counter

from maplab_py.console.commands.command import Command
from maplab_py.console.commands.flags import Flag, looks_like_flag, normalise
from maplab_py.console.commands.lines import Word, escaped, scan
from maplab_py.console.prompt.matching import Rank, match_rank
from maplab_py.console.prompt.values import known_values, path_values
from maplab_py.console.session.session import Session
from maplab_py.errors import UserError

_MOST_VALUES = 1000
"""More values of a flag are not proposed: nobody looks through them, and they take time."""


@dataclasses.dataclass(frozen=True)
class Candidate:
    """One way to complete the word at the cursor."""

    text: str  # replaces the word from `start` to the cursor
    start: int
    shown: str
    help: str = ""


def complete(text: str, session: Session) -> list[Candidate]:
    """Return the candidates for the text before the cursor."""
    words = scan(text)[-1]
    at_new_word = not words or (words[-1].end < len(text) and not words[-1].is_open)
    current = Word("", len(text), len(text)) if at_new_word else words[-1]
    earlier = words if at_new_word else words[:-1]
    if words and words[-1].is_shell:
        return _shell_paths(text)
    if words and (words[-1].is_redirection or (earlier and earlier[-1].is_redirection)):
        return _path_candidates(current.text, current.start, "")
    if not earlier:
        return _commands(current, session)
    try:
        command = session.registry.find(earlier[0].text)
    except UserError:
        return []
    return _complete_argument(command, earlier[1:], current, session)


def _commands(current: Word, session: Session) -> list[Candidate]:
    candidates = []
    for name in session.registry.names:
        command = session.registry.find(name)
        note = command.summary if name == command.name else f"{command.summary} ({command.name})"
        candidates.append((name, Candidate(name, current.start, name, note)))
    for name, line in session.aliases.items():
        candidates.append((name, Candidate(name, current.start, name, f"alias: {line}")))
    return _ranked(current.text, candidates, session.uses)


def _shell_paths(text: str) -> list[Candidate]:
    """Complete the last word of a shell command as a path."""
    start = max(text.rfind(character) for character in " \t!|;&=<>") + 1
    return _path_candidates(text[start:], start, "")


def _path_candidates(typed: str, start: int, before: str) -> list[Candidate]:
    return [
        Candidate(before + escaped(value.text), start, value.shown, value.note)
        for value in path_values(typed)
    ]


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
        return _values(command, flag, value, current, f"--{flag.name}=", session)
    previous = earlier[-1].text if earlier else ""
    if looks_like_flag(previous) and "=" not in previous:
        flag = flags.get(normalise(previous.lstrip("-")))
        if flag is not None and not flag.type.is_bool:
            return _values(command, flag, current.text, current, "", session)
    if command.raw_arguments:
        return _flags(flags, current, set())
    place = sum(not looks_like_flag(word.text) for word in earlier)
    if place < len(command.positional):
        positional = flags[command.positional[place]]
        candidates = _values(command, positional, current.text, current, "", session)
        if candidates or current.text:
            return candidates
    return _flags(flags, current, _used(earlier))


def _used(earlier: list[Word]) -> set[str]:
    return {
        normalise(word.text.lstrip("-").partition("=")[0])
        for word in earlier
        if looks_like_flag(word.text)
    }


def _flags(flags: dict[str, Flag], current: Word, used: set[str]) -> list[Candidate]:
    typed = normalise(current.text.lstrip("-"))
    candidates = []
    for name, flag in flags.items():
        if name in used:
            continue
        unit = f" [{flag.unit}]" if flag.unit else ""
        note = f"{flag.type.name}{unit} = {flag.default_text or '(empty)'}  {flag.help}".rstrip()
        text = f"--{name}" if flag.type.is_bool else f"--{name}="
        candidates.append((name, Candidate(text, current.start, text, note)))
    return _ranked(typed, candidates)


def _values(
    command: Command, flag: Flag, typed: str, current: Word, before: str, session: Session
) -> list[Candidate]:
    if flag.type.name == "path":
        return _path_candidates(typed, current.start, before)
    head = ""
    if flag.name == "map_mission_list" or flag.type.name.endswith(",..."):
        head, comma, typed = typed.rpartition(",")
        head += comma
    values = known_values(command, flag, session)
    if typed and any(value.id.startswith(typed.lower()) for value in values):
        values = [v for v in values if v.text.startswith(typed) or v.id.startswith(typed.lower())]
        typed = ""
    else:
        values = [v for v in values if v.text.startswith(typed)] or [
            v for v in values if match_rank(typed, v.text) is not None
        ]
    candidates = [
        (v.text, Candidate(before + head + escaped(v.text), current.start, v.text, v.note))
        for v in values[:_MOST_VALUES]
    ]
    return _ranked(typed, candidates)


def _ranked(
    typed: str, candidates: list[tuple[str, Candidate]], uses: Counter[str] | None = None
) -> list[Candidate]:
    """Return the candidates that fit, best first; of equal ones the most used, then the shortest.

    If names begin with what was typed, only such names are candidates.
    """
    if not typed:
        return [candidate for _, candidate in sorted(candidates, key=lambda pair: pair[0])]
    starting = [pair for pair in candidates if pair[0].lower().startswith(typed.lower())]
    used: Counter[str] = Counter() if uses is None else uses
    fitting: list[tuple[Rank, int, int, str, Candidate]] = []
    for name, candidate in starting or candidates:
        rank = match_rank(typed, name)
        if rank is not None:
            fitting.append((rank, -used[name], len(name), name, candidate))
    return [entry[-1] for entry in sorted(fitting, key=lambda entry: entry[:-1])]
