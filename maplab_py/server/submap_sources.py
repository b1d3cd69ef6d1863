"""Submaps of robots: from a running odometry, and simulated ones for trials."""

import collections.abc
import dataclasses
import tempfile
import time
from pathlib import Path

from maplab_py.errors import UserError
from maplab_py.frontend.mapping import Mapping
from maplab_py.frontend.odometry_update import OdometryUpdate
from maplab_py.progress import Progress
from maplab_py.server.options import SubmapOutput
from maplab_py.server.spool import Spool, push
from maplab_py.storage.mission_names import with_folder_names
from maplab_py.storage.native import find_maps, load_map, save_map
from maplab_py.storage.resources.store import existing_files, in_map_folder
from maplab_py.vimap import VIMap, excerpts


class SubmapWriter:
    """Observes a run and pushes the map in parts; neighbouring parts share a vertex.

    The states of a part are those that the odometry has when it is pushed. The vertices of a mission that
    was given up after a failure of the odometry are not pushed any more. On runs of hours the map's memory is
    bounded: what was pushed is removed from it.
    """

    def __init__(self, output: SubmapOutput, *, forgets: bool = False) -> None:
        """Prepare; the spool is made at the first part.

        Args:
            output: Where parts go, and how long they are.
            forgets: Remove the vertices of a part from the map of the run when it is pushed.
        """
        assert output.submap_spool is not None
        # is_whole: no vertices were left out
        # pushed: how many parts were pushed
        self.pushed, self.is_whole = 0, True
        self._spool, self._output, self._forgets = Spool(output.submap_spool), output, forgets
        self._mission, self._first, self._begin_ns = -1, 0, 0
        self._start_ns = 0

    def after_frame(self, update: OdometryUpdate, mapping: Mapping) -> None:
        """Push a part when it is long enough."""
        builder = mapping.builder
        if builder is None or update.state is None or not builder.missions:
            return
        newest = len(builder.missions) - 1
        if newest != self._mission:
            self.is_whole &= newest == self._mission + 1 and (
                self._mission < 0 or self._first >= len(builder.missions[self._mission]) - 1
            )
            self._mission, self._first = newest, 0
            self._start_ns = self._begin_ns = update.time_ns
        if update.time_ns - self._begin_ns >= 1e9 * self._output.submap_interval_s:
            builder.missions[-1].refine(mapping.odometry.window_states())
            self._push(mapping)
            self._begin_ns = update.time_ns
            if self._forgets and self._first > 1:
                # two vertices stay, so that there is always a map
                builder.missions[self._mission].forget_before(self._first - 1)
                self._first = 1

    def finish(self, mapping: Mapping) -> None:
        """Push what is left at the end of a run."""
        if self._mission >= 0:
            self._push(mapping)

    def _push(self, mapping: Mapping) -> None:
        builder = mapping.builder
        if builder is None or self._first >= len(builder.missions[self._mission]):
            return
        submap = builder.make_part(self._mission, self._first)
        if submap is None:
            return
        submap = excerpts.with_ids_of_times(submap, f"{self._output.robot_name} {self._start_ns}")
        name = f"{self._start_ns}_submap_{self.pushed:03d}"
        with tempfile.TemporaryDirectory() as folder:
            save_map(submap, Path(folder) / name)
            push(self._spool, self._output.robot_name, Path(folder) / name)
        self.pushed += 1
        self._first = len(builder.missions[self._mission]) - 1


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
        for part in excerpts.mission_maps(with_folder_names(load_map(folder)[0], folder)):
            name = str(part.missions.name[0]).replace("/", "_").lstrip(".") or "robot"
            names = (name, *(f"{name}_{number}" for number in range(2, len(sessions) + 3)))
            robot = next(robot for robot in names if robot not in sessions)
            sessions[robot] = RecordedSession(part, folder)
    return sessions


def timed_submaps(
    sessions: collections.abc.Mapping[str, VIMap | RecordedSession], submap_s: float
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
        for number, submap in enumerate(excerpts.cut_by_time(vi_map, submap_s)):
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
