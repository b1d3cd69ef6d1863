"""Read and unpack files in another thread, one ahead of the file that is being converted.

Reading and unpacking release Python's lock, so they take place beside the conversion. With more
files ahead there would only be more bytes in memory.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from maplab_py.storage.map_files import read_unpacked


class FilesAhead:
    """The unpacked contents of files, in their order."""

    def __init__(self, pool: ThreadPoolExecutor, paths: Sequence[Path], max_bytes: int) -> None:
        """Start with the first file."""
        self._pool, self._max_bytes = pool, max_bytes
        self._left = iter(paths)
        self._next = self._start()

    def take(self) -> bytes | bytearray:
        """Return the next content and start with the one after it.

        Raises:
            MapError: The file cannot be read; see `map_files.read_unpacked`.
            MemoryError: The file, or the thread that reads the next one, does not fit into memory.
        """
        content = self._next.result()
        self._next = self._start()
        return content

    def _start(self) -> Future[bytes | bytearray]:
        path = next(self._left, None)
        if path is None:
            return Future()
        try:
            return self._pool.submit(read_unpacked, path, self._max_bytes)
        except RuntimeError as error:  # there is no space for the stack of the thread
            raise MemoryError(str(error)) from error


@contextlib.contextmanager
def read_ahead(paths: Sequence[Path], max_bytes: int) -> Iterator[FilesAhead]:
    """Yield the contents of files; none may unpack to more than a bound."""
    with ThreadPoolExecutor(1) as pool:
        yield FilesAhead(pool, paths, max_bytes)
