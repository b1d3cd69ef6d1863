"""Native map folders: load, save, find."""

from __future__ import annotations

from pathlib import Path

from maplab_py.storage.files import is_map_folder
from maplab_py.storage.loading import LoadReport, load_map
from maplab_py.storage.saving import SaveReport, save_map

__all__ = ["LoadReport", "SaveReport", "find_maps", "is_map_folder", "load_map", "save_map"]


def find_maps(folder: Path) -> list[Path]:
    """Return the map folders in a folder and below it, sorted by path; maps do not nest."""
    folder = Path(folder)
    if is_map_folder(folder):
        return [folder]
    found: list[Path] = []
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        if path.is_dir() and not path.name.startswith("."):
            found += find_maps(path)
    return found
