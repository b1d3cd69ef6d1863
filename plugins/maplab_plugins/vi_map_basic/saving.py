"""Saving maps to disk."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from maplab_py.options import option
from maplab_py.plugin import CommandContext, Message, Report, UserError, command
from maplab_py.vimap import VIMap


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


@dataclasses.dataclass(frozen=True)
class PlannedSave:
    """What saving one map would do."""

    map_key: str
    folder: Path
    replaces_a_map: bool
    missions: int
    vertices: int
    landmarks: int
    resources_to_copy: int
    resource_files_to_delete: int


@dataclasses.dataclass(frozen=True)
class SavePlan(Report):
    """What saving would do; nothing has been written."""

    maps: tuple[PlannedSave, ...]


@dataclasses.dataclass(frozen=True)
class ResourceMigration:
    """Where the resource files go when a map is saved; at most one of the four is given."""

    copy_resources_to_map_folder: bool = option(
        False, help="Copy all resources into the map's folder."
    )
    move_resources_to_map_folder: bool = option(
        False, help="Move all resources into the map's folder."
    )
    copy_resources_to_external_folder: str = option(
        "", help="Copy all resources to this folder and refer to it."
    )
    move_resources_to_external_folder: str = option(
        "", help="Move all resources to this folder and refer to it."
    )

    def check(self) -> None:
        """Refuse contradicting wishes."""
        wishes = [field.name for field in dataclasses.fields(self) if getattr(self, field.name)]
        if len(wishes) > 1:
            raise UserError(f"save: give only one of {', '.join(f'--{name}' for name in wishes)}")


_NO_MIGRATION = ResourceMigration()


@command(
    "save",
    example="save --map_folder=maps/merged --overwrite",
    see_also=("save_all",),
    acts_outside=True,
)
def save(
    context: CommandContext,
    map_folder: Path | None = None,
    *,
    overwrite: bool = False,
    migration: ResourceMigration = _NO_MIGRATION,
    dry_run: bool = False,
) -> SavedMaps | SavePlan:
    """Save the selected map; the folder's old content stays until the new one is complete.

    Args:
        map_folder: Where to; empty = the folder that the map was loaded from or last saved to.
        overwrite: Replace a map that is there already.
        dry_run: Only tell what would be written and replaced.
    """
    folder = map_folder or context.map_folder
    if folder is None:
        raise UserError(f"save: map '{context.map_key}' has no folder yet; give --map_folder=...")
    jobs = [(context.map_key, folder)]
    if dry_run:
        return _plan(context, jobs, migration, overwrite=overwrite)
    return _save(context, jobs, migration, overwrite=overwrite)


@command("save_all", example="save_all --maps_folder=results", needs_map=False, acts_outside=True)
def save_all(
    context: CommandContext,
    maps_folder: Path | None = None,
    *,
    overwrite: bool = False,
    migration: ResourceMigration = _NO_MIGRATION,
    dry_run: bool = False,
) -> SavedMaps | SavePlan:
    """Save all maps in memory.

    Args:
        maps_folder: Folder that gets one sub-folder per map, named after its key; empty = each
            map's own folder.
        overwrite: Replace maps that are there already.
        dry_run: Only tell what would be written and replaced.
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
    if dry_run:
        return _plan(context, jobs, migration, overwrite=overwrite)
    return _save(context, jobs, migration, overwrite=overwrite)


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


def _check(jobs: list[tuple[str, Path]], migration: ResourceMigration, *, overwrite: bool) -> None:
    from maplab_py.storage.native import is_map_folder

    migration.check()
    for key, folder in jobs:
        if is_map_folder(folder) and not overwrite:
            raise UserError(f"map '{key}': {folder} holds a map already; give --overwrite")


def _plan(
    context: CommandContext,
    jobs: list[tuple[str, Path]],
    migration: ResourceMigration,
    *,
    overwrite: bool,
) -> SavePlan:
    from maplab_py.storage.native import is_map_folder

    _check(jobs, migration, overwrite=overwrite)
    planned = []
    for key, folder in jobs:
        entry = context.maps.get(key)
        vi_map = entry.vi_map
        copies, leaving = _planned_files(vi_map, entry.folder, folder, migration)
        planned.append(
            PlannedSave(
                key,
                folder,
                is_map_folder(folder),
                len(vi_map.missions),
                len(vi_map.vertices),
                len(vi_map.landmarks),
                copies,
                leaving,
            )
        )
    return SavePlan(tuple(planned))


def _planned_files(
    vi_map: VIMap, old_folder: Path | None, folder: Path, migration: ResourceMigration
) -> tuple[int, int]:
    """Count the resource files that would be copied, and those that would be deleted then."""
    moved = migration.move_resources_to_external_folder
    if moved or migration.copy_resources_to_external_folder:
        from maplab_py.storage import resources

        files = len(resources.existing_files(vi_map, old_folder or folder))
        return files, files if moved else 0
    _, copies, leaving = _with_resources(vi_map, old_folder, folder, migration)
    return len(copies), len(leaving)


def _save(
    context: CommandContext,
    jobs: list[tuple[str, Path]],
    migration: ResourceMigration,
    *,
    overwrite: bool,
) -> SavedMaps:
    from maplab_py.storage.native import save_map

    _check(jobs, migration, overwrite=overwrite)
    reports = []
    for done, (key, folder) in enumerate(jobs):
        context.progress.step(done, len(jobs), f"save {key}")
        entry = context.maps.get(key)
        vi_map, files, sources = _with_resources(entry.vi_map, entry.folder, folder, migration)
        reports.append(save_map(vi_map, folder, overwrite=overwrite, resource_files=files))
        if vi_map is not entry.vi_map:
            context.maps.update(entry.with_value(vi_map, "save"))
        context.mark_saved(key, vi_map, folder)
        for source in sources:
            source.unlink(missing_ok=True)
    return SavedMaps(tuple(SavedMap(key, folder) for key, folder in jobs), tuple(reports))


def _with_resources(
    vi_map: VIMap, old_folder: Path | None, folder: Path, migration: ResourceMigration
) -> tuple[VIMap, list[tuple[Path, Path]], list[Path]]:
    """Return the map to save, files to bring into its folder, and files to delete afterwards.

    A map's own resources always come along when it is saved to another folder.
    """
    if not len(vi_map.resources):
        return vi_map, [], []
    from maplab_py.storage import resources

    home = old_folder or folder
    external = (
        migration.copy_resources_to_external_folder or migration.move_resources_to_external_folder
    )
    if external:
        before = [path for path, _ in resources.existing_files(vi_map, home)]
        moved = resources.copied_to_external(vi_map, home, Path(external))
        kept = {path.resolve() for path, _ in resources.existing_files(moved, folder)}
        leaving = [path for path in before if path.resolve() not in kept]
        return moved, [], leaving if migration.move_resources_to_external_folder else []
    to_map = migration.copy_resources_to_map_folder or migration.move_resources_to_map_folder
    own = np.flatnonzero(vi_map.resources.folder == resources.OWN_FOLDER)
    files = resources.existing_files(vi_map, home, None if to_map else own)
    if to_map:
        vi_map = resources.in_map_folder(vi_map)
    inside = (folder / "resources").resolve()
    leaving = [path for path, _ in files if not path.resolve().is_relative_to(inside)]
    return vi_map, files, leaving if migration.move_resources_to_map_folder else []
