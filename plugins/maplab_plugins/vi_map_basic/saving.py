"""Saving maps to disk."""

import dataclasses
from pathlib import Path
from typing import Any

from maplab_py.errors import MaplabError
from maplab_py.options import Options
from maplab_py.plugin import CommandContext, Message, Report, UserError, command
from maplab_py.report import view
from maplab_py.storage.protobuf.descriptor_layout import LayoutChoice
from maplab_py.storage.resources.files import ResourceMigration, delete_files


@dataclasses.dataclass(frozen=True)
class SavedMap:
    """One map that was saved."""

    map_key: str
    folder: Path


class SavedMaps(Report):
    """The saved maps, the reports of the writer, and problems."""

    maps: tuple[SavedMap, ...]
    details: tuple[Report, ...]
    problems: tuple[str, ...] = ()

    @property
    def failure(self) -> str:
        """List what failed after the first map was saved."""
        return "; ".join(self.problems)

    def display(self) -> Any:
        """Return one row per map."""
        written = [report.as_dict() for report in self.details]
        lines = [
            view(**vars(saved), files=files["files"], megabytes=files["megabytes"])
            for saved, files in zip(self.maps, written, strict=True)
        ]
        return view({"maps": ""}, maps=lines)


@dataclasses.dataclass(frozen=True)
class PlannedSave:
    """Planned effect of saving one map."""

    map_key: str
    folder: Path
    replaces_a_map: bool
    missions: int
    vertices: int
    landmarks: int
    resources_to_copy: int
    resource_files_to_delete: int


class SavePlan(Report):
    """Planned effect of saving; nothing has been written."""

    maps: tuple[PlannedSave, ...]


class SaveOptions(Options):
    """Files that a save may replace, and the layout of descriptors."""

    overwrite: bool = False
    """Replace another map that is there; not needed for the map's own folder, which it was loaded from or
    last saved to."""
    force: bool = False
    """Replace the map that is there even if another program has changed it since this one was loaded or
    saved."""
    repair: bool = False
    """Drop what is no number, in memory too, instead of refusing to save a map that could not be loaded."""
    descriptor_layout: LayoutChoice = "as_loaded"
    """Layout of the descriptors: as_loaded (every frame as it was loaded, new frames as 2.2), 2.2 (maplab
    since 2021), legacy (maplab before 2021; binary descriptors only)"""


@command(
    "save",
    example="save --map_folder=maps/merged",
    see_also=("save_all",),
    guards_effects=True,
    obeys_dry_run=True,
)
def save(
    context: CommandContext,
    map_folder: Path | None = None,
    *,
    options: SaveOptions = SaveOptions(),
    migration: ResourceMigration = ResourceMigration(),
) -> SavedMaps | SavePlan:
    """Save the selected map; the folder's old content stays until the new one is complete.

    A map is saved back to its own folder, unless another program has changed the files meanwhile.
    Another map is replaced only by `--overwrite`.

    Args:
        map_folder: Destination; empty = the folder that the map was loaded from or last saved to.
    """
    folder = map_folder or context.map_folder
    if folder is None:
        raise UserError(f"save: map '{context.map_key}' has no folder yet; give --map_folder=...")
    jobs = [(context.map_key, folder)]
    if context.is_trial:
        return _plan(context, jobs, migration, options)
    return _save(context, jobs, migration, options)


@command(
    "save_all",
    example="save_all --maps_folder=results",
    needs_map=False,
    guards_effects=True,
    obeys_dry_run=True,
)
def save_all(
    context: CommandContext,
    maps_folder: Path | None = None,
    *,
    options: SaveOptions = SaveOptions(),
    migration: ResourceMigration = ResourceMigration(),
) -> SavedMaps | SavePlan:
    """Save all maps in memory.

    Args:
        maps_folder: Folder that gets one sub-folder per map, named after its key; empty = each
            map's own folder.
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
    if context.is_trial:
        return _plan(context, jobs, migration, options)
    return _save(context, jobs, migration, options)


@command("get_map_folder")
def get_map_folder(context: CommandContext) -> Message:
    """Show the folder that the selected map was loaded from or last saved to."""
    return Message(str(context.map_folder) if context.map_folder else "the map has no folder yet")


@command("set_map_folder", example="set_map_folder maps/merged")
def set_map_folder(context: CommandContext, map_folder: Path) -> Message:
    """Choose the folder that `save` writes the selected map to.

    Args:
        map_folder: The folder; it need not exist.
    """
    entry = context.maps.selected
    saved = entry.saved if entry.known_at(map_folder) else None
    context.maps.update(dataclasses.replace(entry, folder=map_folder, saved=saved))
    return Message(f"map '{entry.key}' will be saved to {map_folder}")


def _check(
    context: CommandContext,
    jobs: list[tuple[str, Path]],
    migration: ResourceMigration,
    options: SaveOptions,
) -> None:
    from maplab_py.storage.native import check_target
    from maplab_py.storage.protobuf.descriptor_layout import with_layout

    migration.check()
    for key, folder in jobs:
        known = context.maps.get(key).known_at(folder)
        try:
            check_target(folder, overwrite=options.overwrite, known=known, force=options.force)
        except UserError as error:
            raise UserError(f"map '{key}': {error}") from None
        with_layout(context.maps.get(key).vi_map, options.descriptor_layout)


def _plan(
    context: CommandContext,
    jobs: list[tuple[str, Path]],
    migration: ResourceMigration,
    options: SaveOptions,
) -> SavePlan:
    from maplab_py.storage.native import is_map_folder

    _check(context, jobs, migration, options)
    planned = []
    for key, folder in jobs:
        entry = context.maps.get(key)
        vi_map = entry.vi_map
        copies, leaving = migration.count_files(vi_map, entry.folder, folder)
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


def _save(
    context: CommandContext,
    jobs: list[tuple[str, Path]],
    migration: ResourceMigration,
    options: SaveOptions,
) -> SavedMaps:
    _check(context, jobs, migration, options)
    saved: list[SavedMap] = []
    details: list[Report] = []
    problems: list[str] = []
    for done, (key, folder) in enumerate(jobs):
        try:
            context.progress.step(done, len(jobs), f"save {key}")
            report, leaving = _save_map(context, key, folder, migration, options)
        except MaplabError as error:
            if not saved:
                raise
            left = ", ".join(key for key, _ in jobs[done:])
            problems.append(f"not saved: {left} ({error})")
            break
        saved.append(SavedMap(key, folder))
        details.append(report)
        problems += delete_files(leaving)
    return SavedMaps(tuple(saved), tuple(details), tuple(problems))


def _save_map(
    context: CommandContext,
    key: str,
    folder: Path,
    migration: ResourceMigration,
    options: SaveOptions,
) -> tuple[Report, list[Path]]:
    """Save one map; return the writer's report and the resource files to delete now."""
    from maplab_py.storage.native import DiskCopy, save_map
    from maplab_py.vimap.number_repair import without_bad_numbers

    entry = context.maps.get(key)
    repaired, notes = without_bad_numbers(entry.vi_map) if options.repair else (entry.vi_map, [])
    vi_map, files, leaving = migration.prepare(repaired, entry.folder, folder)
    report = save_map(
        vi_map,
        folder,
        overwrite=options.overwrite,
        known=entry.known_at(folder),
        force=options.force,
        descriptor_layout=options.descriptor_layout,
        resource_files=files,
        progress=context.progress,
    )
    context.maps.update(entry.with_value(vi_map, "save"))
    context.mark_saved(key, folder, DiskCopy(folder.resolve(), report.fingerprint))
    return dataclasses.replace(report, notes=tuple(notes)), leaving
