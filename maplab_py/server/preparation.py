"""Preparation of submaps: each is checked and optimised by itself in a worker process."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import hashlib
import os
import queue
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np

from maplab_py.algorithms.pose_graph_manipulation.stationary_options import StationaryOptions
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.atomic import write_file
from maplab_py.child_processes import Service, ServiceEnded
from maplab_py.errors import Cancelled, MapError, MaplabError, UserError
from maplab_py.pipeline.messages import Ending, Outcome
from maplab_py.server.journal import Journal, MergedSubmap
from maplab_py.server.options import SubmapOptions
from maplab_py.server.publishing import Publisher
from maplab_py.server.spool import Arrival, Entry, Spool
from maplab_py.server.status import Events
from maplab_py.server.worker import SubmapOrder
from maplab_py.storage import mission_names, native
from maplab_py.storage.cache.map_cache import program_version
from maplab_py.vimap import VIMap, queries, to_hex

_MAX_IMU_STEP_NS = 1_000_000_000
"""IMU samples that are farther apart are those of a clock that jumped."""
_NOTE = "prepared.sha256"
_GATE_SIGMA = VIOptimizationOptions().absolute_pose_gate_sigma


class Preparation:
    """Gives submaps to workers, a few at a time."""

    def __init__(self, spool: Spool, options: SubmapOptions, stationary: StationaryOptions) -> None:
        self._spool, self._options, self._stationary = spool, options, stationary
        workers = options.submap_loading_thread_pool_size
        self._workers = WorkerPool(max(1, (os.cpu_count() or 1) // workers))
        self._threads = ThreadPoolExecutor(workers, thread_name_prefix="prepare")
        self._is_stopping = False

    def start(self, entry: Entry) -> Future[Outcome]:
        """Prepare a submap; the result is in `prepared` of its folder, what was wrong in the outcome."""
        order = self._order(entry)
        return self._threads.submit(self._workers.run, order, lambda: self._is_stopping)

    def note(self, entry: Entry) -> None:
        """Note how the result of a submap was made, so that a later server can use it."""
        with contextlib.suppress(MaplabError, OSError):  # it is made again
            write_file(self._spool.folder(entry) / _NOTE, [self._key(entry).encode()])

    def is_done(self, entry: Entry) -> bool:
        """Tell whether there is a result that this server would make in the same way."""
        folder = self._spool.folder(entry)
        try:
            is_noted = (folder / _NOTE).read_text(encoding="utf-8") == self._key(entry)
        except (OSError, ValueError):
            return False
        return is_noted and native.is_map_folder(folder / "prepared")

    def stop(self) -> None:
        """Kill what runs, and wait for its end."""
        self._is_stopping = True
        self._threads.shutdown(wait=True, cancel_futures=True)
        self._workers.stop()

    def _key(self, entry: Entry) -> str:
        return hashlib.sha256(
            f"{program_version()}\n{self._order(entry).as_line()}".encode(
                "utf-8", "surrogateescape"
            )
        ).hexdigest()

    def _order(self, entry: Entry) -> SubmapOrder:
        folder = self._spool.folder(entry)
        is_gated = self._options.remove_outliers_in_absolute_pose_constraints
        return SubmapOrder(
            title=entry.title,
            submap=folder / "submap",
            result=folder / "prepared",
            log=folder / "worker.log",
            absolute_pose_gate_sigma=_GATE_SIGMA if is_gated else 0.0,
            ties_stationary=self._options.stationary_submaps_fix_with_lc_edge,
            max_rotation_rad=self._stationary.max_rotation_rad,
            max_translation_m=self._stationary.max_translation_m,
        )


def check_submap(submap: VIMap) -> None:
    """Check what a consistent map may lack to be a submap.

    Raises:
        MapError: It is empty, its clock jumps, or neighbours of a mission are not joined.
    """
    if not len(submap.vertices):
        raise MapError("has no vertices")
    times_ns = submap.imu_samples.timestamp_ns
    starts = submap.sample_start[:-1]
    step_ns = times_ns[1:] - times_ns[:-1]
    inside = np.ones(len(step_ns), dtype=np.bool_)
    inside[starts[1:][starts[1:] > 0] - 1] = False  # from one edge to the next
    wrong = np.flatnonzero(inside & ((step_ns <= 0) | (step_ns > _MAX_IMU_STEP_NS)))
    if len(wrong):
        seconds = 1e-9 * float(step_ns[wrong[0]])
        raise MapError(f"its clock jumps by {seconds:.3f} s after {times_ns[wrong[0]]} ns")
    mission = submap.vertices.mission
    gaps = np.flatnonzero(~queries.has_link(submap)[:-1] & (mission[1:] == mission[:-1]))
    if len(gaps):
        name = to_hex(submap.vertices.id[gaps[0]])
        raise MapError(
            f"no edge joins vertex {name} to the next: its clock jumps, or data were lost"
        )


_IDLE_S = 60.0
_MOST_ORDERS = 200
"""A worker is replaced after so many submaps, so that its memory cannot grow without end."""
_KILLED = -9  # by SIGKILL


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
                    worker.end()
                else:
                    self._idle.put(worker)
            if outcome is not None:
                return outcome  # else it had ended for want of orders

    def stop(self) -> None:
        """Kill the workers that are idle; those that are not belong to threads that run orders."""
        with contextlib.suppress(queue.Empty):
            while True:
                self._idle.get_nowait().end()

    def _take(self) -> _Worker:
        with contextlib.suppress(queue.Empty):
            return self._idle.get_nowait()
        return _Worker(self._threads, self._idle_s)


class _Worker(Service):
    """A worker process."""

    def __init__(self, threads: int, idle_s: float) -> None:
        super().__init__("maplab_py.server.worker", repr(idle_s), threads=threads)
        self.orders = 0  # how many it has been given

    def run(self, order: SubmapOrder, is_cancelled: Callable[[], bool]) -> Outcome | None:
        """Run an order; None where the process had ended before it got the order."""
        self.orders += 1
        try:
            return Outcome(order.title, *self.ask(order, is_cancelled))
        except Cancelled:
            return Outcome(order.title, Ending.CANCELLED, "cancelled")
        except ServiceEnded as end:
            if end.status == 0:
                return None
            if end.status == _KILLED:
                error = "was killed, as the system does when memory runs out"
                return Outcome(order.title, Ending.OVER_MEMORY, error)
            return Outcome(order.title, Ending.FAILED, str(end))


_ATTEMPTS = 3
"""Attempts to prepare a submap whose worker dies or fails without naming a fault of the submap."""
_DISK_FULL = os.strerror(errno.ENOSPC)
_SECONDS_BETWEEN_RETRIES = 5.0


@dataclasses.dataclass
class Item:
    """An accepted submap that is not published yet."""

    entry: Entry  # where it is in the spool
    future: Future[Outcome] | None = None  # the worker that prepares it
    attempts: int = 0  # how often a worker has been started
    submap: VIMap | None = None  # the prepared submap, until it is merged
    waits_for_neighbour: bool = False  # it adjoins nothing of its mission in the map
    merged: MergedSubmap | None = None  # its record, from the merge on
    not_before_s: float = 0.0  # when its next worker may start [s, monotonic]

    @property
    def needs_worker(self) -> bool:
        """Whether a worker is to be started now."""
        is_open = self.future is None and self.submap is None and self.merged is None
        return is_open and time.monotonic() >= self.not_before_s

    @property
    def is_preparing(self) -> bool:
        """Whether a worker has it."""
        return self.future is not None and not self.future.done()


class Intake:
    """Accepts submaps and has them prepared."""

    def __init__(
        self, spool: Spool, preparation: Preparation, publisher: Publisher, events: Events
    ) -> None:
        # all submaps that are accepted and not published yet, by number
        self.items: dict[int, Item] = {}
        self.rejected = 0  # how many were rejected
        self._spool, self._preparation = spool, preparation
        self._publisher, self._events = publisher, events
        self._next_number = 1

    def take_up(self) -> None:
        """Continue with the accepted submaps of an earlier server."""
        self._next_number = 1 + self._spool.highest_number()
        for entry in self._spool.entries():
            self.items[entry.number] = Item(entry)

    def has_work(self) -> bool:
        """Tell whether a submap has come, or a worker has ended."""
        done = (item.future is not None and item.future.done() for item in self.items.values())
        return any(done) or any(a.is_complete or a.reason for a in self._spool.arrivals())

    def advance(self, journal: Journal) -> str:
        """Accept what has come, start workers, and take what they have made.

        Returns:
            What is wrong with the disk; empty if nothing is.
        """
        for arrival in self._spool.arrivals():
            if not arrival.is_complete and not arrival.reason:
                continue
            try:
                problem = self._take(arrival, journal)
            except (OSError, MaplabError) as error:
                problem = f"{arrival.robot}/{arrival.folder.name}: cannot be taken ({error})"
            if problem:
                return problem
        for item in list(self.items.values()):
            if item.future is not None and item.future.done():
                problem = self._collect(item, item.future.result())
                if problem:
                    return problem
            elif item.needs_worker and not self._take_prepared(item):
                item.attempts += 1
                item.future = self._preparation.start(item.entry)
        return ""

    def reject(self, item: Item, reason: str) -> str:
        """Move a submap to `rejected`; return what is wrong with the disk, empty if nothing is."""
        line = " ".join(reason.split())
        try:
            self._spool.reject(item.entry, line)
        except (OSError, UserError) as error:
            return f"{item.entry.title}: cannot be moved to rejected ({error})"
        self.rejected += 1
        self._events.add(f"{item.entry.title}: rejected: {line}")
        del self.items[item.entry.number]
        return ""

    def _take(self, arrival: Arrival, journal: Journal) -> str:
        entry = self._spool.accept(arrival, self._next_number)
        self._next_number += 1
        earlier = [submap.title for submap in journal.merged if submap.sha256 == entry.sha256]
        earlier += [i.entry.title for i in self.items.values() if i.entry.sha256 == entry.sha256]
        self.items[entry.number] = item = Item(entry)
        if arrival.reason:
            return self.reject(item, arrival.reason)
        if earlier:
            return self.reject(item, f"is a duplicate of {earlier[0]}")
        self._events.add(f"{entry.title}: accepted")
        return ""

    def _collect(self, item: Item, outcome: Outcome) -> str:
        """Take what a worker has made of a submap."""
        item.future = None
        if outcome.ending is Ending.DONE:
            self._preparation.note(item.entry)
            return self._load(item)
        if _DISK_FULL in outcome.error:
            item.attempts -= 1
            item.not_before_s = time.monotonic() + _SECONDS_BETWEEN_RETRIES
            return f"{item.entry.title}: cannot be prepared ({_DISK_FULL})"
        if outcome.ending is Ending.REFUSED:
            return self.reject(item, outcome.error)
        if item.attempts < _ATTEMPTS:
            self._events.add(f"{item.entry.title}: {outcome.error}; it is tried again")
            return ""
        return self.reject(item, f"{outcome.error}, {item.attempts} times")

    def _take_prepared(self, item: Item) -> bool:
        """Take what a worker of an earlier server has made; False where a worker is needed."""
        if item.attempts or not self._preparation.is_done(item.entry):
            return False
        try:
            item.submap = self._prepared(item)
        except MaplabError:  # a worker makes it again, or says what is wrong with the submap
            return False
        return True

    def _load(self, item: Item) -> str:
        try:
            item.submap = self._prepared(item)
        except MaplabError as error:
            return self.reject(item, str(error))
        return ""

    def _prepared(self, item: Item) -> VIMap:
        """Return the prepared submap; raises MapError, or UserError where resources have no place."""
        folder = self._spool.folder(item.entry)
        submap, _ = native.load_map(folder / "prepared")
        check_submap(submap)
        submap = self._publisher.with_resources(submap, folder / "submap")
        return mission_names.named(submap, [item.entry.robot] * len(submap.missions))
