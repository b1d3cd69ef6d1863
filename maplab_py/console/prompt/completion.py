"""Completion of commands, flags and values: fuzzy matching, best match first."""

from __future__ import annotations

import dataclasses
import datetime as dt
import os
import weakref
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from maplab_py.console.commands.command import Command
from maplab_py.console.commands.flags import Flag, looks_like_flag, normalise
from maplab_py.console.commands.lines import Word, escaped, scan
from maplab_py.console.session.session import Session
from maplab_py.errors import MaplabError, UserError
from maplab_py.report import counted

if TYPE_CHECKING:
    from maplab_py.vimap import VIMap

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
        start = max(text.rfind(character) for character in " \t!|;&=<>") + 1
        return _path_candidates(text[start:], start, "")
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
    return _rank(current.text, candidates, session.uses)


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


def _flags(flags: Mapping[str, Flag], current: Word, used: set[str]) -> list[Candidate]:
    typed = normalise(current.text.lstrip("-"))
    candidates = []
    for name, flag in flags.items():
        if name in used:
            continue
        unit = f" [{flag.unit}]" if flag.unit else ""
        note = f"{flag.type.name}{unit} = {flag.default_text or '(empty)'}  {flag.help}".rstrip()
        text = f"--{name}" if flag.type.is_bool else f"--{name}="
        candidates.append((name, Candidate(text, current.start, text, note)))
    return _rank(typed, candidates)


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
    return _rank(typed, candidates)


def _rank(
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


Rank = tuple[int, int]
"""Kind of the match and number of pieces; smaller is better."""
_FEW_PIECES = 2


def match_rank(typed: str, name: str) -> Rank | None:
    """Return how well a name fits what was typed, None if it does not.

    The kinds, best first: the whole name, its beginning, the beginning of one of its words, letters
    in order from the first one on (`ovi` fits optvi), a part, letters in order. Letters in order
    are better if they form fewer pieces.
    """
    typed, name = typed.lower(), name.lower()
    if name.startswith(typed):
        return (0 if len(typed) == len(name) else 1), 1
    if f"_{typed}" in name:
        return 2, 1
    is_part = typed in name
    letters = iter(name)
    if not all(letter in letters for letter in typed):
        return None
    if name[:1] == typed[:1]:
        pieces = _pieces(typed, name)
        return (3, pieces) if not is_part or pieces == _FEW_PIECES else (4, 1)
    return (4, 1) if is_part else (5, _pieces(typed, name))


def _pieces(typed: str, name: str) -> int:
    """Return the least number of pieces of a name that make up what was typed."""
    # best[j]: fewest pieces for the letters so far, of which the last one stands at name[j]
    none = len(name) + 1
    best = [1 if letter == typed[:1] else none for letter in name]
    for letter in typed[1:]:
        before, best = best, [none] * len(name)
        fewest = none
        for place, other in enumerate(name):
            if place >= 2:
                fewest = min(fewest, before[place - 2] + 1)
            if other == letter:
                best[place] = min(before[place - 1] if place else none, fewest)
    return min(best, default=none)


class Value(NamedTuple):
    """A value that a flag can have."""

    text: str  # as it is typed
    note: str = ""  # what it is
    id: str = ""  # may be typed instead, its beginning too
    shown: str = ""  # the last part of a path


_MAP_FILE = Path("vi_map") / "vi_map_metadata"
_KIND_OF_FLAG = {
    "map_key": "map",
    "target_map_key": "map",
    "map_mission": "mission",
    "map_mission_list": "mission",
    "command_name": "command",
}


def known_values(command: Command, flag: Flag, session: Session) -> list[Value]:
    """Return the values that a flag can have now."""
    if flag.type.choices:
        return [Value(value) for value in flag.type.choices]
    source = command.completes.get(flag.name) or _KIND_OF_FLAG.get(flag.name, "")
    if callable(source):
        try:
            return [Value(text, note) for text, note in source(session)]
        except MaplabError:  # such as: no map is selected
            return []
    return _SOURCES[source](session) if source in _SOURCES else []


def _maps(session: Session) -> list[Value]:
    return [Value(entry.key, str(entry.folder or "")) for entry in session.maps]


def _snapshots(session: Session) -> list[Value]:
    if not session.maps.selected_key:
        return []
    snapshots = session.maps.selected.snapshots
    return [Value(name, _size(vi_map)) for name, vi_map in snapshots.items()]


def _size(vi_map: VIMap) -> str:
    vertices = counted(len(vi_map.vertices), "vertex", "vertices")
    return f"{vertices}, {counted(len(vi_map.landmarks), 'landmark')}"


def _jobs(session: Session) -> list[Value]:
    return [Value(str(job.number), f"{job.state}: {job.text}") for job in session.jobs.jobs]


def _aliases(session: Session) -> list[Value]:
    return [Value(name, line) for name, line in session.aliases.items()]


def _command_values(session: Session) -> list[Value]:
    return [Value(name, session.registry.find(name).summary) for name in session.registry.names]


def _missions(session: Session) -> list[Value]:
    """Return the missions by name, or by id where the name is not unique."""
    if not session.maps.selected_key:
        return []
    vi_map = session.vi_map
    if vi_map not in _MISSIONS:
        _MISSIONS[vi_map] = _described_missions(vi_map)
    return _MISSIONS[vi_map]


_MISSIONS: weakref.WeakKeyDictionary[VIMap, list[Value]] = weakref.WeakKeyDictionary()
"""The missions of a map do not change, as maps are values."""


def _described_missions(vi_map: VIMap) -> list[Value]:
    from maplab_py.vimap import ids, queries

    names = [str(name) for name in vi_map.missions.name]
    counts = Counter(names)
    lengths, spans = queries.mission_distances_m(vi_map), queries.mission_time_spans_ns(vi_map)
    values = []
    for row, id_ in enumerate(ids.to_hex_list(vi_map.missions.id)):
        start = dt.datetime.fromtimestamp(int(spans[row, 0]) // 10**9, tz=dt.UTC)
        is_unique = bool(names[row]) and counts[names[row]] == 1
        what = f"{id_[:8]}  {lengths[row]:.0f} m from {start:%Y-%m-%d %H:%M:%S}"
        values.append(Value(names[row] if is_unique else id_, what, id_))
    return values


_SOURCES: dict[str, Callable[[Session], list[Value]]] = {
    "alias": _aliases,
    "command": _command_values,
    "job": _jobs,
    "map": _maps,
    "mission": _missions,
    "snapshot": _snapshots,
}


def path_values(typed: str) -> list[Value]:
    """Return the files and folders that continue a typed path: maps first, folders with a slash."""
    head, separator, tail = typed.rpartition("/")
    folder = Path(os.path.expanduser(os.path.expandvars(head + separator)) or ".")
    candidates = []
    try:
        entries = sorted(os.scandir(folder), key=lambda entry: entry.name)
    except OSError:
        return []
    for entry in entries:
        if not entry.name.startswith(tail) or (entry.name.startswith(".") and not tail):
            continue
        is_folder = entry.is_dir()
        is_map = is_folder and os.path.exists(os.path.join(entry.path, _MAP_FILE))
        shown = entry.name + ("/" if is_folder else "")
        value = Value(head + separator + shown, "map" if is_map else "", shown=shown)
        candidates.append((not is_map, value))
    return [value for _, value in sorted(candidates, key=lambda pair: pair[0])]
