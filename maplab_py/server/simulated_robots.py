"""Robots that are played: their sessions are cut into submaps and pushed as time goes by."""

from __future__ import annotations

import dataclasses
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path

from maplab_py.errors import UserError
from maplab_py.progress import Progress
from maplab_py.server.spool import Spool, push
from maplab_py.storage.mission_names import with_folder_names
from maplab_py.storage.native import find_maps, load_map, save_map
from maplab_py.storage.resources import existing_files, in_map_folder
from maplab_py.vimap import VIMap
from maplab_py.vimap.excerpts import cut_by_time, mission_maps

_LONGEST_SLEEP_S = 0.1


@dataclasses.dataclass(frozen=True, eq=False)
class TimedSubmap:
    """A submap that a robot has finished some time after the start of its session."""

    finished_s: float
    robot: str
    name: str
    vi_map: VIMap
    resource_files: tuple[tuple[Path, Path], ...] = ()
    """With their paths in the submap's resource folder."""


@dataclasses.dataclass(frozen=True, eq=False)
class RecordedSession:
    """A mission of a map on disk, as the session of a robot."""

    vi_map: VIMap
    folder: Path


def recorded_sessions(maps_folder: Path) -> dict[str, RecordedSession]:
    """Return the missions of all maps in a folder and below it, by the name of their robot.

    A robot is named after its mission, else after the folder of its map.

    Raises:
        UserError: There is no map.
        MapError: A map is damaged.
    """
    folders = find_maps(maps_folder)
    if not folders:
        raise UserError(f"--maps_folder={maps_folder}: there is no map in it or below it")
    sessions: dict[str, RecordedSession] = {}
    for folder in folders:
        for part in mission_maps(with_folder_names(load_map(folder)[0], folder)):
            name = str(part.missions.name[0]).replace("/", "_").lstrip(".") or "robot"
            names = (name, *(f"{name}_{number}" for number in range(2, len(sessions) + 3)))
            robot = next(robot for robot in names if robot not in sessions)
            sessions[robot] = RecordedSession(part, folder)
    return sessions


def timed_submaps(
    sessions: Mapping[str, VIMap | RecordedSession], submap_s: float
) -> list[TimedSubmap]:
    """Cut sessions of one mission each into submaps; return them in the order of their ends.

    Args:
        sessions: By the name of their robot.
        submap_s: Length of a submap [s].

    Raises:
        MapError: The file of a resource is missing.
    """
    result = []
    for robot, session in sessions.items():
        folder = session.folder if isinstance(session, RecordedSession) else None
        vi_map = session.vi_map if isinstance(session, RecordedSession) else session
        begin_ns = int(vi_map.vertices.timestamp_ns.min())
        for number, submap in enumerate(cut_by_time(vi_map, submap_s)):
            end_s = 1e-9 * (int(submap.vertices.timestamp_ns.max()) - begin_ns)
            name = f"submap_{number:03d}"
            if folder is None:
                result.append(TimedSubmap(end_s, robot, name, submap))
            else:
                files = tuple(existing_files(submap, folder))
                result.append(TimedSubmap(end_s, robot, name, in_map_folder(submap), files))
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
            save_map(submap.vi_map, path, resource_files=submap.resource_files)
            push(spool, submap.robot, path)
    return time.monotonic() - began
