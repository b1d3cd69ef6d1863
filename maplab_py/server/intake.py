"""From a folder in `incoming` to a prepared submap in memory."""

from __future__ import annotations

import dataclasses
import errno
import os
import time
from concurrent.futures import Future

from maplab_py.errors import MaplabError, UserError
from maplab_py.pipeline.orders import Ending, Outcome
from maplab_py.server.journal import Journal, MergedSubmap
from maplab_py.server.preparation import Preparation, check_submap
from maplab_py.server.publishing import Publisher
from maplab_py.server.spool import Arrival, Entry, Spool
from maplab_py.server.status import Events
from maplab_py.storage.mission_names import named
from maplab_py.storage.native import load_map
from maplab_py.vimap import VIMap

_ATTEMPTS = 3
"""Attempts to prepare a submap whose worker dies or fails without naming a fault of the submap."""
_DISK_FULL = os.strerror(errno.ENOSPC)
_SECONDS_BETWEEN_RETRIES = 5.0


@dataclasses.dataclass
class Item:
    """An accepted submap that is not published yet.

    Attributes:
        entry: Where it is in the spool.
        future: The worker that prepares it.
        attempts: How often a worker has been started.
        submap: The prepared submap, until it is merged.
        waits_for_neighbour: It adjoins nothing of its mission in the map.
        merged: Its record, from the merge on.
        not_before_s: When its next worker may start [s, monotonic].
    """

    entry: Entry
    future: Future[Outcome] | None = None
    attempts: int = 0
    submap: VIMap | None = None
    waits_for_neighbour: bool = False
    merged: MergedSubmap | None = None
    not_before_s: float = 0.0

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
    """Accepts submaps and has them prepared.

    Attributes:
        items: All submaps that are accepted and not published yet, by number.
        rejected: How many were rejected.
    """

    def __init__(
        self, spool: Spool, preparation: Preparation, publisher: Publisher, events: Events
    ) -> None:
        """Start without submaps."""
        self.items: dict[int, Item] = {}
        self.rejected = 0
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
        submap, _ = load_map(folder / "prepared")
        check_submap(submap)
        submap = self._publisher.with_resources(submap, folder / "submap")
        return named(submap, [item.entry.robot] * len(submap.missions))
