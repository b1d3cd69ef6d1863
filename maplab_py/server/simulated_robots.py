"""Robots that are simulated: their sessions are cut into submaps and pushed as time goes by."""

from __future__ import annotations

import dataclasses
import tempfile
import time
from pathlib import Path

from maplab_py.progress import Progress
from maplab_py.server.spool import Spool, push
from maplab_py.storage.native import save_map
from maplab_py.vimap import VIMap
from maplab_py.vimap.excerpts import cut_by_time

_LONGEST_SLEEP_S = 0.1


@dataclasses.dataclass(frozen=True, eq=False)
class TimedSubmap:
    """A submap that a robot has finished some time after the start of its session."""

    finished_s: float
    robot: str
    name: str
    vi_map: VIMap


def timed_submaps(sessions: dict[str, VIMap], submap_s: float) -> list[TimedSubmap]:
    """Cut sessions of one mission each into submaps; return them in the order of their ends.

    Args:
        sessions: Maps by the name of their robot.
        submap_s: Length of a submap [s].
    """
    result = []
    for robot, session in sessions.items():
        begin_ns = int(session.vertices.timestamp_ns.min())
        for number, submap in enumerate(cut_by_time(session, submap_s)):
            end_s = 1e-9 * (int(submap.vertices.timestamp_ns.max()) - begin_ns)
            result.append(TimedSubmap(end_s, robot, f"submap_{number:03d}", submap))
    return sorted(result, key=lambda submap: (submap.finished_s, submap.robot))


def play(submaps: list[TimedSubmap], spool: Spool, rate: float, progress: Progress) -> float:
    """Push submaps when their time has come; return the time it took [s].

    Raises:
        UserError: The disk refuses.
        Cancelled: The user has asked to stop.
    """
    spool.make()
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        for number, submap in enumerate(submaps):
            while rate and submap.finished_s / rate > time.monotonic() - began:
                progress.check()
                left = submap.finished_s / rate - (time.monotonic() - began)
                time.sleep(max(0.0, min(left, _LONGEST_SLEEP_S)))
            progress.step(number, len(submaps), f"{submap.robot}/{submap.name}")
            path = Path(folder) / submap.robot / submap.name
            save_map(submap.vi_map, path)
            push(spool, submap.robot, path)
    return time.monotonic() - began
