"""Read files of vertices in other processes, which send their columns back.

Converting messages to columns holds Python's lock, so threads do not help.
"""

import contextlib
import gc
import os
import queue
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from maplab_py.child_processes import Service, ServiceEnded, processors, serve
from maplab_py.errors import MapError
from maplab_py.storage.file_assembly import FileParts
from maplab_py.storage.protobuf.map_files import FileKind, read_unpacked
from maplab_py.storage.protobuf.scan import MemoryBudget

_WORTH_PROCESSES = 100_000_000
"""Bytes of the files of vertices from which processes save more time than their start takes."""
_MOST_PROCESSES = 8

Answer = FileParts | MapError | MemoryError | None
"""Content of a file, or why it cannot be read; None = the process that asked has to read it itself."""


class PartsAhead:
    """The contents of files of vertices, in their order, as processes have read them."""

    def __init__(
        self, pool: ThreadPoolExecutor, readers: queue.Queue[Service], paths: Sequence[Path]
    ) -> None:
        """Prepare; `start` begins."""
        self._pool, self._readers, self._paths = pool, readers, paths
        self._answers: dict[Path, Future[Answer]] = {}

    def start(self, budget: MemoryBudget) -> None:
        """Let the processes read all files."""
        self._answers = {path: self._pool.submit(self._ask, path, budget) for path in self._paths}

    def take(self, path: Path) -> FileParts | None:
        """Return what a file holds; None where this process has to read it.

        Raises:
            MapError: The file is damaged, or needs more memory than is left.
            MemoryError: It does not fit into memory.
        """
        future = self._answers.pop(path, None)
        answer = future.result() if future is not None else None
        if isinstance(answer, Exception):
            raise answer
        return answer

    def _ask(self, path: Path, budget: MemoryBudget) -> Answer:
        reader = self._readers.get()
        try:
            answer: Answer = reader.ask((path, budget.max_bytes, budget.left))
            return answer
        except ServiceEnded:
            return None
        finally:
            self._readers.put(reader)


@contextlib.contextmanager
def parts_ahead(files: Sequence[tuple[FileKind, Path]]) -> Iterator[PartsAhead | None]:
    """Yield what processes read; None where they would not save time, or cannot be started."""
    paths = [path for kind, path in files if kind is FileKind.VERTICES]
    count = min(_processors(), _MOST_PROCESSES, len(paths))
    if count < 2 or _total_bytes(paths) < _WORTH_PROCESSES:
        yield None
        return
    readers: list[Service] = []
    idle: queue.Queue[Service] = queue.Queue()
    pool = ThreadPoolExecutor(count)
    try:
        with contextlib.suppress(OSError):
            for _ in range(count):
                readers.append(Service("maplab_py.storage.reading_processes"))
                idle.put(readers[-1])
        yield PartsAhead(pool, idle, paths) if readers else None
    finally:
        for reader in readers:
            reader.end()
        pool.shutdown(wait=True, cancel_futures=True)


def _processors() -> int:
    """Return how many processors this process may use: as many as its numeric threads."""
    limit = os.environ.get("NUMBA_NUM_THREADS", "")
    return min(processors(), int(limit) if limit.isdigit() else _MOST_PROCESSES)


def _total_bytes(paths: Sequence[Path]) -> int:
    try:
        return sum(path.stat().st_size for path in paths)
    except OSError:  # the reader of that file says what is wrong
        return 0


def _read(request: tuple[Path, int, int]) -> Answer:
    """Read a file of nothing but vertices."""
    path, max_bytes, left = request
    parts = FileParts()
    try:
        budget = MemoryBudget(max_bytes, left)
        parts.read(FileKind.VERTICES, path, read_unpacked(path, max_bytes), budget)
    except MapError as error:
        return MapError(str(error))
    except MemoryError:
        return MemoryError()
    return None if parts.has_messages else parts


if __name__ == "__main__":
    gc.disable()  # there are very many messages and no reference cycles
    serve(_read)
