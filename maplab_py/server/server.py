"""The map server: one loop that takes submaps from a spool and merges them into a map.

A submap goes through these states; each arrow is one rename, or one replaced file:

    incoming --accept--> accepted --prepare (worker)--> prepared --merge--> in memory
        --publish (map folder replaced)--> in the map --journal, rename--> merged
    any of them --refused, with a reason--> rejected

A kill between two arrows loses only what was in memory. At the next start the map says which submaps
it has (their vertices are in it); these move on to `merged`, the others are merged again.

Submaps of a robot are merged in the order in which they came; one that adjoins nothing of its mission
waits for its neighbour. The loop itself is the only one that changes map, journal and spool; workers
write into the folder of their submap, threads of the service read a published value.
"""

import dataclasses
import logging
import queue
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

import numpy as np

from maplab_py.algorithms.pose_graph_manipulation.stationary_options import StationaryOptions
from maplab_py.errors import Cancelled, MaplabError, UserError
from maplab_py.progress import SILENT, Progress
from maplab_py.server import options as server_options
from maplab_py.server.journal import Journal, MergedSubmap, recover, write_journal
from maplab_py.server.merging import Merger, stretches_of
from maplab_py.server.preparation import Intake, Item, Preparation
from maplab_py.server.publishing import Display, Publisher, pause_s
from maplab_py.server.service import Service, answers
from maplab_py.server.spool import Spool, locked_spool
from maplab_py.server.status import Events, status_of
from maplab_py.vimap import VIMap, edits, to_hex_list

logger = logging.getLogger(__name__)

_SECONDS_BETWEEN_LOOKS = 0.2
_SECONDS_BETWEEN_RETRIES = 5.0


class MapServer:
    """A map server; see the module."""

    def __init__(
        self,
        spool: Spool,
        options: server_options.MapServerOptions,
        *,
        stationary: StationaryOptions | None = None,
        incremental: server_options.IncrementalOptions | None = None,
        service: server_options.ServiceOptions | None = None,
        progress: Progress = SILENT,
        watch: Callable[[VIMap], None] | None = None,
        shown_at: str = "",
    ) -> None:
        """Prepare; nothing is read or written yet.

        Args:
            spool: Where submaps come from.
            options: With maplab's names; the folder of the map is required.
            stationary: When a submap stands still.
            incremental: What is optimised when.
            service: Where the service listens, and what is kept.
            watch: Gets every published map.
            shown_at: Address of the page that shows it, for the log.

        Raises:
            UserError: The folder of the map is missing.
        """
        if not options.merged_map_folder:
            raise UserError("--maplab_server_merged_map_folder is required: where the map goes")
        self.spool, self.options = spool, options
        self.incremental = incremental or server_options.IncrementalOptions()
        self.service = service or server_options.ServiceOptions()
        self.publisher = Publisher(options)
        self.journal = Journal()
        self.events = Events(spool.log, progress)
        self.published: VIMap | None = None
        self.steps: list[dict[str, float]] = []
        self._merger = self._new_merger()
        self._stationary = stationary or StationaryOptions()
        self._progress, self._shown_at = progress, shown_at
        self._display = Display(watch, self.service.visualization_interval_s)
        self._requests: queue.Queue[tuple[Callable[[], Any], Future[Any]]] = queue.Queue()
        self._is_stopping = False
        self._problem, self._logged_problems = "", set[str]()
        self._retry_s = 0.0
        self._merged_count = self._joint_count = 0
        self._url = ""
        self._wake = threading.Event()

    # -- from the outside -----------------------------------------------------------------------

    def run(self, is_to_end: Callable[[], bool] = lambda: False) -> server_options.ServeReport:
        """Serve until it is asked to stop; then optimise jointly, and publish.

        Raises:
            UserError: Another server works on the spool, or folder, journal or address cannot be used.
            Cancelled: The user does not want to wait for the end. The published map is valid.
        """
        began = time.monotonic()
        self.spool.make()
        with locked_spool(self.spool):
            preparation = Preparation(self.spool, self.options, self._stationary)
            self._intake = Intake(self.spool, preparation, self.publisher, self.events)
            try:
                self._recover()
                reads, writes = answers(self)
                address, port = self.service.address, self.service.port
                file = self.spool.address
                with Service(reads, writes, address=address, port=port, file=file) as service:
                    self._url = service.url
                    shown = f"; its map is shown at {self._shown_at}" if self._shown_at else ""
                    self.events.add(f"serving {self.spool.root}: {service.url}{shown}")
                    self._serve(is_to_end)
            finally:
                preparation.stop()
        return self._report(time.monotonic() - began)

    def stop(self) -> None:
        """Ask the server to stop soon; any thread may call this."""
        self._is_stopping = True
        self._wake.set()

    def call(self, function: Callable[[], Any]) -> Any:
        """Let the loop call a function between two steps, and return its result."""
        future: Future[Any] = Future()
        self._requests.put((function, future))
        self._wake.set()
        return future.result()

    def status(self) -> server_options.ServerStatus:
        """Return the present state.

        What has arrived is counted first, and what is accepted on disk: a submap that moves on meanwhile is
        counted twice, and never as if it were done.
        """
        incoming = len(self.spool.arrivals())
        preparing = sum(item.is_preparing for item in list(self._intake.items.values()))
        entries = {entry.number: entry.robot for entry in self.spool.entries()}
        merged = tuple(m for m in self.journal.merged if m.number not in entries)
        published_s = self.publisher.published_s
        return status_of(
            self.spool,
            dataclasses.replace(self.journal, merged=merged),
            self.published,
            list(entries.values()),
            list(self.events.last),
            is_running=True,
            merged_map_folder=str(self.publisher.folder),
            url=self._url,
            incoming=incoming,
            preparing=preparing,
            published_s_ago=None if published_s is None else time.monotonic() - published_s,
            problem=self._problem,
        )

    def delete_missions(self, ids: set[str]) -> server_options.DeletedMissions:
        """Remove missions from the map for good, and publish; their later submaps are refused.

        Called by the loop. Where the disk refuses, the map is published without them later.

        Raises:
            UserError: A mission is not in the map.
        """
        vi_map = self._merger.vi_map
        known = to_hex_list(vi_map.missions.id) if vi_map is not None else []
        if not ids or ids - set(known):
            missing = ", ".join(sorted(ids - set(known))) or "given"
            raise UserError(f"no mission {missing} is in the map")
        assert vi_map is not None
        mask = np.isin(known, sorted(ids))
        vertices = int(np.count_nonzero(mask[vi_map.vertices.mission]))
        self.journal = self.journal.without_missions(ids)
        write_journal(self.journal, self.spool.journal)
        left = None if mask.all() else edits.remove_missions(vi_map, mask)
        self._restore(left)
        self._publish()
        self.events.add(f"deleted mission {', '.join(sorted(ids))}")
        return server_options.DeletedMissions(tuple(sorted(ids)), vertices)

    # -- the loop -------------------------------------------------------------------------------

    def _recover(self) -> None:
        recovered = recover(self.spool, self.publisher.folder)
        self.journal = recovered.journal
        self._restore(recovered.vi_map)
        self.published = recovered.vi_map
        for note in recovered.notes:
            self.events.add(note)
        self._intake.take_up()
        write_journal(self.journal, self.spool.journal)
        if recovered.is_changed:
            self._publish()
        else:
            self._display.offer(self.published)

    def _new_merger(self) -> Merger:
        return Merger(self.options, self.incremental, map_folder=self.publisher.folder)

    def _restore(self, vi_map: VIMap | None) -> None:
        stretches = [s for submap in self.journal.merged for s in submap.stretches]
        self._merger = self._new_merger()
        self._merger.radius = self.journal.radius
        if vi_map is not None:
            self._merger.restore(vi_map, stretches)

    def _serve(self, is_to_end: Callable[[], bool]) -> None:
        idle_s, busy_s = self.service.stop_when_idle_s, time.monotonic()
        while not self._is_stopping and not is_to_end():
            self._progress.check()
            has_worked = self._step(lambda: self._is_stopping or is_to_end())
            if has_worked or self._is_busy():
                busy_s = time.monotonic()
            elif idle_s and time.monotonic() - busy_s >= idle_s:
                break
            self._display.show()
            if not has_worked:
                self._wake.wait(_SECONDS_BETWEEN_LOOKS)
                self._wake.clear()
        self._answer_requests()
        if self.service.save_on_shutdown:
            self._finish()
        self._display.show(at_once=True)

    def _finish(self) -> None:
        """Optimise jointly, and publish."""
        self._retry_s = 0.0
        if self.journal.since_joint:
            self._publish_if_needed(force=True)
            self._optimize_jointly(self._progress)
        self._retry_s = 0.0
        self._publish_if_needed(force=True, compress=True)

    def _is_busy(self) -> bool:
        """Tell whether a submap is being prepared, or copied."""
        items = self._intake.items.values()
        unprepared = any(item.submap is None and item.merged is None for item in items)
        return unprepared or bool(self.spool.arrivals())

    def _step(self, is_to_end: Callable[[], bool]) -> bool:
        """Do what comes next; False where there is nothing to do."""
        problem = self._intake.advance(self.journal)
        if problem:
            self._fail(problem)
        elif self._merger.vi_map is self.published:
            self._problem = ""
        self._answer_requests()
        if self._problem and not self._publish_if_needed(force=True):
            return False
        item = self._next_ready()
        if item is not None:
            self._merge(item)
            nth = self.incremental.full_optimization_every_nth
            if nth and self.journal.since_joint >= nth:
                self._publish_if_needed(force=True)  # a joint optimisation may take minutes
                self._optimize_jointly(self._progress)
            self._publish_if_needed(force=False)
            return True
        if self._publish_if_needed(force=True):
            return True
        if self.incremental.full_optimization_every_nth > 0 and self.journal.since_joint > 0:
            pause = _Pause(self._progress, lambda: is_to_end() or self._has_work())
            if self._optimize_jointly(pause):
                self._publish_if_needed(force=True, compress=True)
                return True
        self._back_up()
        return False

    def _answer_requests(self) -> None:
        while True:
            try:
                function, future = self._requests.get_nowait()
            except queue.Empty:
                return
            try:
                future.set_result(function())
            except MaplabError as error:
                future.set_exception(error)

    def _next_ready(self) -> Item | None:
        """Return the next submap to be merged; those that can never be are rejected."""
        preparing: set[str] = set()
        for item in sorted(self._intake.items.values(), key=lambda i: i.entry.number):
            robot = item.entry.robot
            if item.merged is not None or robot in preparing:
                continue
            if item.submap is None:
                preparing.add(robot)
                continue
            reason = self._why_not(item)
            if reason:
                self._reject(item, reason)
            elif not item.waits_for_neighbour:
                return item
        return None

    def _why_not(self, item: Item) -> str:
        """Return why a submap must be refused; also note whether it must wait."""
        submap, vi_map = item.submap, self._merger.vi_map
        assert submap is not None
        for mission in to_hex_list(submap.missions.id):
            robot = self.journal.robots.get(mission, item.entry.robot)
            if robot != item.entry.robot:
                return (
                    f"mission {mission} comes from robot {robot} already: give it an id of its own"
                )
            if mission in self.journal.deleted:
                return f"mission {mission} was deleted"
        item.waits_for_neighbour = False
        if vi_map is None:
            return ""
        rows = vi_map.vertex_index.rows(submap.vertices.id)
        if (rows >= 0).all():
            return "brings no vertex that the map does not have"
        known = vi_map.mission_index.rows(submap.missions.id) >= 0
        shared = np.bincount(submap.vertices.mission[rows >= 0], minlength=len(known)) > 0
        if (known & ~shared).any():
            item.waits_for_neighbour = True
        return ""

    def _merge(self, item: Item) -> None:
        entry, submap = item.entry, item.submap
        assert submap is not None
        is_new_robot = entry.robot not in self.journal.robots.values()
        try:
            steps = self._merger.add(submap, progress=self._progress)
        except Cancelled:
            raise
        except MaplabError as error:
            self._reject(item, str(error))
            return
        except Exception:  # a bug must not come back with the same submap at every start
            logger.exception("%s", entry.title)
            self._reject(item, "failed with an internal error: see the log of the console")
            return
        stretches = tuple(stretches_of(submap))
        item.merged = MergedSubmap(entry.number, entry.robot, entry.name, entry.sha256, stretches)
        item.submap = None
        self.journal = self.journal.with_merged(item.merged, joint_is_due=steps.joint_is_due)
        self._reset_trust_region(is_new_robot)
        self._merged_count += 1
        self.steps.append(steps.seconds)
        anchored = "".join(f", anchored mission {mission[:8]}" for mission in steps.anchored)
        self.events.add(
            f"{entry.title}: merged, {steps.landmarks_merged} landmarks joined, "
            f"{steps.free_vertices} vertices optimised in {sum(steps.seconds.values()):.1f} s{anchored}"
            + (f"; no loops were closed: {steps.note}" if steps.note else "")
        )

    def _reset_trust_region(self, is_new_robot: bool) -> None:
        nth = self.options.reset_trust_region_radius_every_nth_submap
        is_nth = bool(nth) and self.journal.since_reset >= nth
        if is_nth or (is_new_robot and self.options.reset_trust_region_radius_if_new_robot):
            self._merger.radius = 0.0
            self.journal = dataclasses.replace(self.journal, since_reset=0, radius=0.0)

    def _optimize_jointly(self, progress: Progress) -> bool:
        """Optimise the whole map; False where new work has interrupted it."""
        try:
            moved_m = self._merger.optimize_jointly(progress=progress)
            note = f"; {self._merger.note}" if self._merger.note else ""
            self.events.add(f"optimised jointly: the largest move is {moved_m:.3f} m{note}")
            self._joint_count += 1
        except _Interrupted:
            return False
        except Cancelled:
            raise
        except MaplabError as error:
            self.events.add(f"not optimised jointly: {error}")
        self.journal = dataclasses.replace(
            self.journal, since_joint=0, joint_is_due=False, radius=self._merger.radius
        )
        return True

    def _has_work(self) -> bool:
        return self._intake.has_work() or not self._requests.empty()

    def _publish_if_needed(self, *, force: bool, compress: bool = False) -> bool:
        """Publish the map where it has changed; True where it was published."""
        vi_map = self._merger.vi_map
        is_published = vi_map is self.published and not (compress and self._must_be_compressed())
        if vi_map is None or is_published or time.monotonic() < self._retry_s:
            return False
        last_s = self.publisher.published_s
        is_time = last_s is None or time.monotonic() - last_s >= pause_s(self.publisher.duration_s)
        return (force or is_time) and self._publish(compress=compress)

    def _must_be_compressed(self) -> bool:
        return not self.publisher.is_compressed and self.publisher.published_s is not None

    def _publish(self, *, compress: bool = False) -> bool:
        """Publish map and journal; submaps that they have now are finished."""
        vi_map = self._merger.vi_map
        try:
            if vi_map is None:
                self.publisher.remove()
            else:
                self.publisher.publish(vi_map, compress=compress)
            write_journal(self.journal, self.spool.journal)
            for number, item in list(self._intake.items.items()):
                if item.merged is not None:
                    self.spool.finish(item.entry, keep=self.service.keep_submaps)
                    del self._intake.items[number]
        except (OSError, UserError) as error:
            self._fail(f"the map cannot be published: {error}")
            self._retry_s = time.monotonic() + _SECONDS_BETWEEN_RETRIES
            return False
        self.published, self._problem = vi_map, ""
        waiting = tuple(f"{item.entry.title}: " for item in self._intake.items.values())
        self._logged_problems = {p for p in self._logged_problems if p.startswith(waiting)}
        self._display.offer(vi_map)
        return True

    def _fail(self, problem: str) -> None:
        """Say a problem with the disk, each once until it has gone."""
        if problem not in self._logged_problems:
            self.events.add(problem)
        self._logged_problems.add(problem)
        self._problem = problem

    def _reject(self, item: Item, reason: str) -> None:
        problem = self._intake.reject(item, reason)
        if problem:
            self._fail(problem)

    def _back_up(self) -> None:
        try:
            folder = self.publisher.back_up()
        except OSError as error:
            self.events.add(f"no backup was made: {error}")
            return
        if folder is not None:
            self.events.add(f"backup {folder}")

    def _report(self, seconds: float) -> server_options.ServeReport:
        vi_map = self._merger.vi_map or VIMap()
        return server_options.ServeReport(
            str(self.publisher.folder),
            self._merged_count,
            self._intake.rejected,
            sum(item.merged is None for item in self._intake.items.values()),
            len(vi_map.missions),
            len(vi_map.vertices),
            len(vi_map.landmarks),
            self._joint_count,
            seconds,
            self._problem,
        )


class _Interrupted(Cancelled):
    """New work has come."""


class _Pause:
    """Progress of work that makes room when new work comes."""

    def __init__(self, progress: Progress, has_work: Callable[[], bool]) -> None:
        self._progress, self._has_work = progress, has_work
        self._next_s = 0.0

    def step(self, done: float, total: float, what: str = "") -> None:
        self._progress.step(done, total, what)
        self.check()

    def line(self, text: str) -> None:
        self._progress.line(text)

    def check(self) -> None:
        self._progress.check()
        if time.monotonic() >= self._next_s:
            self._next_s = time.monotonic() + _SECONDS_BETWEEN_LOOKS
            if self._has_work():
                raise _Interrupted("new work has come")
