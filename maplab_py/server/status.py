"""The state of a server as a report, and its log."""

import contextlib
import time
from collections import Counter, deque
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from maplab_py.progress import Progress
from maplab_py.server.journal import Journal, read_journal
from maplab_py.server.options import EventLine, RobotLine, ServerStatus
from maplab_py.server.spool import Spool
from maplab_py.vimap import VIMap, to_hex_list

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


def status_without_server(spool: Spool) -> ServerStatus:
    """Return the state of a spool on which no server works.

    Raises:
        UserError: The journal is damaged.
    """
    try:
        lines = spool.log.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    pending = [entry.robot for entry in spool.entries()]
    journal, incoming = read_journal(spool.journal), len(spool.arrivals())
    return status_of(spool, journal, None, pending, lines[-_LAST_EVENTS:], incoming=incoming)


def status_of(
    spool: Spool,
    journal: Journal,
    vi_map: VIMap | None,
    pending: list[str],
    lines: Iterable[str],
    **others: Any,
) -> ServerStatus:
    """Return the state of a server and its spool.

    Args:
        journal: What is published.
        vi_map: The map that is; None = it is not known.
        pending: Robots of all submaps that are not published.
        lines: The last lines of the log.
        others: Fields of the status that do not follow from these.
    """
    shown = vi_map or VIMap()
    known = shown.baseframes.is_known[shown.missions.baseframe]
    ids = to_hex_list(shown.missions.id)
    anchored = {mission for mission, is_known in zip(ids, known.tolist(), strict=True) if is_known}
    merged, waiting = Counter(submap.robot for submap in journal.merged), Counter(pending)
    robots = []
    for robot in sorted({*merged, *waiting}):
        missions = {m for m, name in journal.robots.items() if name == robot} - {*journal.deleted}
        of_robot = len(missions), len(missions & anchored)
        robots.append(RobotLine(robot, *of_robot, merged[robot], waiting[robot]))
    return ServerStatus(
        spool=spool.root,
        missions=len(shown.missions),
        vertices=len(shown.vertices),
        landmarks=len(shown.landmarks),
        waiting=max(len(pending) - others.get("preparing", 0), 0),
        merged=len(journal.merged),
        rejected=len(list(spool.rejected.glob("[0-9]*"))),
        since_joint_optimization=journal.since_joint,
        robots=tuple(robots),
        last_events=tuple(_event(line) for line in lines),
        **others,
    )


def _event(line: str) -> EventLine:
    time_, _, event = line.partition("  ")
    return EventLine(time_, event)
