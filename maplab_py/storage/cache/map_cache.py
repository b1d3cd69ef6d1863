"""The cache of loaded maps: their columns in files of the user's cache folder, by content.

The name of an entry is the hash of the checksums of all files of a map, so a changed map has another
entry and a copy of a map has the same one. An entry that cannot be used is written again, never trusted.
"""

import contextlib
import dataclasses
import functools
import hashlib
import os
import shutil
import time
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from maplab_py.errors import MaplabError
from maplab_py.kernel_cache import cache_root, check_trusted
from maplab_py.storage.cache import column_file, options
from maplab_py.vimap import VIMap

_SUFFIX = ".columns"
_FOLDER = "maps"
_GB = 1e9


@dataclasses.dataclass(frozen=True)
class CachedMap:
    """A map from the cache, with what was noted when its files were read."""

    vi_map: VIMap  # tables only
    facts: dict[str, Any]


@dataclasses.dataclass(frozen=True)
class CacheUse:
    """Content of the cache."""

    maps: int
    bytes: int


@functools.cache
def program_version() -> str:
    """Return the version of maplab-py that is installed."""
    try:
        return version("maplab-py")
    except PackageNotFoundError:  # imported from a checkout that is not installed
        return "unknown"


class MapCache:
    """Entries of one folder."""

    def __init__(
        self, max_gb: float = options.CacheOptions().map_cache_max_gb, folder: Path | None = None
    ) -> None:
        """Use a folder, that of the user when none is given, up to a size."""
        self.folder = cache_root() / _FOLDER if folder is None else folder
        self._max_bytes = max_gb * _GB

    def find(self, listing: str) -> tuple[CachedMap | None, str]:
        """Return the entry of a map, and why there is one that cannot be used.

        Args:
            listing: Checksums of the map's files (`checksums.listing`).
        """
        path = self._path(listing)
        if not path.is_file():
            return None, ""
        try:
            self._check(path)
            vi_map, facts = column_file.read_columns(path, self._facts(listing))
        except (column_file.UnusableColumns, MaplabError) as error:
            return None, f"the cached columns were not used: {error}"
        except (OSError, ValueError, KeyError) as error:
            return None, f"the cached columns were not used: {path} cannot be read ({error})"
        status = path.stat()
        with contextlib.suppress(OSError):
            os.utime(path, ns=(time.time_ns(), status.st_mtime_ns))  # the last use
        return CachedMap(vi_map, facts), ""

    def store(self, listing: str, vi_map: VIMap, facts: dict[str, Any]) -> str:
        """Write an entry and delete old ones beyond the size; return why that was not possible."""
        needed = vi_map.nbytes()
        if needed > self._max_bytes:
            return (
                f"not kept in the cache: {needed / _GB:.2f} GB are more than "
                f"--map_cache_max_gb={self._max_bytes / _GB:g}"
            )
        try:
            self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            self._check(self.folder)
            self._make_room(needed)
            free = shutil.disk_usage(self.folder).free
            if needed > free:
                return (
                    f"not kept in the cache: {self.folder} has {free / _GB:.2f} GB left, "
                    f"{needed / _GB:.2f} GB are needed"
                )
            column_file.write_columns(self._path(listing), vi_map, self._facts(listing) | facts)
        except OSError as error:
            return f"not kept in the cache: {self.folder} cannot be written ({error.strerror})"
        except MaplabError as error:
            return f"not kept in the cache: {error}"
        return ""

    def use(self) -> CacheUse:
        """Return what the cache holds."""
        sizes = [status.st_size for _, status in self._entries()]
        return CacheUse(len(sizes), sum(sizes))

    def _path(self, listing: str) -> Path:
        return self.folder / (hashlib.sha256(listing.encode()).hexdigest() + _SUFFIX)

    @staticmethod
    def _facts(listing: str) -> dict[str, Any]:
        return {
            "map": hashlib.sha256(listing.encode()).hexdigest(),
            "version of maplab-py": program_version(),
        }

    def _check(self, path: Path) -> None:
        """Refuse what other users own or may write to.

        Raises:
            UserError: They do.
        """
        check_trusted(path, "columns of maps", "they would be used unchecked")

    def _entries(self) -> list[tuple[Path, os.stat_result]]:
        """Return all entries, those used longest ago first."""
        try:
            entries = [(path, path.stat()) for path in self.folder.glob(f"*{_SUFFIX}")]
        except OSError:
            return []
        return sorted(entries, key=lambda entry: (entry[1].st_atime_ns, entry[0].name))

    def _make_room(self, needed: float) -> None:
        entries = self._entries()
        total = sum(status.st_size for _, status in entries) + needed
        for path, status in entries:
            if total <= self._max_bytes:
                return
            with contextlib.suppress(OSError):  # where a mapped file cannot be deleted
                path.unlink()
                total -= status.st_size
