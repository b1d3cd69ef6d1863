"""The fresh process of a task: started, watched, and ended with its worker."""

from __future__ import annotations

import contextlib
import dataclasses
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from maplab_py.child_processes import SECONDS_BETWEEN_LOOKS, kill, processors, start
from maplab_py.memory import resident_bytes
from maplab_py.pipeline.messages import Order

STARTS = " starts "
"""Stands in the first line of an attempt in a log."""


@dataclasses.dataclass(frozen=True)
class ChildEnd:
    """Exit of a child process.

    Attributes:
        status: Exit status; negative for a signal.
        peak_gb: Largest resident memory that was seen [GB].
        is_over_memory: It was stopped because it took more than it may.
        is_cancelled: It was stopped because nobody wants its result.
    """

    status: int
    peak_gb: float
    is_over_memory: bool
    is_cancelled: bool


def run_child(order: Order, is_cancelled: Callable[[], bool]) -> ChildEnd:
    """Run the commands of an order in a fresh process of the console, and wait for its end.

    It ends with this process, whatever ends that: a killed worker leaves nobody behind who writes.

    Args:
        order: What to run.
        is_cancelled: Asked many times a second; the process is killed when it says so.
    """
    switches = ["--keep_going"] * order.keep_going + ["--discard"] * order.discard
    with order.reports.open("wb") as reports, order.log.open("ab") as log:
        child = start(
            [sys.executable, "-m", "maplab_py", "--json", *switches, *order.flags],
            threads=order.threads or max(1, processors() // max(1, order.tasks_per_host)),
            stdin=subprocess.PIPE,
            stdout=reports,
            stderr=log,
            cwd=order.folder,
        )
        try:
            _send(child, order.script)
            return _watch(child, order.memory_gb * 1e9, is_cancelled)
        finally:
            kill(child)  # with the shell commands of its script


def _send(child: subprocess.Popen[bytes], script: str) -> None:
    assert child.stdin is not None
    with contextlib.suppress(BrokenPipeError), child.stdin:
        child.stdin.write(script.encode("utf-8", "surrogateescape"))


def _watch(
    child: subprocess.Popen[bytes], limit_bytes: float, is_cancelled: Callable[[], bool]
) -> ChildEnd:
    peak = 0.0
    while True:
        with contextlib.suppress(subprocess.TimeoutExpired):
            status = child.wait(timeout=SECONDS_BETWEEN_LOOKS)
            return ChildEnd(status, peak / 1e9, is_over_memory=False, is_cancelled=False)
        peak = max(peak, resident_bytes(child.pid))
        is_over = 0.0 < limit_bytes < peak
        if is_over or is_cancelled():
            child.kill()
            return ChildEnd(child.wait(), peak / 1e9, is_over, not is_over)


def first_error(log: Path) -> str:
    """Return the first error that the last attempt has written to its log, else an empty text."""
    try:
        text = log.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""
    attempt = text[max(0, text.rfind(STARTS)) :]
    errors = (line for line in attempt.splitlines() if line.startswith("error: "))
    return next(errors, "").removeprefix("error: ")
