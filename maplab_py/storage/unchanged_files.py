"""Files of a map that were written before and still say the same: a later save takes them over.

A file is known by the digest of what it says. The new folder gets a hard link to it, or a copy where
links are refused. Files of maps are replaced and never changed in place, so older folders and
backups that share a file keep it. A file that another program has changed is written again.
"""

import contextlib
import dataclasses
from pathlib import Path

from maplab_py.atomic import link_or_copy
from maplab_py.storage import checksums
from maplab_py.storage.protobuf.file_contents import ColumnDigests, FileContent
from maplab_py.storage.protobuf.tables_to_messages import Partition

STABLE = Partition(vertices=50, edges=200, is_stable=True)
"""Few files change when a mission grows or a part of a map is optimised."""
_COMPRESSED, _STORED = b"compressed", b"stored"


@dataclasses.dataclass(frozen=True)
class _File:
    path: Path
    sha256: str
    state: tuple[int, int, int]


class WrittenFiles:
    """Content of the files of a folder when it was saved last."""

    def __init__(self, partition: Partition = STABLE) -> None:
        """Start without files: the first save writes all."""
        self.partition = partition  # which entities come into one file
        self.reused = 0  # how many files the last save took over
        self.measurements = ColumnDigests()  # digests of the measurements in them
        self._files: dict[bytes, _File] = {}

    def find(self, key: bytes) -> _File | None:
        """Return the file of a key, unless it has been changed or deleted."""
        file = self._files.get(key)
        return file if file is not None and _state(file.path) == file.state else None

    def replace(self, files: dict[bytes, _File], reused: int, measurements: ColumnDigests) -> None:
        """Remember the files of a new folder instead."""
        self._files, self.reused, self.measurements = files, reused, measurements


class TakenOver:
    """The files of one save."""

    def __init__(self, before: WrittenFiles, folder: Path, *, compress: bool) -> None:
        """Write to a folder what `before` does not have.

        Without `compress`, files that were compressed before are taken over as well.
        """
        self.partition = before.partition  # which entities come into one file
        # SHA-256 of the files (paths in the folder) that were taken over
        self.checksums: dict[str, str] = {}
        self.linked: set[Path] = set()  # those that are links, so that their content is on disk
        self._measurements = ColumnDigests(before.measurements)
        self._before, self._folder = before, folder
        self._packings = (_COMPRESSED,) if compress else (_STORED, _COMPRESSED)
        self._names: dict[bytes, str] = {}

    def take_over(self, content: FileContent, name: str) -> bool:
        """Bring an equal file to a path in the folder; False where there is none."""
        digest = content.digest(self._measurements)
        for packing in self._packings:
            file = self._before.find(digest + packing)
            if file is None:
                continue
            with contextlib.suppress(FileNotFoundError):  # deleted just now
                if link_or_copy(file.path, self._folder / name):
                    self.linked.add(self._folder / name)
                self.checksums[name] = file.sha256
                self._names[digest + packing] = name
                return True
        self._names[digest + self._packings[0]] = name
        return False

    def finish(self, target: Path, listed: str) -> None:
        """Remember the files where they are now.

        Args:
            target: The folder after its renaming.
            listed: Checksums of its files (`checksums.listing`).
        """
        digests = checksums.digests_of(listed)
        files = {}
        for key, name in self._names.items():
            state = _state(target / name)
            if state is not None:
                files[key] = _File(target / name, digests[name], state)
        self._before.replace(files, len(self.checksums), self._measurements)


def _state(path: Path) -> tuple[int, int, int] | None:
    """Return inode, size and time of change of a file; None where it cannot be seen."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_ino, status.st_size, status.st_mtime_ns
