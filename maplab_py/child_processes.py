"""Child processes: leaders of groups of their own, with few threads, that end with this process."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import threading
import time
from collections.abc import Sequence
from typing import Any

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


def start(words: Sequence[str], *, threads: int = 0, **streams: Any) -> subprocess.Popen[bytes]:
    """Start a program in a group of its own; Ctrl-C in the terminal is not meant for it.

    Args:
        words: Program and arguments.
        threads: Threads that a program which calls `end_with_parent` may use; 0 = a foreign program, whose
            environment is not changed.
        streams: `stdin`, `stdout`, `stderr` and `cwd` of subprocess.Popen.
    """
    environment = _environment(threads) if threads else None
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
