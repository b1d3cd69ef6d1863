"""Public entry to native map folders: load and find maps, detect changes by other programs."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from maplab_py.atomic import recover
from maplab_py.errors import MapError
from maplab_py.progress import SILENT, Progress
from maplab_py.storage import checksums, map_loading
from maplab_py.storage.map_files import is_map_folder
from maplab_py.storage.map_loading import LoadReport
from maplab_py.storage.map_saving import SaveReport, check_target, save_map
from maplab_py.vimap import VIMap

__all__ = [
    "DiskCopy",
    "LoadReport",
    "SaveReport",
    "check_target",
    "disk_copy",
    "find_maps",
    "is_map_folder",
    "load_map",
    "save_map",
]

_READINGS = 3


@dataclasses.dataclass(frozen=True)
class DiskCopy:
    """State of the files of a map when it was loaded or saved."""

    folder: Path  # absolute, links resolved
    fingerprint: str

    def known_at(self, folder: Path) -> str:
        """Return the fingerprint if this is the copy in `folder`, else an empty text."""
        return self.fingerprint if folder.resolve() == self.folder else ""


def disk_copy(folder: Path) -> DiskCopy:
    """Return the current state of a map folder, without fingerprint if it cannot be read."""
    recover(folder)
    try:
        return DiskCopy(folder.resolve(), checksums.fingerprint(folder))
    except OSError:
        return DiskCopy(folder.resolve(), "")


def load_map(
    folder: Path,
    *,
    max_size_megabytes: int = 2000,
    repair: bool = False,
    progress: Progress = SILENT,
) -> tuple[VIMap, LoadReport]:
    """Load a map; retry if another program replaces it meanwhile. See `map_loading.load_map`.

    Raises:
        MapError: A file is missing or damaged, or entities do not fit together; one line that
            names file and field.
    """
    for _ in range(_READINGS):
        before = _identity(folder)
        try:
            result = map_loading.load_map(
                folder, max_size_megabytes=max_size_megabytes, repair=repair, progress=progress
            )
        except MapError:
            if before is None or before == _identity(folder):
                raise
        else:
            if before is None or before == _identity(folder):
                return result
    raise MapError(f"{folder}: another program keeps replacing this map; try again later")


def _identity(folder: Path) -> tuple[int, int, int] | None:
    """Return an identity that changes when the folder is replaced; None if there is no folder."""
    try:
        status = Path(folder).stat()
    except OSError:
        return None
    return status.st_dev, status.st_ino, status.st_ctime_ns


def find_maps(folder: Path) -> list[Path]:
    """Return the map folders in a folder and below it, sorted by path; maps do not nest.

    Raises:
        MapError: A folder cannot be read.
    """
    folder = Path(folder)
    if is_map_folder(folder):
        return [folder]
    folders: list[Path] = []
    try:
        below = sorted(folder.iterdir()) if folder.is_dir() else []
    except OSError as error:
        raise MapError(f"{folder}: cannot be read ({error.strerror})") from error
    for path in below:
        if path.is_dir() and not path.name.startswith("."):
            folders += find_maps(path)
    return folders
