"""Worker processes that stay for the next submap, see `worker`."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import select
import signal
import subprocess
import sys
from collections.abc import Callable

from maplab_py.pipeline.child import thread_environment
from maplab_py.pipeline.orders import Ending, Outcome
from maplab_py.server.worker import SubmapOrder

_SECONDS_BETWEEN_LOOKS = 0.1
_IDLE_S = 60.0
_MOST_ORDERS = 200
"""A worker is replaced after so many submaps, so that its memory cannot grow without end."""
_KILLED = -signal.SIGKILL


class WorkerPool:
    """Worker processes; several threads may run orders at the same time, each has one then.

    A worker that dies costs the order that it was at, and is replaced. All end with this process, whatever
    ends that.
    """

    def __init__(self, threads: int, idle_s: float = _IDLE_S) -> None:
        """Start without processes.

        Args:
            threads: Threads that a worker may use.
            idle_s: A worker without orders ends after so long [s].
        """
        self._threads, self._idle_s = threads, idle_s
        self._idle: queue.LifoQueue[_Worker] = queue.LifoQueue()

    def run(self, order: SubmapOrder, is_cancelled: Callable[[], bool]) -> Outcome:
        """Run an order; whatever goes wrong is in the outcome.

        Args:
            order: The submap.
            is_cancelled: Asked many times a second; the worker is killed when it says so.
        """
        while True:
            try:
                worker = self._take()
            except OSError as error:
                return Outcome(order.title, Ending.FAILED, f"no worker can be started ({error})")
            outcome = None
            try:
                outcome = worker.run(order, is_cancelled)
            finally:
                if outcome is None or worker.orders >= _MOST_ORDERS or not worker.is_alive:
                    worker.kill()
                else:
                    self._idle.put(worker)
            if outcome is not None:
                return outcome  # else it had ended for want of orders

    def stop(self) -> None:
        """Kill the workers that are idle; those that are not belong to threads that run orders."""
        with contextlib.suppress(queue.Empty):
            while True:
                self._idle.get_nowait().kill()

    def _take(self) -> _Worker:
        with contextlib.suppress(queue.Empty):
            return self._idle.get_nowait()
        return _Worker(self._threads, self._idle_s)


class _Worker:
    """A worker process.

    Attributes:
        orders: How many it has been given.
    """

    def __init__(self, threads: int, idle_s: float) -> None:
        self.orders = 0
        self._process = subprocess.Popen(
            [sys.executable, "-m", "maplab_py.server.worker", repr(idle_s)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=thread_environment(threads),
            start_new_session=True,
        )

    @property
    def is_alive(self) -> bool:
        return self._process.poll() is None

    def run(self, order: SubmapOrder, is_cancelled: Callable[[], bool]) -> Outcome | None:
        """Run an order; None where the process had ended before it got the order."""
        self.orders += 1
        stdin, stdout = self._process.stdin, self._process.stdout
        assert stdin is not None
        assert stdout is not None
        with contextlib.suppress(BrokenPipeError):
            stdin.write(order.as_line().encode("utf-8", "surrogateescape"))
            stdin.flush()
        while not select.select([stdout], [], [], _SECONDS_BETWEEN_LOOKS)[0]:
            if is_cancelled():
                self.kill()
                return Outcome(order.title, Ending.CANCELLED, "cancelled")
        line = stdout.readline()
        if line:
            ending, error = json.loads(line)
            return Outcome(order.title, Ending(ending), error)
        status = self._process.wait()
        if status == 0:
            return None
        if status == _KILLED:
            return Outcome(
                order.title,
                Ending.OVER_MEMORY,
                "was killed, as the system does when memory runs out",
            )
        return Outcome(order.title, Ending.FAILED, f"ended with status {status}")

    def kill(self) -> None:
        """End the process, and wait for its end."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout):
            if stream is not None:
                with contextlib.suppress(BrokenPipeError):
                    stream.close()
