"""The worker's side: run one order in a fresh process and put its result in place."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import shlex
import shutil
import socket
import subprocess
import sys
import time
import uuid
from collections.abc import Callable
from pathlib import Path

from maplab_py.atomic import replaced_folder
from maplab_py.child_processes import SECONDS_BETWEEN_LOOKS, kill, processors, start
from maplab_py.errors import MaplabError, UserError
from maplab_py.memory import resident_bytes, says_not_enough
from maplab_py.pipeline import plan
from maplab_py.pipeline.messages import Ending, Order, Outcome
from maplab_py.storage.cache.map_cache import program_version

_USER_ERROR = 2
_KILLED = -9


def worker_name() -> str:
    """Return the machine and the number of this process."""
    return f"{socket.gethostname()}:{os.getpid()}"


def execute(order: Order, is_cancelled: Callable[[], bool] = lambda: False) -> Outcome:
    """Run an order; whatever goes wrong is in the outcome, and then the result is as before.

    Args:
        order: What to run.
        is_cancelled: Asked many times a second whether nobody wants the result any more.
    """
    start = time.monotonic()
    peak_gb, error = 0.0, ""
    work: Path | None = None
    try:
        _check_worker(order)
        with order.log.open("a", encoding="utf-8") as log:
            log.write(f"worker {worker_name()}{STARTS}{order.title}\n")
        if order.result is not None:
            work = _work_folder(order)
        end = run_child(_written_to(order, work), is_cancelled)
        peak_gb = end.peak_gb
        ending, error = _judge(order, end)
        if ending is Ending.DONE and work is not None:
            _publish(order, work)
    except UserError as failure:
        ending, error = Ending.FAILED, str(failure)
    except (OSError, MaplabError) as failure:
        ending, error = Ending.FAILED, f"{order.title}: {failure}"
    finally:
        if work is not None:
            shutil.rmtree(work, ignore_errors=True)
    seconds = time.monotonic() - start
    return Outcome(order.title, ending, error, seconds, peak_gb, worker_name())


def _work_folder(order: Order) -> Path:
    """Make the hidden folder of this attempt; what attempts of lost workers left is deleted."""
    stem = f".{order.log.stem}."
    for path in order.log.parent.iterdir():
        mark = path.name.removeprefix(stem)
        if mark != path.name and "." not in mark and path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
    work = order.log.parent / f"{stem}{uuid.uuid4().hex[:12]}"
    work.mkdir()
    return work


def _written_to(order: Order, work: Path | None) -> Order:
    script = order.script.replace(plan.RESULT_TEMPLATE, shlex.quote(str(work or "")))
    return dataclasses.replace(order, script=script)


def _check_worker(order: Order) -> None:
    """Refuse what this worker cannot run as the others would.

    Raises:
        UserError: It has another version, or does not see a folder.
    """
    if program_version() != order.version:
        raise UserError(
            f"worker {worker_name()} has maplab-py {program_version()}, the pipeline was started "
            f"with {order.version}: install the same version"
        )
    for folder in (order.folder, order.log.parent, *order.inputs):
        if not folder.is_dir():
            raise UserError(
                f"{folder}: worker {worker_name()} does not see this folder; maps and results "
                "must lie on a path that all workers share"
            )


def _judge(order: Order, end: ChildEnd) -> tuple[Ending, str]:
    if end.is_cancelled:
        return Ending.CANCELLED, "cancelled"
    if end.is_over_memory:
        limit = f"{order.memory_gb:.2f} GB"
        return Ending.OVER_MEMORY, f"takes more than {limit} of memory (--task_memory_gb)"
    if end.status == 0:
        return Ending.DONE, ""
    error = first_error(order.log) or f"ended with status {end.status}"
    if end.status == _KILLED:
        return Ending.OVER_MEMORY, "was killed, as the system does when memory runs out"
    if says_not_enough(error):
        return Ending.OVER_MEMORY, error
    return Ending.REFUSED if end.status == _USER_ERROR else Ending.FAILED, error


def _publish(order: Order, work: Path) -> None:
    """Put the new result in place of an earlier one, in one step.

    Raises:
        UserError: The commands have written nothing, or the folder cannot be replaced.
    """
    assert order.result is not None
    if not any(work.iterdir()):
        raise UserError(f"{order.title}: the commands have written nothing to the result's folder")
    with replaced_folder(order.result) as temporary:
        temporary.rmdir()
        work.rename(temporary)


STARTS = " starts "
"""Stands in the first line of an attempt in a log."""


@dataclasses.dataclass(frozen=True)
class ChildEnd:
    """Exit of a child process."""

    status: int  # exit status; negative for a signal
    peak_gb: float  # largest resident memory that was seen [GB]
    is_over_memory: bool  # it was stopped because it took more than it may
    is_cancelled: bool  # it was stopped because nobody wants its result


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
