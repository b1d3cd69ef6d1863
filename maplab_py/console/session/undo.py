"""Memory limit of the former values of maps."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from maplab_py.console.session.maps import MapEntry, Step
from maplab_py.console.session.settings import Settings
from maplab_py.options import Options, option
from maplab_py.vimap import VIMap

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
