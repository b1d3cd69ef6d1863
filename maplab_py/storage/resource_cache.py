"""The cache of resource files: one for the process, bounded in bytes, with counts by type."""

from __future__ import annotations

import dataclasses
import threading
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

from maplab_py.errors import MapError

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
            path: File.
            kind: Number of its resource type.
            read: Reads the file; returns the content and its size in memory [bytes].

        Raises:
            MapError: The file cannot be read.
        """
        try:
            status = path.stat()
        except OSError as error:
            raise MapError(f"{path}: the resource cannot be read ({error.strerror})") from error
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
