"""Memory of maps, their former values and the cache of maps."""

from __future__ import annotations

import dataclasses

from maplab_py.console.session.undo import UndoOptions
from maplab_py.plugin import CommandContext, Report, command

_GB = 1e-9


@dataclasses.dataclass(frozen=True)
class MapMemory:
    """Memory of one map."""

    map_key: str
    columns_gb: float
    mapped_gb: float  # part of the columns that lies in a file of the cache
    undo_values: int
    undo_gb: float  # of former values and snapshots, what the present value shares left out
    dropped_values: int  # that undo cannot restore any more


@dataclasses.dataclass(frozen=True)
class MemoryReport(Report):
    """Memory of the maps, the cache of maps and the process."""

    maps: tuple[MapMemory, ...] = dataclasses.field(metadata={"title": ""})
    undo_max_gb: float
    cached_maps: int
    cache_gb: float
    cache_folder: str
    process_gb: float
    available_gb: float


_UNDO = UndoOptions()


@command(
    "memory",
    example="memory",
    see_also=("list", "undo", "clear_storage", "resource_cache_statistics"),
    needs_map=False,
)
def memory(context: CommandContext, *, undo: UndoOptions = _UNDO) -> MemoryReport:
    """Show the memory of maps, of undo and of the cache of maps; limit that of undo.

    A column that several maps or former values share counts once, for the first of them. Columns in a
    file of the cache of maps take memory only where they are in use, and the system takes that back
    when it is short.

    A limit that is given holds for the rest of the session.
    """
    from maplab_py.console.session.settings import Layer
    from maplab_py.console.session.undo import bounded, former_values
    from maplab_py.memory import available_bytes, resident_bytes
    from maplab_py.storage.column_file import mapped_bytes
    from maplab_py.storage.map_cache import MapCache
    from maplab_py.vimap.memory_use import SharedColumns

    settings = context.session.settings
    if undo != UndoOptions.of(settings) and not context.is_trial:
        settings.assign([f"--undo_max_gb={undo.undo_max_gb!r}"], Layer.SET, "memory")
    columns, mapped, lines = SharedColumns(), SharedColumns(), []
    for entry in context.maps:
        kept = bounded(entry, undo)
        context.maps.update(kept)
        values = former_values(kept)
        lines.append(
            MapMemory(
                map_key=kept.key,
                columns_gb=_GB * columns.add(kept.vi_map),
                mapped_gb=_GB * mapped.add(kept.vi_map, mapped_bytes),
                undo_values=len(values),
                undo_gb=_GB * columns.add_all(values),
                dropped_values=kept.dropped_values,
            )
        )
    cache = MapCache()
    use = cache.use()
    return MemoryReport(
        maps=tuple(lines),
        undo_max_gb=undo.undo_max_gb,
        cached_maps=use.maps,
        cache_gb=_GB * use.bytes,
        cache_folder=str(cache.folder),
        process_gb=_GB * resident_bytes(),
        available_gb=_GB * available_bytes(),
    )
