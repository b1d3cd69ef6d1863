"""Processor time of one submap through the whole server, by stage, while the map grows.

A server runs in this process, its workers in processes of their own, as `serve` has them. The submaps of
two robots are pushed by turns, each when the one before is published. They are cut from maps of
`rovioli`, or of two simulated sessions of 60 s in one room at ten keyframes a second.
"""

import dataclasses
import functools
import resource
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.geometry import alignment, se3
from maplab_py.geometry.interpolation import interpolate_poses
from maplab_py.interop.trajectories import Trajectory, read_trajectory
from maplab_py.server import merging, preparation, publishing, server, spool, submap_sources
from maplab_py.server.options import IncrementalOptions, MapServerOptions, ServiceOptions
from maplab_py.simulation.scenario import MeasurementOptions, Scenario, SessionOptions, WorldOptions
from maplab_py.simulation.simulate import simulate
from maplab_py.simulation.truth import Truth
from maplab_py.storage.native import load_map, save_map
from maplab_py.vimap import VIMap
from tests.support.machine import descendants_cpu_s

_LATEST = 8
"""Submaps whose times are averaged."""


@dataclasses.dataclass(frozen=True)
class ThroughputFigures:
    """Mean processor time per submap [s]; joint optimisations are left out."""

    submaps: str
    vertices: int  # of the map
    keypoints: int
    stages_s: dict[str, float]
    per_submap_s: float


@dataclasses.dataclass(frozen=True)
class ThroughputResult:
    """What became of the map."""

    missions: int
    anchored: int
    landmarks: int
    ate_before_m: float  # before the joint optimisation at the end, which is the only one
    ate_m: float
    joint_s: float  # processor time of that


def scenario() -> Scenario:
    """Return two robots in one room at ten keyframes a second."""
    return Scenario(
        name="two_robots",
        world=WorldOptions(landmarks_per_room=3000),
        measurement=MeasurementOptions(frame_rate_hz=10.0, max_keypoints=250),
        sessions=tuple(
            SessionOptions(kind="loop", duration_s=60.0, turns=1.5, start_turn=0.2 * robot)
            for robot in range(2)
        ),
    )


def measure_throughput(maps_folder: Path | None = None, submap_s: float = 5.0) -> Iterator[str]:
    """Feed a server, and yield what is to be printed.

    Args:
        maps_folder: Maps, a robot each; the trajectory ROBOT.csv beside a map tells where it was. None =
            simulated ones.
        submap_s: Length of a submap [s].
    """
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        if maps_folder is None:
            data = simulate(scenario())
            sessions: dict[str, Any] = {f"robot_{n}": m for n, m in enumerate(data.maps)}
            truth = {f"robot_{n}": _of_session(data.truth, n) for n in range(len(data.maps))}
        else:
            sessions = dict(submap_sources.recorded_sessions(maps_folder))
            truth = {r: read_trajectory(maps_folder / f"{r}.csv") for r in sessions}
        queue = []
        for submap in submap_sources.timed_submaps(sessions, submap_s):
            path = folder / submap.robot / submap.name
            save_map(submap.vi_map, path, resource_files=submap.resource_files)
            queue.append((submap.robot, path))
        run = _Run(folder, queue)
        yield from map(str, run.figures())
        yield str(run.result(truth))


def joint_ate_m(vi_map: VIMap, truth: dict[str, Trajectory]) -> float:
    """Return the RMSE of the positions of all anchored missions after one alignment [m]."""
    estimated, true = [], []
    for row, name in enumerate(vi_map.missions.name):
        if vi_map.baseframes.is_known[vi_map.missions.baseframe[row]]:
            of_mission = vi_map.vertices.mission == row
            times_ns = vi_map.vertices.timestamp_ns[of_mission]
            poses, _ = interpolate_poses(truth[name].times_ns, truth[name].T_R_B, times_ns)
            true.append(poses[:, 4:])
            estimated.append(vi_map.T_G_I[of_mission, 4:])
    p_R, p_G = np.concatenate(true), np.concatenate(estimated)
    T_R_G, _ = alignment.umeyama(p_R, p_G)
    return float(np.sqrt(np.mean(np.sum((p_R - se3.transform(T_R_G, p_G)) ** 2, axis=1))))


def _of_session(truth: Truth, session: int) -> Trajectory:
    mine = truth.sample_mission == session
    return Trajectory(truth.sample_time_ns[mine], truth.sample_T_G_I[mine])


class _Run:
    """Pushes a submap whenever the one before is published, and notes what it took."""

    def __init__(self, folder: Path, queue: list[tuple[str, Path]]) -> None:
        self.spool = spool.Spool(folder / "spool")
        self.server = server.MapServer(
            self.spool,
            MapServerOptions(merged_map_folder=str(folder / "map"), backup_interval_s=0),
            incremental=IncrementalOptions(full_optimization_every_nth=0),
            service=ServiceOptions(),
        )
        self._queue, self._all = queue, len(queue)
        self._stages: list[dict[str, float]] = []
        self._now: dict[str, float] = {}
        self._begin_s: tuple[float, float] | None = None
        self._figures: list[ThroughputFigures] = []
        self._published: VIMap | None = None

    def figures(self) -> list[ThroughputFigures]:
        """Run the server to its end."""
        timed = [
            (preparation.Intake, "advance", "receive"),
            (preparation.Intake, "_prepared", "load"),
            (publishing.Publisher, "publish", "publish"),
            (merging.Merger, "optimize_jointly", "joint"),
        ]
        originals = [(owner, name, getattr(owner, name)) for owner, name, _ in timed]
        for owner, name, stage in timed:
            setattr(owner, name, self._timed(getattr(owner, name), stage))
        try:
            self.server.run(self._goes_on)
        finally:
            for owner, name, original in originals:
                setattr(owner, name, original)
        return self._figures

    def result(self, truth: dict[str, Trajectory]) -> ThroughputResult:
        """Return what became of the map."""
        final, _ = load_map(self.server.publisher.folder)
        known = final.baseframes.is_known[final.missions.baseframe]
        assert self._published is not None
        ate_m = [joint_ate_m(vi_map, truth) for vi_map in (self._published, final)]
        counts = len(known), int(known.sum()), len(final.landmarks)
        return ThroughputResult(*counts, *ate_m, self._now["joint"])

    def _timed(self, function: Callable[..., Any], stage: str) -> Callable[..., Any]:
        @functools.wraps(function)
        def timed(*arguments: Any, **named: Any) -> Any:
            begin = time.process_time()
            try:
                return function(*arguments, **named)
            finally:
                self._now[stage] = self._now.get(stage, 0.0) + time.process_time() - begin

        return timed

    def _goes_on(self) -> bool:
        """Push the next submap when the last one is published; True at the end."""
        if self._begin_s is not None:
            is_merged = len(self.server.steps) == self._all - len(self._queue)
            if not is_merged or self.server.published is self._published:
                return False
            self._note()
        self._published = self.server.published
        if not self._queue:
            return True
        spool.push(self.spool, *self._queue.pop(0))
        self._now = {}
        self._begin_s = _processor_s()
        return False

    def _note(self) -> None:
        assert self._begin_s is not None
        own_s, workers_s = (b - a for a, b in zip(self._begin_s, _processor_s(), strict=True))
        self._begin_s = None
        self._now["receive"] -= self._now["load"]
        stages = {"worker": workers_s, **self._now, **self.server.steps[-1]}
        stages["rest"] = own_s + workers_s - sum(stages.values())
        self._stages.append(stages)
        count = len(self._stages)
        if count % _LATEST and count < self._all:
            return
        latest = self._stages[-_LATEST:]
        mean = {name: round(float(np.mean([s[name] for s in latest])), 3) for name in latest[-1]}
        vi_map = self.server.published
        assert vi_map is not None
        self._figures.append(
            ThroughputFigures(
                f"{max(1, count - _LATEST + 1)} to {count}",
                len(vi_map.vertices),
                len(vi_map.keypoints),
                mean,
                round(sum(mean.values()), 2),
            )
        )


def _processor_s() -> tuple[float, float]:
    """Return the processor time of this process, and of its workers [s]."""
    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time(), descendants_cpu_s() + ended.ru_utime + ended.ru_stime
