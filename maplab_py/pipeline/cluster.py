"""Orders on the workers of Dask distributed: processes of this machine, or of a scheduler's."""

import contextlib
import itertools
import logging
import os
import time
from collections import Counter
from typing import Any, Self

from maplab_py.cancellation import check_cancelled
from maplab_py.errors import MaplabError, UserError
from maplab_py.memory import available_bytes
from maplab_py.pipeline.engines import Engine
from maplab_py.pipeline.execution import execute
from maplab_py.pipeline.messages import Ending, Order, Outcome
from maplab_py.pipeline.options import PipelineOptions

_SECONDS_TO_CONNECT = 10.0
_SECONDS_TO_CLOSE = 10.0
_SECONDS_BETWEEN_LOOKS = 0.02
_SHARE = 0.9
"""Fraction of the memory that all local workers share."""


class Cluster(Engine):
    """A client of a Dask scheduler; `local:N` also starts the scheduler and its workers.

    Dask runs the tasks of a lost worker again on another one. Only orders travel: folder names,
    lines of commands, flags and numbers.
    """

    def __init__(self, options: PipelineOptions) -> None:
        """Prepare; nothing is started yet.

        Args:
            options: The scheduler, and how often a task may lose its worker.

        Raises:
            UserError: Dask is not installed.
        """
        try:
            import distributed
        except ImportError:
            raise UserError(
                f"--scheduler={options.scheduler} needs Dask: install the extra "
                "(pip install 'maplab-py[cluster]')"
            ) from None
        self._dask: Any = distributed
        self._options = options
        self._workers = options.local_workers()
        self._share_gb = _SHARE * available_bytes() / 1e9 / max(1, self._workers)
        self._cluster: Any = None
        self._client: Any = None
        self._done: Any = None
        self._titles: dict[str, str] = {}
        self._numbers = itertools.count()

    def __enter__(self) -> Self:
        """Start the workers, or connect to the scheduler.

        Raises:
            UserError: No scheduler answers, or it has no workers.
        """
        logging.getLogger("distributed").setLevel(logging.CRITICAL)
        try:
            self._start_local() if self._workers else self._connect()
            self._done = self._dask.as_completed()
        except BaseException:
            self._close()
            raise
        return self

    def _start_local(self) -> None:
        import dask

        dask.config.set(
            {
                "distributed.scheduler.allowed-failures": self._options.retries,
                "distributed.logging.distributed": "critical",
            }
        )
        self._cluster = self._dask.LocalCluster(
            n_workers=self._workers,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            dashboard_address="127.0.0.1:0",
            memory_limit=0,  # the tasks' own processes are watched instead
            silence_logs=logging.CRITICAL,
            preload=["maplab_py.pipeline.worker_setup"],
        )
        self._client = self._dask.Client(self._cluster)
        self.address = str(self._client.dashboard_link)

    def _connect(self) -> None:
        address = self._options.scheduler
        try:
            self._client = self._dask.Client(address, timeout=_SECONDS_TO_CONNECT)
        except (OSError, ValueError) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise UserError(
                f"--scheduler={address}: no scheduler answers there; start one (dask scheduler) and "
                f"its workers (dask worker {address}) [{reason[:80]}]"
            ) from None
        deadline = time.monotonic() + _SECONDS_TO_CONNECT
        while not self._known_workers():
            if time.monotonic() > deadline:
                raise UserError(
                    f"--scheduler={address}: the scheduler has no workers; start some "
                    f"(dask worker {address} --nthreads 1)"
                )
            time.sleep(0.1)
        self.address = str(self._client.dashboard_link)

    def _known_workers(self) -> list[dict[str, Any]]:
        return list(self._client.scheduler_info(n_workers=-1)["workers"].values())

    def slots(self) -> int:
        """Return the threads of all workers; of local workers also those that are starting again."""
        if self._workers:
            return self._workers
        return max(1, sum(int(worker["nthreads"]) for worker in self._known_workers()))

    def slots_per_host(self) -> int:
        """Return the most threads of workers on one machine."""
        if self._workers:
            return self._workers
        threads: Counter[str] = Counter()
        for worker in self._known_workers():
            threads[str(worker["host"])] += int(worker["nthreads"])
        return max(threads.values(), default=1)

    def share_gb(self) -> float:
        """Return a local worker's part of the memory, or the smallest limit of Dask's workers."""
        if self._workers:
            return self._share_gb
        limits = [
            worker["memory_limit"] / worker["nthreads"] / 1e9 for worker in self._known_workers()
        ]
        return min((limit for limit in limits if limit > 0), default=0.0)

    def submit(self, order: Order) -> None:
        """Send an order to a worker."""
        key = f"{order.title}-{os.getpid()}-{time.time_ns()}-{next(self._numbers)}"
        self._titles[key] = order.title
        self._done.add(self._client.submit(run_order, order, key=key, pure=False))

    def next_outcome(self) -> Outcome:
        """Wait until an order ends; see `Engine.next_outcome`."""
        while not self._done.has_ready() and not self._done.is_empty():
            check_cancelled()
            time.sleep(_SECONDS_BETWEEN_LOOKS)
        future = next(self._done)
        title = self._titles.pop(future.key)
        try:
            outcome: Outcome = future.result()
        except self._dask.KilledWorker:
            return Outcome(title, Ending.LOST, "lost its worker again and again (out of memory?)")
        except MaplabError:
            raise
        except Exception as error:
            if self._client.status != "running":
                raise MaplabError(
                    f"--scheduler={self._options.scheduler}: the scheduler is lost; run again "
                    "with --resume"
                ) from error
            reason = f"{type(error).__name__}: {error}".splitlines()[0]
            return Outcome(title, Ending.FAILED, f"{title}: {reason}")
        return outcome

    def __exit__(self, *_: object) -> None:
        """Cancel what runs, and stop what was started."""
        self._close()

    def _close(self) -> None:
        if self._client is not None:
            with contextlib.suppress(Exception):
                self._client.cancel([*self._done.futures] if self._done else [], force=True)
            with contextlib.suppress(Exception):
                self._client.close(timeout=_SECONDS_TO_CLOSE)
        if self._cluster is not None:
            with contextlib.suppress(Exception):
                self._cluster.close(timeout=_SECONDS_TO_CLOSE)


def run_order(order: Order) -> Outcome:
    """Run an order on a worker of Dask, until nobody wants its result any more."""
    from distributed import get_worker

    worker = get_worker()
    key = worker.get_current_task()

    def is_cancelled() -> bool:
        task = worker.state.tasks.get(key)
        return task is None or task.state not in ("executing", "long-running")

    return execute(order, is_cancelled)
