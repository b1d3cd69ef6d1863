"""Compile kernels in processes of low priority while the user still reads, and wait for the rest.

A process and not a thread, because numba compiles one function at a time and holds the interpreter.
It reads the names of jobs from its standard input and ends with it, so it never outlives the
console. numba and `generated_module` replace files atomically: a process that is killed leaves the
cache as it was.
"""

from __future__ import annotations

import json
import os
import queue
import subprocess
import sys
import threading
from collections.abc import Sequence

from maplab_py.algorithms.rig_warmup import RigKernels
from maplab_py.estimation.codegen.modules import cache_folder
from maplab_py.progress import Progress

LOWEST_PRIORITY = 19
"""Niceness of the processes that nobody waits for."""
_MOST_PROCESSES = 2
_WHAT = "compile kernels (once per machine)"


class BackgroundCompilation:
    """Compiles the kernels of a rig that are not on the disk.

    `wait` adds a process of ordinary priority. On a busy machine processes of low priority may
    stand still, so the added one also starts jobs again that they are at; the first to be ready
    counts. If no process can be started, or all die, nobody waits: the command compiles what
    it needs.
    """

    def __init__(self, rig: RigKernels, jobs: Sequence[str]) -> None:
        """Start with the lowest priority; a machine with a single core gets no process.

        Args:
            rig: What to compile.
            jobs: Names of its jobs, in the order of their importance.
        """
        self._rig = rig
        self._jobs = tuple(jobs)
        self._started: list[str] = []
        self._done: set[str] = set()
        self._changed = threading.Condition()
        self._processes: list[subprocess.Popen[str]] = []
        self._running = 0
        self._is_closed = False
        cache_folder()  # a temporary one must be known before the first process inherits its name
        if (os.cpu_count() or 1) > 1:
            for _ in self._jobs[:_MOST_PROCESSES]:
                self._start(LOWEST_PRIORITY)

    @property
    def is_finished(self) -> bool:
        """Whether nothing is left to wait for: all jobs are done, or no process is alive."""
        with self._changed:
            return len(self._done) == len(self._jobs) or not self._running

    @property
    def process_ids(self) -> tuple[int, ...]:
        """The processes that are running."""
        return tuple(each.pid for each in self._processes if each.poll() is None)

    def wait(self, progress: Progress) -> None:
        """Wait for all jobs with a progress bar; raises Cancelled as `progress` does."""
        if self.is_finished:
            return
        hurried = self._start(0)
        try:
            while not self.is_finished:
                progress.step(len(self._done), len(self._jobs), _WHAT)
                with self._changed:
                    self._changed.wait(0.1)
        finally:
            _end(hurried)

    def close(self) -> None:
        """End the processes, whatever they do."""
        with self._changed:
            self._is_closed = True
            processes = list(self._processes)
        for process in processes:
            _end(process)

    def _start(self, niceness: int) -> subprocess.Popen[str] | None:
        arguments = f"import serve; serve({json.dumps(self._rig.words)!r})"
        code = f"import os; os.nice({niceness}); from {__name__} {arguments}"
        with self._changed:
            if self._is_closed:
                return None
            try:
                process = subprocess.Popen(
                    [sys.executable, "-c", code],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.DEVNULL,
                    text=True,
                    start_new_session=True,  # Ctrl-C in the terminal is not meant for it
                )
            except OSError:
                return None
            self._processes.append(process)
            self._running += 1
        is_hurried = niceness == 0
        threading.Thread(target=self._feed, args=(process, is_hurried), daemon=True).start()
        return process

    def _feed(self, process: subprocess.Popen[str], is_hurried: bool) -> None:
        """Give a process one job after the other, until none is left or it dies."""
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            while (job := self._next(again=is_hurried)) is not None:
                process.stdin.write(f"{job}\n")
                process.stdin.flush()
                if process.stdout.readline().strip() != job:
                    break
                with self._changed:
                    self._done.add(job)
                    self._changed.notify_all()
            process.stdin.close()
        except (OSError, ValueError):  # it is dead, or was closed
            pass
        finally:
            with self._changed:
                self._running -= 1
                self._changed.notify_all()
            process.wait()

    def _next(self, *, again: bool) -> str | None:
        """Return a job that nobody has started, else with `again` one that is not done."""
        with self._changed:
            rest = [job for job in self._jobs if job not in self._started]
            if not rest and again:
                rest = [job for job in self._jobs if job not in self._done]
            if not rest or self._is_closed:
                return None
            self._started.append(rest[0])
            return rest[0]


def _end(process: subprocess.Popen[str] | None) -> None:
    if process is not None:
        process.kill()
        process.wait()


def serve(arguments: str) -> None:
    """Compile the jobs whose names come from standard input; print each when it is done.

    The process ends with its standard input, also in the middle of a job.

    Args:
        arguments: The words of the rig, as JSON.
    """
    names: queue.Queue[str] = queue.Queue()
    threading.Thread(target=_read, args=(names,), daemon=True).start()
    jobs = RigKernels.from_words(json.loads(arguments)).jobs()
    while True:
        name = names.get()
        jobs[name]()
        sys.stdout.write(f"{name}\n")
        sys.stdout.flush()


def _read(names: queue.Queue[str]) -> None:
    for line in sys.stdin:
        names.put(line.strip())
    os._exit(0)
