"""Public entry to native map folders: load and find maps, detect changes by other programs."""

import dataclasses
import time
from pathlib import Path

from maplab_py.atomic import recover
from maplab_py.errors import MapError, os_errors_as
from maplab_py.progress import SILENT, Progress
from maplab_py.storage import checksums, map_loading
from maplab_py.storage.cache.map_cache import MapCache
from maplab_py.storage.map_loading import LoadReport
from maplab_py.storage.map_saving import SaveReport, check_parent, check_target, save_map
from maplab_py.storage.protobuf.map_files import is_map_folder
from maplab_py.vimap import VIMap

__all__ = [
    "DiskCopy",
    "LoadReport",
    "MapCache",
    "SaveReport",
    "check_parent",
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
    cache: MapCache | None = None,
) -> tuple[VIMap, LoadReport]:
    """Load a map; retry if another program replaces it meanwhile. See `map_loading.load_map`.

    With a cache the columns come from there, if the map's files are the same as when they were written,
    else they are written there. A map that is repaired does not use it.

    Raises:
        MapError: A file is missing or damaged, or entities do not fit together; one line that
            names file and field.
    """
    for _ in range(_READINGS):
        before = _identity(folder)
        try:
            result = _loaded(folder, max_size_megabytes, repair, progress, cache)
        except MapError:
            if before is None or before == _identity(folder):
                raise
        else:
            if before is None or before == _identity(folder):
                return result
    raise MapError(f"{folder}: another program keeps replacing this map; try again later")


def _loaded(
    folder: Path,
    max_size_megabytes: int,
    repair: bool,
    progress: Progress,
    cache: MapCache | None,
) -> tuple[VIMap, LoadReport]:
    """Load a map from the cache, if there is one that has it, else from its files."""
    began = time.perf_counter()
    listed = _listing(folder) if cache is not None and not repair else ""
    problem = ""
    if cache is not None and listed:
        cached, problem = cache.find(listed)
        if cached is not None:
            return map_loading.with_small_files(folder, cached, listed, max_size_megabytes, began)
    vi_map, report = map_loading.load_map(
        folder,
        max_size_megabytes=max_size_megabytes,
        repair=repair,
        progress=progress,
        listed=listed,
    )
    notes = [problem] if problem else []
    if cache is not None and listed:
        refusal = cache.store(listed, vi_map, map_loading.facts_of(report))
        if refusal:
            notes.append(refusal)
        else:
            # the columns in memory are given back: those in the file take their place
            cached, _ = cache.find(listed)
            if cached is not None:
                vi_map, _ = map_loading.with_small_files(
                    folder, cached, listed, max_size_megabytes, began
                )
            report = dataclasses.replace(report, cache="written")
    seconds = time.perf_counter() - began
    return vi_map, dataclasses.replace(report, notes=report.notes + notes, seconds=seconds)


def _listing(folder: Path) -> str:
    """Return the checksums of a map's files; an empty text where they cannot be read."""
    recover(folder)
    try:
        return checksums.listing(folder) if is_map_folder(folder) else ""
    except OSError:
        return ""


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
    with os_errors_as(MapError, f"{folder}: cannot be read"):
        below = sorted(folder.iterdir()) if folder.is_dir() else []
    for path in below:
        if path.is_dir() and not path.name.startswith("."):
            folders += find_maps(path)
    return folders
