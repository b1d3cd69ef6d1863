"""Where resource files go when a map is saved."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from maplab_py.cancellation import lasting_effect
from maplab_py.errors import UserError
from maplab_py.options import option
from maplab_py.storage.resources import (
    MAP_FOLDER,
    copied_to_external,
    existing_files,
    in_map_folder,
)
from maplab_py.vimap import VIMap


@dataclasses.dataclass(frozen=True)
class ResourceMigration:
    """Where resource files are stored when a map is saved; at most one option is given."""

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
        """Refuse contradicting options."""
        given = [field.name for field in dataclasses.fields(self) if getattr(self, field.name)]
        if len(given) > 1:
            raise UserError(f"save: give only one of {', '.join(f'--{name}' for name in given)}")

    def count_files(self, vi_map: VIMap, old_folder: Path | None, folder: Path) -> tuple[int, int]:
        """Count the resource files to copy, and those to delete afterwards; nothing is written."""
        moved = self.move_resources_to_external_folder
        if moved or self.copy_resources_to_external_folder:
            files = len(existing_files(vi_map, old_folder or folder))
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
            before = [path for path, _ in existing_files(vi_map, home)]
            moved = copied_to_external(vi_map, home, Path(external))
            kept = {path.resolve() for path, _ in existing_files(moved, folder)}
            leaving = [path for path in before if path.resolve() not in kept]
            return moved, [], leaving if self.move_resources_to_external_folder else []
        to_map = self.copy_resources_to_map_folder or self.move_resources_to_map_folder
        in_folder = np.flatnonzero(vi_map.resources.folder == MAP_FOLDER)
        files = existing_files(vi_map, home, None if to_map else in_folder)
        if to_map:
            vi_map = in_map_folder(vi_map)
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
