"""Child processes: leaders of groups of their own, with few threads, that end with this process.

A `Service` is a child that answers requests; both sides are pickled, and arrays travel as they lie in memory.
`in_order` works in threads of this process.
"""

import contextlib
import os
import pickle
import select
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from typing import Any, TypeVar

from maplab_py.errors import Cancelled

_Item = TypeVar("_Item")
_Value = TypeVar("_Value")
_PARENT_VARIABLE = "MAPLAB_ENDS_WITH_PROCESS"
"""Process whose end ends this one."""
_THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "NUMBA_NUM_THREADS",
)
SECONDS_BETWEEN_LOOKS = 0.1
_SECONDS_TO_END = 10.0
"""Time that a child gets to end after its connection has broken."""


def start(
    words: Sequence[str], *, threads: int = 0, path: str = "", **streams: Any
) -> subprocess.Popen[bytes]:
    """Start a program in a group of its own; Ctrl-C in the terminal is not meant for it.

    Args:
        words: Program and arguments.
        threads: Threads that a program which calls `end_with_parent` may use; 0 = a foreign program, whose
            environment is not changed.
        path: Where a Python program looks for modules; empty = as its environment says.
        streams: `stdin`, `stdout`, `stderr`, `cwd` and `pass_fds` of subprocess.Popen.
    """
    environment = _environment(threads) if threads else None
    if environment and path:
        environment["PYTHONPATH"] = path
    return subprocess.Popen(words, env=environment, start_new_session=True, **streams)


def kill(child: subprocess.Popen[bytes]) -> None:
    """Kill a child with all that it has started, wait for its end, and close its pipes."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child.pid, signal.SIGKILL)
    child.wait()
    for stream in (child.stdin, child.stdout):
        if stream is not None:
            with contextlib.suppress(BrokenPipeError):
                stream.close()


def end_with_parent() -> None:
    """End this process soon after the one that started it with threads; nothing without one."""
    text = os.environ.pop(_PARENT_VARIABLE, "")  # not for shell commands of the script
    if not text.isdigit():
        return
    parent = int(text)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(SECONDS_BETWEEN_LOOKS)
        os.killpg(0, signal.SIGKILL)

    if os.getpgrp() == os.getpid():  # started by `start`: the group is this task alone
        threading.Thread(target=watch, name="end with parent", daemon=True).start()


def processors() -> int:
    """Return the number of processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _environment(threads: int) -> dict[str, str]:
    return {
        **os.environ,
        **dict.fromkeys(_THREAD_VARIABLES, str(threads)),
        _PARENT_VARIABLE: str(os.getpid()),
        "PYTHONUNBUFFERED": "1",
    }


class Service:
    """A process that answers requests, one at a time: a module that calls `serve`."""

    def __init__(
        self, module: str, *arguments: str, threads: int = 1, stderr: Any = subprocess.DEVNULL
    ) -> None:
        """Start it; raises OSError where the system starts no process."""
        self._connection, theirs = socket.socketpair()
        with theirs:
            self._process = start(
                [sys.executable, "-m", module, str(theirs.fileno()), *arguments],
                threads=threads,
                path=os.pathsep.join(filter(None, sys.path)),
                pass_fds=(theirs.fileno(),),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=stderr,
            )

    @property
    def is_alive(self) -> bool:
        """Whether it has not ended."""
        return self._process.poll() is None

    def ask(self, request: Any, is_cancelled: Callable[[], bool] = lambda: False) -> Any:
        """Return its answer.

        Args:
            request: What its `serve` gets.
            is_cancelled: Asked many times a second; the process is killed when it says so, or raises.

        Raises:
            ServiceEnded: It ended without an answer.
            Cancelled: The request was cancelled.
        """
        try:
            with self._connected():
                _send(self._connection, request)
            while not self._has_answered():
                if is_cancelled():
                    raise Cancelled
            with self._connected():
                return _receive(self._connection)
        except ServiceEnded:
            raise
        except BaseException:
            self.end()
            raise

    def _has_answered(self) -> bool:
        with self._connected():
            return _is_readable(self._connection, SECONDS_BETWEEN_LOOKS)

    @contextlib.contextmanager
    def _connected(self) -> Iterator[None]:
        """Raise ServiceEnded where the connection breaks; a process that goes on without it is killed."""
        try:
            yield
        except (EOFError, OSError, ValueError) as error:  # or another thread has called `end`
            try:
                status = self._process.wait(_SECONDS_TO_END)
            except subprocess.TimeoutExpired:
                self.end()
                status = self._process.wait()
            raise ServiceEnded(status) from error

    def end(self) -> None:
        """Kill it, and wait for its end."""
        kill(self._process)
        self._connection.close()


class ServiceEnded(Exception):
    """A service has ended with a status; negative for a signal."""

    def __init__(self, status: int) -> None:
        super().__init__(f"ended with status {status}")
        self.status = status


def serve(answer: Callable[[Any], Any], idle_s: float | None = None) -> None:
    """Answer the requests of the process that started this one, until none comes for so long [s]."""
    end_with_parent()
    with (
        socket.socket(fileno=int(sys.argv[1])) as connection,
        contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError),
    ):
        while _is_readable(connection, idle_s):
            _send(connection, answer(_receive(connection)))


def _is_readable(connection: socket.socket, seconds: float | None) -> bool:
    return bool(select.select([connection], [], [], seconds)[0])


def _send(connection: socket.socket, value: Any) -> None:
    """Send a value: the number and sizes of its parts, a pickle, and its arrays."""
    buffers: list[pickle.PickleBuffer] = []
    text = pickle.dumps(value, protocol=5, buffer_callback=buffers.append)
    views = [memoryview(text), *(buffer.raw() for buffer in buffers)]
    sizes = [view.nbytes for view in views]
    connection.sendall(struct.pack(f"<{len(views) + 1}Q", len(views), *sizes))
    for view in views:
        connection.sendall(view)


def _receive(connection: socket.socket) -> Any:
    """Receive what `_send` sends; raises EOFError where the other side has ended."""
    (count,) = struct.unpack("<Q", _receive_bytes(connection, 8))
    sizes = struct.unpack(f"<{count}Q", _receive_bytes(connection, 8 * count))
    text, *buffers = [_receive_bytes(connection, size) for size in sizes]
    return pickle.loads(text, buffers=buffers)


def _receive_bytes(connection: socket.socket, size: int) -> bytearray:
    data = bytearray(size)
    view = memoryview(data)
    while view:
        count = connection.recv_into(view)
        if not count:
            raise EOFError
        view = view[count:]
    return data


def in_order(
    function: Callable[[_Item], _Value], items: Iterable[_Item], threads: int
) -> Generator[_Value]:
    """Yield the values of a function that several threads compute, in the order of the items."""
    if threads == 1:
        yield from map(function, items)
        return
    from concurrent.futures import Future, ThreadPoolExecutor

    pending: deque[Future[_Value]] = deque()
    with ThreadPoolExecutor(threads) as pool:
        try:
            for item in items:
                pending.append(pool.submit(function, item))
                if len(pending) > 2 * threads:
                    yield pending.popleft().result()
            while pending:
                yield pending.popleft().result()
        finally:
            for future in pending:
                future.cancel()
