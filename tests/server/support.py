"""Small submaps of two robots, and servers whose workers are functions of this process."""

import contextlib
import dataclasses
import importlib
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from maplab_py.errors import MaplabError
from maplab_py.pipeline.messages import Ending, Outcome
from maplab_py.server.options import IncrementalOptions, MapServerOptions, ServiceOptions
from maplab_py.server.preparation import WorkerPool
from maplab_py.server.server import MapServer
from maplab_py.server.spool import Spool, push
from maplab_py.server.worker import SubmapOrder
from maplab_py.simulation.scenario import MeasurementOptions, Scenario, SessionOptions, WorldOptions
from maplab_py.storage.native import load_map, save_map
from maplab_py.vimap import VIMap, excerpts
from tests.simulation.small import simulated

TWO_ROBOTS = Scenario(
    name="two_robots",
    world=WorldOptions(landmarks_per_room=1200),
    measurement=MeasurementOptions(frame_rate_hz=3.0, max_keypoints=120),
    sessions=(
        SessionOptions(duration_s=9.0, turns=0.6),
        SessionOptions(duration_s=9.0, turns=0.6, start_turn=0.1),
    ),
)
ROBOTS = ("ant", "bee")


class Killed(BaseException):
    """The process ends here."""


def dies_in(patch: pytest.MonkeyPatch, owner: Any, name: str, at_call: int, *, after: bool) -> None:
    """Let a process die before or after a call of a function."""
    original: Callable[..., Any] = getattr(owner, name)
    calls = [0]

    def dying(*arguments: Any, **named: Any) -> Any:
        calls[0] += 1
        if calls[0] == at_call and not after:
            raise Killed
        result = original(*arguments, **named)
        if calls[0] == at_call:
            raise Killed
        return result

    patch.setattr(owner, name, dying)


Execute = Callable[[SubmapOrder, Callable[[], bool]], Outcome]


def submaps(robot: str) -> list[VIMap]:
    """Return the three submaps of a robot."""
    return excerpts.cut_by_time(simulated(TWO_ROBOTS).maps[ROBOTS.index(robot)], 3.0)


def session(robot: str) -> VIMap:
    """Return the whole session of a robot."""
    return simulated(TWO_ROBOTS).maps[ROBOTS.index(robot)]


def put(spool: Spool, robot: str, submap: VIMap, name: str, scratch: Path) -> Path:
    """Push a submap."""
    folder = scratch / robot / name
    save_map(submap, folder, force=True)
    return push(spool, robot, folder)


def copying(order: SubmapOrder, is_cancelled: Callable[[], bool]) -> Outcome:
    """Do a worker's work without its optimisation: check a submap and copy it."""
    try:
        load_map(order.submap)
    except MaplabError as error:
        return Outcome(order.title, Ending.REFUSED, str(error))
    shutil.rmtree(order.result, ignore_errors=True)
    shutil.copytree(order.submap, order.result)
    return Outcome(order.title, Ending.DONE)


class Servers:
    """Servers on one spool, one after the other."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.scratch = folder / "scratch"
        self.spool = Spool(folder / "spool", quiet_s=0.3)
        self.map_folder = folder / "city"
        self.options = MapServerOptions(
            merged_map_folder=str(self.map_folder),
            enable_visual_loop_closure=False,
            enable_visual_loop_closure_based_map_anchoring=False,
            backup_interval_s=0,
        )
        self.service = ServiceOptions(stop_when_idle_s=0.5)
        self.incremental = IncrementalOptions(full_optimization_every_nth=0)
        self._monkeypatch = monkeypatch
        self.work(copying)

    def work(self, execute: Execute) -> None:
        """Let workers do something else."""

        def run(_: WorkerPool, order: SubmapOrder, is_cancelled: Callable[[], bool]) -> Outcome:
            return execute(order, is_cancelled)

        self._monkeypatch.setattr(WorkerPool, "run", run)

    def put(self, robot: str, number: int, submap: VIMap | None = None, name: str = "") -> Path:
        """Push a submap of a robot, or another one in its name."""
        value = submaps(robot)[number] if submap is None else submap
        return put(self.spool, robot, value, name or f"submap_{number}", self.scratch)

    def make(self, **options: object) -> MapServer:
        """Return a server."""
        changed = dataclasses.replace(self.options, **options)  # type: ignore[arg-type]
        return MapServer(self.spool, changed, incremental=self.incremental, service=self.service)

    def run(self) -> MapServer:
        """Run a server until it has nothing to do."""
        server = self.make()
        server.run()
        return server

    def run_until_killed(self, owner: Any, name: str, call: int, *, after: bool) -> None:
        """Run a server that dies before or after a call of a function, if it gets there."""
        with pytest.MonkeyPatch.context() as patch:
            if isinstance(owner, str):
                owner = importlib.import_module(owner)
            dies_in(patch, owner, name, call, after=after)
            with contextlib.suppress(Killed):
                self.run()

    def published(self) -> VIMap:
        """Return the published map."""
        return load_map(self.map_folder)[0]

    def reasons(self) -> list[str]:
        """Return the reasons of rejected submaps, in their order."""
        files = sorted(self.spool.rejected.glob("*/reason.txt"))
        return [file.read_text(encoding="utf-8").strip() for file in files]

    def check_whole(self, *robots: str) -> None:
        """Check that the published map has every vertex of the robots' sessions once."""
        vi_map = self.published()
        expected = np.concatenate([session(robot).vertices.id for robot in robots])
        assert len(vi_map.vertices) == len(expected)
        assert (vi_map.vertex_index.rows(expected) >= 0).all()
        assert len(vi_map.imu_edges) == len(expected) - len(robots)


@pytest.fixture
def servers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Servers:
    return Servers(tmp_path, monkeypatch)
