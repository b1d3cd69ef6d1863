"""The maps in memory by key, with the selection and the history of each. All are immutable values."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from maplab_py.console.commands.suggest import did_you_mean
from maplab_py.errors import UserError

if TYPE_CHECKING:
    from maplab_py.storage.native import DiskCopy
    from maplab_py.vimap import VIMap
from collections.abc import Sequence

from maplab_py.console.session.settings import Settings
from maplab_py.options import Options, option
from maplab_py.vimap import VIMap

MAX_UNDO = 32
_KEY = re.compile(r"^[A-Za-z0-9_-]+$")


@dataclasses.dataclass(frozen=True)
class Step:
    """A former value of a map with the command that replaced it (past) or produced it (future)."""

    command: str
    vi_map: VIMap


@dataclasses.dataclass(frozen=True)
class MapEntry:
    """One map in memory."""

    key: str
    vi_map: VIMap
    folder: Path | None = None
    saved: VIMap | None = None  # the value that is on disk
    disk_copy: DiskCopy | None = None  # the files as they were when it was loaded or saved
    past: tuple[Step, ...] = ()
    future: tuple[Step, ...] = ()
    snapshots: Mapping[str, VIMap] = dataclasses.field(default_factory=dict)
    dropped_values: int = 0  # former values beyond --undo_max_gb

    @property
    def is_saved(self) -> bool:
        """Tell whether the disk has the current value; an empty new map counts as saved."""
        return self.vi_map is self.saved or (self.saved is None and len(self.vi_map.missions) == 0)

    def with_value(self, vi_map: VIMap, command: str) -> MapEntry:
        """Return the entry with a new value; undo restores the old one.

        An equal value changes nothing.
        """
        from maplab_py.vimap.comparison import is_same

        if is_same(vi_map, self.vi_map):
            return self
        past = (*self.past, Step(command, self.vi_map))[-MAX_UNDO:]
        return dataclasses.replace(self, vi_map=vi_map, past=past, future=())

    def known_at(self, folder: Path) -> str:
        """Return the fingerprint of the files in a folder if the map was loaded or saved there."""
        return self.disk_copy.known_at(folder) if self.disk_copy is not None else ""

    def undone(self) -> MapEntry:
        """Return the entry one step back.

        Raises:
            UserError: There is nothing to undo.
        """
        if not self.past:
            dropped = (
                f" any more: {self.dropped_values} former values were beyond --undo_max_gb"
                if self.dropped_values
                else ""
            )
            raise UserError(f"map '{self.key}' has nothing to undo{dropped}")
        step = self.past[-1]
        future = (Step(step.command, self.vi_map), *self.future)
        return dataclasses.replace(self, vi_map=step.vi_map, past=self.past[:-1], future=future)

    def redone(self) -> MapEntry:
        """Return the entry one step forward again.

        Raises:
            UserError: There is nothing to redo.
        """
        if not self.future:
            raise UserError(f"map '{self.key}' has nothing to redo")
        step = self.future[0]
        past = (*self.past, Step(step.command, self.vi_map))
        return dataclasses.replace(self, vi_map=step.vi_map, past=past, future=self.future[1:])


@dataclasses.dataclass(frozen=True)
class MapsState:
    """State of all maps, kept to restore it if a command fails."""

    entries: Mapping[str, MapEntry] = dataclasses.field(default_factory=dict)
    selected: str = ""


@dataclasses.dataclass(frozen=True)
class Conflict:
    """A map that two commands changed at the same time, and the key of the later result."""

    key: str
    kept_as: str


def merge_states(
    base: MapsState, result: MapsState, current: MapsState
) -> tuple[MapsState, tuple[Conflict, ...]]:
    """Merge the result of a command, which started from `base`, into the present state.

    Args:
        base: State at the start of the command.
        result: State at its end.
        current: Present state.

    Returns:
        The new state. A map that was changed on both sides keeps its present value; the value of
        the command is added under a new key, which the second result names.
    """
    if current is base:
        return result, ()
    entries = dict(current.entries)
    conflicts = []
    for key, entry in result.entries.items():
        if base.entries.get(key) is entry:
            continue
        if current.entries.get(key) is base.entries.get(key):
            entries[key] = entry
        else:
            free = next(k for n in range(1, len(entries) + 2) if (k := f"{key}-{n}") not in entries)
            entries[free] = dataclasses.replace(
                entry, key=free, folder=None, saved=None, disk_copy=None
            )
            conflicts.append(Conflict(key, free))
    for key in base.entries.keys() - result.entries.keys():
        if current.entries.get(key) is base.entries[key]:
            del entries[key]
    selected = current.selected if current.selected in entries else result.selected
    return MapsState(entries, selected if selected in entries else ""), tuple(conflicts)


class MapManager:
    """The maps of a session by key."""

    def __init__(self, state: MapsState | None = None) -> None:
        """Start with the maps of a state, without any when it is not given."""
        self.state = MapsState() if state is None else state

    def __len__(self) -> int:
        return len(self.state.entries)

    def __iter__(self) -> Iterator[MapEntry]:
        return iter(list(self.state.entries.values()))

    def __contains__(self, key: object) -> bool:
        return key in self.state.entries

    @property
    def keys(self) -> list[str]:
        """The keys in the order in which the maps were added."""
        return list(self.state.entries)

    @property
    def selected_key(self) -> str:
        """Key of the selected map, empty when none is."""
        return self.state.selected

    @property
    def selected(self) -> MapEntry:
        """The selected map.

        Raises:
            UserError: No map is selected.
        """
        if not self.state.selected:
            remedy = "select one: select_map --map_key=..." if self.keys else "load one: load ..."
            raise UserError(f"no map is selected; {remedy}")
        return self.state.entries[self.state.selected]

    @property
    def unsaved(self) -> list[MapEntry]:
        """The maps whose value is not on disk."""
        return [entry for entry in self if not entry.is_saved]

    def get(self, key: str) -> MapEntry:
        """Return the map with this key.

        Raises:
            UserError: There is none; the message names the known keys.
        """
        if key in self.state.entries:
            return self.state.entries[key]
        known = ", ".join(self.keys) or "none"
        proposal = did_you_mean(key, self.keys)
        raise UserError(f"no map has the key '{key}'{proposal or f' (maps in memory: {known})'}")

    def check_new_key(self, key: str) -> str:
        """Return a key that may be given to a new map.

        Raises:
            UserError: The key has other characters than letters, digits, - and _, or is taken.
        """
        if not _KEY.match(key):
            raise UserError(f"'{key}' cannot be a map key: use letters, digits, - and _")
        if key in self.state.entries:
            raise UserError(f"map key '{key}' is in use; choose another one or delete that map")
        return key

    def add(
        self,
        key: str,
        vi_map: VIMap,
        *,
        folder: Path | None = None,
        is_saved: bool = False,
        disk_copy: DiskCopy | None = None,
        select: bool = True,
    ) -> MapEntry:
        """Add a map under a new key.

        Raises:
            UserError: The key is not valid or taken.
        """
        saved = vi_map if is_saved else None
        entry = MapEntry(self.check_new_key(key), vi_map, folder, saved, disk_copy)
        self._put(entry, key if select or not self.selected_key else self.selected_key)
        return entry

    def update(self, entry: MapEntry) -> None:
        """Replace the entry of the same key."""
        self.get(entry.key)
        self._put(entry, self.selected_key)

    def select(self, key: str) -> None:
        """Make a map the selected one."""
        self.state = dataclasses.replace(self.state, selected=self.get(key).key)

    def remove(self, key: str) -> None:
        """Remove a map; if it was the selected one, the last remaining one is selected."""
        self.get(key)
        entries = {k: entry for k, entry in self.state.entries.items() if k != key}
        selected = self.state.selected
        if selected == key:
            selected = next(reversed(entries), "")
        self.state = MapsState(entries, selected)

    def rename(self, key: str, new_key: str) -> None:
        """Give a map another key; it keeps its place in the list."""
        entry = self.get(key)
        self.check_new_key(new_key)
        renamed = dataclasses.replace(entry, key=new_key)
        entries = {e.key: e for e in (renamed if e.key == key else e for e in self)}
        selected = new_key if self.state.selected == key else self.state.selected
        self.state = MapsState(entries, selected)

    def _put(self, entry: MapEntry, selected: str) -> None:
        self.state = MapsState({**self.state.entries, entry.key: entry}, selected)


def key_of_folder(folder: Path) -> str:
    """Return the key that a map gets from its folder's name."""
    return re.sub(r"[^A-Za-z0-9_-]", "_", folder.resolve().name) or "map"


_FLAG = "undo_max_gb"
_GB = 1e9


class UndoOptions(Options):
    """Bound of the values that undo and redo keep."""

    undo_max_gb: float = option(4.0, ge=0)
    """Memory for the former values of each map, columns that the present value shares left out; the oldest
    values beyond it are dropped and cannot be restored by undo."""

    @classmethod
    def of(cls, settings: Settings) -> UndoOptions:
        """Return the lasting value of the flag, else the default."""
        setting = settings.current().get(_FLAG)
        return cls() if setting is None else cls(float(setting.text))


def bounded(entry: MapEntry, options: UndoOptions) -> MapEntry:
    """Return a map without the oldest of its former values beyond the bound.

    Columns that the present value, a snapshot or a later value has count nothing. Undone values
    count first.
    """
    from maplab_py.vimap.memory_use import SharedColumns, forget_lookups

    columns = SharedColumns()
    columns.add_all([entry.vi_map, *entry.snapshots.values()])
    left = options.undo_max_gb * _GB
    kept = [0, 0]
    for which, steps in enumerate((entry.future, entry.past[::-1])):
        for step in steps:
            forget_lookups(step.vi_map)
            left -= columns.add(step.vi_map)
            if left < 0.0:
                break
            kept[which] += 1
    dropped = len(entry.past) - kept[1]
    if not dropped and kept[0] == len(entry.future):
        return entry
    return dataclasses.replace(
        entry,
        past=entry.past[dropped:],
        future=entry.future[: kept[0]],
        dropped_values=entry.dropped_values + dropped,
    )


def former_values(entry: MapEntry) -> Sequence[VIMap]:
    """Return the values that undo, redo and snapshots keep."""
    steps: tuple[Step, ...] = (*entry.future, *entry.past[::-1])
    return [*(step.vi_map for step in steps), *entry.snapshots.values()]
