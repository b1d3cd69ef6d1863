"""Values that complete a flag: names of maps, missions, snapshots, jobs, and paths."""

from __future__ import annotations

import datetime as dt
import os
import weakref
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from maplab_py.console.commands.command import Command
from maplab_py.console.commands.flags import Flag
from maplab_py.console.session.session import Session
from maplab_py.errors import MaplabError
from maplab_py.report import counted

if TYPE_CHECKING:
    from maplab_py.vimap import VIMap


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


def _commands(session: Session) -> list[Value]:
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
    from maplab_py.vimap.ids import to_hex_list
    from maplab_py.vimap.queries import mission_distances_m, mission_time_spans_ns

    names = [str(name) for name in vi_map.missions.name]
    counts = Counter(names)
    lengths, spans = mission_distances_m(vi_map), mission_time_spans_ns(vi_map)
    values = []
    for row, id_ in enumerate(to_hex_list(vi_map.missions.id)):
        start = dt.datetime.fromtimestamp(int(spans[row, 0]) // 10**9, tz=dt.UTC)
        is_unique = bool(names[row]) and counts[names[row]] == 1
        what = f"{id_[:8]}  {lengths[row]:.0f} m from {start:%Y-%m-%d %H:%M:%S}"
        values.append(Value(names[row] if is_unique else id_, what, id_))
    return values


_SOURCES: dict[str, Callable[[Session], list[Value]]] = {
    "alias": _aliases,
    "command": _commands,
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
