"""Child processes: leaders of groups of their own, with few threads, that end with this process.

A `Service` is a child that answers requests; both sides are pickled, and arrays travel as they lie in memory.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from maplab_py.errors import Cancelled

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

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
        from multiprocessing import Pipe

        self._connection, theirs = Pipe()
        try:
            self._process = start(
                [sys.executable, "-m", module, str(theirs.fileno()), *arguments],
                threads=threads,
                path=os.pathsep.join(filter(None, sys.path)),
                pass_fds=(theirs.fileno(),),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=stderr,
            )
        except OSError:
            self._connection.close()
            raise
        finally:
            theirs.close()

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
            _send(self._connection, request)
            while not self._connection.poll(SECONDS_BETWEEN_LOOKS):
                if is_cancelled():
                    raise Cancelled
            return _receive(self._connection)
        except (EOFError, OSError) as error:
            raise ServiceEnded(self._process.wait()) from error
        except BaseException:
            self.end()
            raise

    def end(self) -> None:
        """Kill it, and wait for its end."""
        self._connection.close()
        kill(self._process)


class ServiceEnded(Exception):
    """A service has ended with a status; negative for a signal."""

    def __init__(self, status: int) -> None:
        """Keep the status."""
        super().__init__(f"ended with status {status}")
        self.status = status


def serve(answer: Callable[[Any], Any], idle_s: float | None = None) -> None:
    """Answer the requests of the process that started this one, until none comes for so long [s]."""
    from multiprocessing.connection import Connection

    end_with_parent()
    with (
        Connection(int(sys.argv[1])) as connection,
        contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError),
    ):
        while connection.poll(idle_s):
            _send(connection, answer(_receive(connection)))


def _send(connection: Connection, value: Any) -> None:
    buffers: list[pickle.PickleBuffer] = []
    text = pickle.dumps(value, protocol=5, buffer_callback=buffers.append)
    views = [buffer.raw() for buffer in buffers]
    connection.send((text, [view.nbytes for view in views]))
    for view in views:
        if view.nbytes:
            connection.send_bytes(view)


def _receive(connection: Connection) -> Any:
    text, sizes = connection.recv()
    buffers = [bytearray(size) for size in sizes]
    for buffer in buffers:
        if buffer:
            connection.recv_bytes_into(buffer)
    return pickle.loads(text, buffers=buffers)
