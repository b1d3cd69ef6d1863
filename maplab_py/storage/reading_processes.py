"""Read files of vertices in other processes, which send their columns back.

Converting messages to columns holds Python's lock, so threads do not help. A process gets the path of a
file on its standard input and answers on its standard output: sizes, a pickle, and the columns as they lie
in memory.
"""

from __future__ import annotations

import contextlib
import gc
import os
import pickle
import queue
import signal
import struct
import subprocess
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import IO, Any

from maplab_py.errors import MapError
from maplab_py.storage.file_parts import FileParts
from maplab_py.storage.protobuf.map_files import FileKind, read_unpacked
from maplab_py.storage.protobuf.scan import MemoryBudget

_WORTH_PROCESSES = 100_000_000
"""Bytes of the files of vertices from which processes save more time than their start takes."""
_MOST_PROCESSES = 8
_LENGTH = struct.Struct("<Q")

Answer = FileParts | MapError | MemoryError | None
"""Content of a file, or why it cannot be read; None = the process that asked has to read it itself."""


class _Reader:
    """One process."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "maplab_py.storage.reading_processes"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        )

    def ask(self, path: Path, max_bytes: int, left: int) -> Answer:
        """Let it read a file; None where it has ended."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        try:
            _send(self._process.stdin, (str(path), max_bytes, left))
            answer: Answer = _receive(self._process.stdout)
        except (OSError, EOFError, pickle.UnpicklingError):
            return None
        return answer

    def end(self) -> None:
        """Kill it."""
        self._process.kill()
        for stream in (self._process.stdin, self._process.stdout):
            assert stream is not None
            with contextlib.suppress(OSError):
                stream.close()
        self._process.wait()


class PartsAhead:
    """The contents of files of vertices, in their order, as processes have read them."""

    def __init__(
        self, pool: ThreadPoolExecutor, readers: queue.Queue[_Reader], paths: Sequence[Path]
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
            return reader.ask(path, budget.max_bytes, budget.left)
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
    readers: list[_Reader] = []
    idle: queue.Queue[_Reader] = queue.Queue()
    pool = ThreadPoolExecutor(count)
    try:
        with contextlib.suppress(OSError):
            for _ in range(count):
                readers.append(_Reader())
                idle.put(readers[-1])
        yield PartsAhead(pool, idle, paths) if readers else None
    finally:
        for reader in readers:
            reader.end()
        pool.shutdown(wait=True, cancel_futures=True)


def _processors() -> int:
    """Return how many processors this process may use: as many as its numeric threads."""
    available = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    limit = os.environ.get("NUMBA_NUM_THREADS", "")
    return min(available or 1, int(limit) if limit.isdigit() else _MOST_PROCESSES)


def _total_bytes(paths: Sequence[Path]) -> int:
    try:
        return sum(path.stat().st_size for path in paths)
    except OSError:  # the reader of that file says what is wrong
        return 0


def _send(stream: IO[bytes], value: Any) -> None:
    """Write a value; columns are written from where they lie."""
    buffers: list[pickle.PickleBuffer] = []
    text = pickle.dumps(value, protocol=5, buffer_callback=buffers.append)
    views = [memoryview(text), *(buffer.raw() for buffer in buffers)]
    stream.write(_LENGTH.pack(len(views)))
    stream.write(b"".join(_LENGTH.pack(view.nbytes) for view in views))
    for view in views:
        stream.write(view)
    stream.flush()


def _receive(stream: IO[bytes]) -> Any:
    """Read what `_send` has written; raises EOFError."""
    (count,) = _LENGTH.unpack(_exactly(stream, _LENGTH.size))
    sizes = _exactly(stream, count * _LENGTH.size)
    text, *buffers = [_exactly(stream, size) for (size,) in _LENGTH.iter_unpack(sizes)]
    return pickle.loads(text, buffers=buffers)


def _exactly(stream: IO[bytes], size: int) -> bytearray:
    data = bytearray(size)
    view, done = memoryview(data), 0
    while done < size:
        count = stream.readinto(view[done:])  # type: ignore[attr-defined]
        if not count:
            raise EOFError
        done += count
    return data


def _read(path: Path, max_bytes: int, left: int) -> Answer:
    """Read a file of nothing but vertices."""
    parts = FileParts()
    try:
        budget = MemoryBudget(max_bytes, left)
        parts.read(FileKind.VERTICES, path, read_unpacked(path, max_bytes), budget)
    except MapError as error:
        return MapError(str(error))
    except MemoryError:
        return MemoryError()
    return None if parts.has_messages else parts


def main() -> None:
    """Answer until nobody asks any more."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process that asked ends this one
    gc.disable()  # there are very many messages and no reference cycles
    requests, answers = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # nothing else may write among the answers
    with contextlib.suppress(EOFError, BrokenPipeError):
        while True:
            path, max_bytes, left = _receive(requests)
            _send(answers, _read(Path(path), max_bytes, left))


if __name__ == "__main__":
    main()
