"""The state of a server as a report, and its log."""

from __future__ import annotations

import contextlib
import time
from collections import Counter, deque
from pathlib import Path
from typing import TYPE_CHECKING

from maplab_py.progress import Progress
from maplab_py.server.journal import Journal, read_journal
from maplab_py.server.options import EventLine, RobotLine, ServerStatus
from maplab_py.server.spool import Spool
from maplab_py.vimap import VIMap, to_hex_list

if TYPE_CHECKING:
    from maplab_py.server.server import MapServer

_LAST_EVENTS = 8


class Events:
    """The log of a server, one line per event, and its last lines."""

    def __init__(self, path: Path, progress: Progress) -> None:
        """Write to a file and to the terminal."""
        self._path, self._progress = path, progress
        self.last: deque[str] = deque(maxlen=_LAST_EVENTS)

    def add(self, text: str) -> None:
        """Write a line; a full disk does not stop the server."""
        line = f"{time.strftime('%Y-%m-%d %H:%M:%S')}  {text}"
        self.last.append(line)
        self._progress.line(text)
        with (
            contextlib.suppress(OSError),
            self._path.open("a", encoding="utf-8", errors="replace") as log,
        ):
            log.write(line + "\n")


def status_of(
    server: MapServer,
    journal: Journal,
    *,
    incoming: int,
    preparing: int,
    pending: list[str],
    problem: str,
    url: str,
) -> ServerStatus:
    """Return the state of a server that runs.

    Args:
        journal: What is published.
        incoming: Submaps that are not taken yet.
        preparing: Submaps in workers.
        pending: Robots of all submaps that are not published.
        problem: What keeps it from publishing.
        url: Where it answers.
    """
    published_s = server.publisher.published_s
    return _status(
        server.spool,
        journal,
        server.published,
        is_running=True,
        merged_map_folder=str(server.publisher.folder),
        url=url,
        incoming=incoming,
        preparing=preparing,
        pending=pending,
        published_s_ago=None if published_s is None else time.monotonic() - published_s,
        lines=list(server.events.last),
        problem=problem,
    )


def status_without_server(spool: Spool) -> ServerStatus:
    """Return the state of a spool on which no server works.

    Raises:
        UserError: The journal is damaged.
    """
    try:
        lines = spool.log.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    return _status(
        spool,
        read_journal(spool.journal),
        None,
        is_running=False,
        merged_map_folder="",
        url="",
        incoming=len(spool.arrivals()),
        preparing=0,
        pending=[entry.robot for entry in spool.entries()],
        published_s_ago=None,
        lines=lines[-_LAST_EVENTS:],
        problem="",
    )


def _status(
    spool: Spool,
    journal: Journal,
    vi_map: VIMap | None,
    *,
    is_running: bool,
    merged_map_folder: str,
    url: str,
    incoming: int,
    preparing: int,
    pending: list[str],
    published_s_ago: float | None,
    lines: list[str],
    problem: str,
) -> ServerStatus:
    shown = vi_map or VIMap()
    known = shown.baseframes.is_known[shown.missions.baseframe]
    ids = to_hex_list(shown.missions.id)
    anchored = {mission for mission, is_known in zip(ids, known.tolist(), strict=True) if is_known}
    merged = Counter(submap.robot for submap in journal.merged)
    waiting = Counter(pending)
    robots = []
    for robot in sorted({*merged, *waiting}):
        missions = {m for m, name in journal.robots.items() if name == robot} - {*journal.deleted}
        of_robot = len(missions), len(missions & anchored)
        robots.append(RobotLine(robot, *of_robot, merged[robot], waiting[robot]))
    return ServerStatus(
        is_running=is_running,
        spool=spool.root,
        merged_map_folder=merged_map_folder,
        url=url,
        missions=len(shown.missions),
        vertices=len(shown.vertices),
        landmarks=len(shown.landmarks),
        incoming=incoming,
        preparing=preparing,
        waiting=max(len(pending) - preparing, 0),
        merged=len(journal.merged),
        rejected=len(list(spool.rejected.glob("[0-9]*"))),
        since_joint_optimization=journal.since_joint,
        published_s_ago=published_s_ago,
        robots=tuple(robots),
        last_events=tuple(_event(line) for line in lines),
        problem=problem,
    )


def _event(line: str) -> EventLine:
    time_, _, event = line.partition("  ")
    return EventLine(time_, event)
