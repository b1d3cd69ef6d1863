"""The resource files of a map on disk: which are missing, which nothing refers to, equal folders."""

import dataclasses
import os
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from maplab_py.cancellation import check_cancelled, lasting_effect
from maplab_py.errors import UserError
from maplab_py.options import Options
from maplab_py.storage.resources import store
from maplab_py.vimap import VIMap, consistency

_LISTED = 5
"""Files that one violation names."""


def resource_folder(vi_map: VIMap, map_folder: Path) -> Path:
    """Return the resource folder inside the map folder."""
    return map_folder / (vi_map.metadata.map_resource_folder or "resources")


def missing_files(vi_map: VIMap, map_folder: Path | None) -> list[Path]:
    """Return the files of resources that are not there; relative where the map has no folder."""
    missing = [path for path in _paths(vi_map, map_folder) if not path.is_file()]
    if map_folder is None:
        rows = np.flatnonzero(vi_map.resources.folder == store.MAP_FOLDER)
        missing += [store.relative_path(vi_map, row) for row in rows.tolist()]
    return missing


def _paths(vi_map: VIMap, map_folder: Path | None) -> Iterator[Path]:
    """Yield the files of resources in listed folders.

    Those in the map's own folder are left out where the map has none.
    """
    listed = len(vi_map.metadata.external_resource_folders)
    for row, folder in enumerate(vi_map.resources.folder.tolist()):
        if 0 <= folder < listed or (folder == store.MAP_FOLDER and map_folder is not None):
            yield store.resource_path(vi_map, row, map_folder or Path())


def orphaned_files(maps: Iterable[VIMap], home: VIMap, map_folder: Path | None) -> list[Path]:
    """Return the files in a map's own resource folder that no resource of some maps refers to.

    External folders are left out, because maps that are not loaded may use them.

    Args:
        maps: Maps that may refer to files in the folder, beside `home`.
        home: The map that was loaded from the folder, or saved to it.
        map_folder: The map folder; None = the map has none.

    Raises:
        MapError: A resource is of an unknown type.
    """
    if map_folder is None:
        return []
    root = resource_folder(home, map_folder)
    present = {
        Path(os.path.realpath(folder)) / name
        for folder, _, names in os.walk(root)
        for name in names
    }
    if not present:
        return []
    for vi_map in (home, *maps):
        for path in _paths(vi_map, map_folder if vi_map is home else None):
            present.discard(Path(os.path.realpath(path.parent)) / path.name)
    return sorted(present)


def with_file_checks(
    report: consistency.ConsistencyReport, vi_map: VIMap, map_folder: Path | None
) -> consistency.ConsistencyReport:
    """Add missing files to the errors of a consistency check, and orphaned ones to the warnings."""
    missing = missing_files(vi_map, map_folder)
    errors = [*report.errors, *_violation("resource whose file is missing", missing)]
    rule = "file in the map's resource folder that no resource refers to"
    warnings = [*report.warnings, *_violation(rule, orphaned_files((), vi_map, map_folder))]
    return consistency.ConsistencyReport(tuple(errors), tuple(warnings))


def _violation(rule: str, files: list[Path]) -> list[consistency.Violation]:
    if not files:
        return []
    return [consistency.Violation(rule, len(files), tuple(str(file) for file in files[:_LISTED]))]


def with_merged_folders(vi_map: VIMap, map_folder: Path | None) -> tuple[VIMap, list[str]]:
    """Merge external resource folders that are the same folder under several names.

    A folder that is the map's own resource folder becomes the map's own.

    Returns:
        The map, and the names that were merged into another.
    """
    metadata = vi_map.metadata
    known: dict[str, int] = {}
    if map_folder is not None:
        known[os.path.realpath(resource_folder(vi_map, map_folder))] = store.MAP_FOLDER
    kept: list[str] = []
    merged: list[str] = []
    place = []
    for name in metadata.external_resource_folders:
        path = os.path.realpath(name)
        if path in known:
            merged.append(name)
        else:
            known[path] = len(kept)
            kept.append(name)
        place.append(known[path])
    if not merged:
        return vi_map, []
    table = vi_map.resources
    column = np.array([*place, store.MAP_FOLDER], dtype=np.int32)
    in_use = metadata.resource_folder_in_use
    metadata = dataclasses.replace(
        metadata,
        external_resource_folders=tuple(kept),
        resource_folder_in_use=place[in_use] if 0 <= in_use < len(place) else in_use,
    )
    inside = (table.folder >= store.MAP_FOLDER) & (table.folder < len(place))
    folder = np.where(
        inside, column[np.where(inside, table.folder, store.MAP_FOLDER)], table.folder
    )
    table = table.replace(folder=folder.astype(np.int32))
    return vi_map.replace(resources=table, metadata=metadata), merged


def remove_files(files: Iterable[Path]) -> tuple[int, list[str]]:
    """Delete files; return their number and a line for each that cannot be deleted.

    Raises:
        Cancelled: The user wants to stop; files that are deleted stay deleted.
    """
    removed, problems = 0, []
    for file in files:
        check_cancelled()
        try:
            with lasting_effect():
                file.unlink(missing_ok=True)
            removed += 1
        except OSError as error:
            problems.append(f"{file} cannot be deleted ({error.strerror})")
    return removed, problems


class ResourceMigration(Options):
    """Place of resource files when a map is saved; at most one option is given."""

    copy_resources_to_map_folder: bool = False
    """Copy all resources into the map's folder."""
    move_resources_to_map_folder: bool = False
    """Move all resources into the map's folder."""
    copy_resources_to_external_folder: str = ""
    """Copy all resources to this folder and refer to it."""
    move_resources_to_external_folder: str = ""
    """Move all resources to this folder and refer to it."""

    def check(self) -> None:
        """Refuse contradicting options."""
        given = [field.name for field in dataclasses.fields(self) if getattr(self, field.name)]
        if len(given) > 1:
            raise UserError(f"save: give only one of {', '.join(f'--{name}' for name in given)}")

    def count_files(self, vi_map: VIMap, old_folder: Path | None, folder: Path) -> tuple[int, int]:
        """Count the resource files to copy, and those to delete afterwards; nothing is written."""
        moved = self.move_resources_to_external_folder
        if moved or self.copy_resources_to_external_folder:
            files = len(store.existing_files(vi_map, old_folder or folder))
            return files, files if moved else 0
        _, copies, leaving = self.prepare(vi_map, old_folder, folder)
        return len(copies), len(leaving)

    def prepare(
        self, vi_map: VIMap, old_folder: Path | None, folder: Path
    ) -> tuple[VIMap, list[tuple[Path, Path]], list[Path]]:
        """Copy files to an external folder if that is asked for; return what is left to do.

        Resources inside the map folder are always copied when it is saved to another folder.

        Returns:
            The map to save, files to copy into its folder (source and relative target), and files
            to delete afterwards.
        """
        if not len(vi_map.resources):
            return vi_map, [], []
        home = old_folder or folder
        external = self.copy_resources_to_external_folder or self.move_resources_to_external_folder
        if external:
            before = [path for path, _ in store.existing_files(vi_map, home)]
            moved = store.copied_to_external(vi_map, home, Path(external))
            kept = {path.resolve() for path, _ in store.existing_files(moved, folder)}
            leaving = [path for path in before if path.resolve() not in kept]
            return moved, [], leaving if self.move_resources_to_external_folder else []
        to_map = self.copy_resources_to_map_folder or self.move_resources_to_map_folder
        in_folder = np.flatnonzero(vi_map.resources.folder == store.MAP_FOLDER)
        files = store.existing_files(vi_map, home, None if to_map else in_folder)
        if to_map:
            vi_map = store.in_map_folder(vi_map)
        inside = (folder / "resources").resolve()
        leaving = [path for path, _ in files if not path.resolve().is_relative_to(inside)]
        return vi_map, files, leaving if self.move_resources_to_map_folder else []


def delete_files(files: Iterable[Path]) -> list[str]:
    """Delete resource files that have been moved; return the problems."""
    problems = []
    for file in files:
        try:
            with lasting_effect():
                file.unlink(missing_ok=True)
        except OSError as error:
            problems.append(f"{file} is copied but cannot be deleted ({error.strerror})")
    return problems
