"""Resource files of a map: paths, cached loading, copying."""

import dataclasses
import shutil
import threading
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maplab_py.atomic import replaced_file
from maplab_py.errors import MapError, os_errors_as
from maplab_py.storage.resources.types import resource_type
from maplab_py.vimap import VIMap, to_hex

MAP_FOLDER = -1
_IMAGE_SUFFIXES = (".pgm", ".ppm")


def resource_path(vi_map: VIMap, row: int, map_folder: Path) -> Path:
    """Return the path of the file of a resource (row).

    Raises:
        MapError: Its type or its folder does not exist in the map.
    """
    table, metadata = vi_map.resources, vi_map.metadata
    index = int(table.folder[row])
    if index == MAP_FOLDER:
        root = map_folder / (metadata.map_resource_folder or "resources")
    elif 0 <= index < len(metadata.external_resource_folders):
        root = Path(metadata.external_resource_folders[index])
    else:
        raise MapError(
            f"resource {to_hex(table.id[row])} is in folder {index}, which is not listed"
        )
    return root / relative_path(vi_map, row)


def relative_path(vi_map: VIMap, row: int) -> Path:
    """Return <type name>/<id><suffix> of a resource (row)."""
    table = vi_map.resources
    kind = resource_type(int(table.type[row]))
    return Path(kind.name) / f"{to_hex(table.id[row])}{kind.suffix}"


class ResourceStore:
    """Loads resources of a map on demand; the cache of the process keeps those used last."""

    def __init__(self, vi_map: VIMap, map_folder: Path) -> None:
        """Serve the resources of a map that was loaded from `map_folder`."""
        self._map, self._folder = vi_map, Path(map_folder)

    def load(self, row: int) -> Any:
        """Return a resource: an image (H, W[, 3] BGR), a text, or the file's bytes.

        Raises:
            MapError: The file is missing or cannot be decoded.
        """
        path = resource_path(self._map, row, self._folder)
        return SHARED_CACHE.load(path, int(self._map.resources.type[row]), _read)


def _read(path: Path) -> tuple[Any, int]:
    with os_errors_as(MapError, f"{path}: the resource cannot be read"):
        data = path.read_bytes()
    if path.suffix in _IMAGE_SUFFIXES:
        import cv2

        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
        if image is None:
            raise MapError(f"{path}: the resource is not an image")
        image.flags.writeable = False
        return image, int(image.nbytes)
    if path.suffix == ".txt":
        return data.decode("utf-8", errors="replace"), len(data)
    return data, len(data)


def existing_files(
    vi_map: VIMap, map_folder: Path, rows: NDArray[np.int64] | None = None
) -> list[tuple[Path, Path]]:
    """Return (file, path relative to a resource folder) of resources (rows, None = all).

    Raises:
        MapError: A file is missing.
    """
    every = np.arange(len(vi_map.resources)) if rows is None else rows
    files = {}
    for row in every.tolist():
        path = resource_path(vi_map, row, map_folder)
        if not path.is_file():
            raise MapError(f"{path}: the resource's file is missing")
        files[relative_path(vi_map, row)] = path
    return [(path, relative) for relative, path in sorted(files.items())]


def in_map_folder(vi_map: VIMap) -> VIMap:
    """Return the map with all resources in its own folder (the files must follow)."""
    table = vi_map.resources
    metadata = dataclasses.replace(vi_map.metadata, map_resource_folder="./resources/")
    folder = np.full(len(table), MAP_FOLDER, dtype=np.int32)
    return vi_map.replace(resources=table.replace(folder=folder), metadata=metadata)


def copied_to_external(vi_map: VIMap, map_folder: Path | None, target: Path) -> VIMap:
    """Copy all resource files to a folder outside the map; return the map that refers to them.

    Raises:
        UserError: The folder cannot be written.
        MapError: A file is missing.
    """
    target = Path(target).absolute()
    for source, relative in existing_files(vi_map, map_folder or Path()):
        destination = target / relative
        if destination.exists() and destination.samefile(source):
            continue
        with replaced_file(destination) as copy, source.open("rb") as original:
            shutil.copyfileobj(original, copy)
    known = vi_map.metadata.external_resource_folders
    folders = known if str(target) in known else (*known, str(target))
    index = folders.index(str(target))
    folder = np.full(len(vi_map.resources), index, dtype=np.int32)
    return vi_map.replace(
        resources=vi_map.resources.replace(folder=folder),
        metadata=dataclasses.replace(vi_map.metadata, external_resource_folders=folders),
    )


_MAX_BYTES = 512_000_000


@dataclasses.dataclass(frozen=True)
class CacheStatistics:
    """Hits, misses and size of the cache."""

    hits: int
    misses: int
    entries: int
    bytes: int


@dataclasses.dataclass
class _Entry:
    value: Any
    size_bytes: int
    kind: int
    state: tuple[int, int]  # of the file: time of its last change [ns], size [bytes]


class ResourceCache:
    """Keeps the most recently used resources; several threads may use it.

    A file that has changed on disk is read again.
    """

    def __init__(self, max_bytes: int = _MAX_BYTES) -> None:
        """Keep no more than `max_bytes` of decoded content."""
        self._max_bytes = max_bytes
        self._entries: OrderedDict[Path, _Entry] = OrderedDict()
        self._bytes = 0
        self._counts: dict[int, list[int]] = {}  # hits and misses by type
        self._lock = threading.Lock()

    def load(self, path: Path, kind: int, read: Callable[[Path], tuple[Any, int]]) -> Any:
        """Return the content of a file.

        Args:
            kind: Number of its resource type.
            read: Reads the file; returns the content and its size in memory [bytes].

        Raises:
            MapError: The file cannot be read.
        """
        with os_errors_as(MapError, f"{path}: the resource cannot be read"):
            status = path.stat()
        state = status.st_mtime_ns, status.st_size
        with self._lock:
            counts = self._counts.setdefault(kind, [0, 0])
            entry = self._entries.get(path)
            if entry is not None and entry.state == state:
                counts[0] += 1
                self._entries.move_to_end(path)
                return entry.value
            counts[1] += 1
        value, size_bytes = read(path)
        with self._lock:
            self._keep(path, _Entry(value, size_bytes, kind, state))
        return value

    def statistics(self, kind: int | None = None) -> CacheStatistics:
        """Return the counts of a resource type (number), None = of all."""
        with self._lock:
            counts = [c for number, c in self._counts.items() if kind in (None, number)]
            sizes = [e.size_bytes for e in self._entries.values() if kind in (None, e.kind)]
        hits, misses = (sum(count[column] for count in counts) for column in range(2))
        return CacheStatistics(hits, misses, len(sizes), sum(sizes))

    def kinds(self) -> list[int]:
        """Return the resource types (numbers) that have been asked for, in ascending order."""
        with self._lock:
            return sorted(self._counts)

    def _keep(self, path: Path, entry: _Entry) -> None:
        former = self._entries.pop(path, None)
        self._bytes -= former.size_bytes if former is not None else 0
        if entry.size_bytes > self._max_bytes:
            return
        self._entries[path] = entry
        self._bytes += entry.size_bytes
        while self._bytes > self._max_bytes:
            _, dropped = self._entries.popitem(last=False)
            self._bytes -= dropped.size_bytes


SHARED_CACHE = ResourceCache()
"""The cache of all resource stores of the process."""
