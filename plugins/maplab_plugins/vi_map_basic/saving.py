"""Saving maps to disk."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from maplab_py.plugin import CommandContext, Message, Report, UserError, command


@dataclasses.dataclass(frozen=True)
class SavedMap:
    """One map that was saved."""

    map_key: str
    folder: Path


@dataclasses.dataclass(frozen=True)
class SavedMaps(Report):
    """The maps that were saved, and what the writer says."""

    maps: tuple[SavedMap, ...]
    details: tuple[Report, ...]


@command("save", example="save --map_folder=maps/merged --overwrite", see_also=("save_all",))
def save(
    context: CommandContext, map_folder: Path | None = None, *, overwrite: bool = False
) -> SavedMaps:
    """Save the selected map; the folder's old content stays until the new one is complete.

    Args:
        map_folder: Where to; empty = the folder that the map was loaded from or last saved to.
        overwrite: Replace a map that is there already.
    """
    folder = map_folder or context.map_folder
    if folder is None:
        raise UserError(f"save: map '{context.map_key}' has no folder yet; give --map_folder=...")
    return _save(context, [(context.map_key, folder)], overwrite=overwrite)


@command("save_all", example="save_all --maps_folder=results", needs_map=False)
def save_all(
    context: CommandContext, maps_folder: Path | None = None, *, overwrite: bool = False
) -> SavedMaps:
    """Save all maps in memory.

    Args:
        maps_folder: Folder that gets one sub-folder per map, named after its key; empty = each
            map's own folder.
        overwrite: Replace maps that are there already.
    """
    jobs = []
    for entry in context.maps:
        folder = maps_folder / entry.key if maps_folder else entry.folder
        if folder is None:
            raise UserError(
                f"save_all: map '{entry.key}' has no folder yet; give --maps_folder=..."
            )
        jobs.append((entry.key, folder))
    if not jobs:
        raise UserError("save_all: no maps in memory")
    return _save(context, jobs, overwrite=overwrite)


@command("get_map_folder")
def get_map_folder(context: CommandContext) -> Message:
    """Tell the folder that the selected map was loaded from or last saved to."""
    return Message(str(context.map_folder) if context.map_folder else "the map has no folder yet")


@command("set_map_folder", example="set_map_folder maps/merged")
def set_map_folder(context: CommandContext, map_folder: Path) -> Message:
    """Choose the folder that `save` writes the selected map to.

    Args:
        map_folder: The folder; it need not exist.
    """
    entry = context.maps.selected
    context.maps.update(dataclasses.replace(entry, folder=map_folder, saved=None))
    return Message(f"map '{entry.key}' will be saved to {map_folder}")


def _save(context: CommandContext, jobs: list[tuple[str, Path]], *, overwrite: bool) -> SavedMaps:
    from maplab_py.storage.native import is_map_folder, save_map

    for key, folder in jobs:
        if is_map_folder(folder) and not overwrite:
            raise UserError(f"map '{key}': {folder} holds a map already; give --overwrite")
    reports = []
    for done, (key, folder) in enumerate(jobs):
        context.progress.step(done, len(jobs), f"save {key}")
        vi_map = context.maps.get(key).vi_map
        reports.append(save_map(vi_map, folder, overwrite=overwrite))
        context.mark_saved(key, vi_map, folder)
    return SavedMaps(tuple(SavedMap(key, folder) for key, folder in jobs), tuple(reports))
