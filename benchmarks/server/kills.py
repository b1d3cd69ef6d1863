"""Four robots, forty submaps, and a server that is killed at random moments.

Real processes: `serve` is killed by SIGKILL, its workers with it, and started again. The submaps are
pushed by this process. In the end every vertex must be in the map once, and the error of the map is
compared with that of the same submaps joined offline: load_merge_all_submaps of each robot, elq,
optvi, anchors, lc, optvi.
"""

import dataclasses
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from maplab_py.console.commands.registry import load_registry
from maplab_py.console.session.session import Session
from maplab_py.server import journal, spool
from maplab_py.simulation.evaluation import evaluate_map
from maplab_py.simulation.scenario import MeasurementOptions, Scenario, SessionOptions, WorldOptions
from maplab_py.simulation.simulate import SimulatedData, simulate
from maplab_py.storage.native import load_map, save_map
from maplab_py.vimap.excerpts import cut_by_time

ROBOTS, SUBMAP_S = 4, 4.0
_LONGEST_S = 3600.0
_LONGEST_DELAY_S = 15.0
"""The server is killed up to so long after a random number of submaps was merged."""


@dataclasses.dataclass(frozen=True)
class KillFigures:
    """What is left of forty submaps after so many kills."""

    kills: int
    submaps: int
    missing_vertices: int
    repeated_vertices: int
    rejected: int
    ate_m: float
    ate_offline_m: float
    ratio: float
    slowest_s: float  # from a drop to its publication, time in which no server ran left out
    median_s: float
    seconds: float


def scenario(submaps_each: int) -> Scenario:
    """Return four robots in one room."""
    sessions = tuple(
        SessionOptions(
            kind="loop",
            duration_s=submaps_each * SUBMAP_S,
            turns=1.3,
            start_turn=0.2 * robot,
            reverse=robot == 3,
        )
        for robot in range(ROBOTS)
    )
    return Scenario(
        name="four_robots",
        world=WorldOptions(landmarks_per_room=3000),
        measurement=MeasurementOptions(frame_rate_hz=3.0, max_keypoints=150),
        sessions=sessions,
    )


def measure_kills(kills: int = 20, *, submaps_each: int = 10, seed: int = 1) -> KillFigures:
    """Push the submaps, kill the server so many times, and look at the map."""
    data, rng = simulate(scenario(submaps_each)), random.Random(seed)
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        run = _Run(Path(folder), data, rng)
        run.play(kills)
        vi_map, _ = load_map(run.map_folder)
        rejected = len(list(run.spool.rejected.glob("[0-9]*")))
    expected = np.concatenate([m.vertices.id for m in data.maps])
    rows = vi_map.vertex_index.rows(expected)
    ate = evaluate_map(vi_map, data.truth).ate_m
    offline = offline_ate_m(data)
    waits = list(run.waits_s.values())
    return KillFigures(
        run.kills,
        len(waits),
        int(np.count_nonzero(rows < 0)),
        len(vi_map.vertices) - len(np.unique(vi_map.vertices.id, axis=0)),
        rejected,
        ate,
        offline,
        ate / offline,
        max(waits),
        float(np.median(waits)),
        time.monotonic() - began,
    )


def offline_ate_m(data: SimulatedData) -> float:
    """Return the error of the same submaps after the usual commands on all of them at once."""
    with tempfile.TemporaryDirectory() as folder, Session(load_registry()) as session:
        for robot, vi_map in enumerate(data.maps):
            for number, submap in enumerate(cut_by_time(vi_map, SUBMAP_S)):
                save_map(submap, Path(folder) / f"robot_{robot}" / f"submap_{number:02d}")
        session.run("load_merge_all_submaps", maps_folder=Path(folder))
        session.run("elq")
        session.run("optvi")
        session.run("set_mission_baseframe_to_known", map_mission="")
        session.run("anchor_all_missions")
        session.run("lc")
        session.run("optvi")
        return float(evaluate_map(session.vi_map, data.truth).ate_m)


class _Run:
    """One server after the other on one spool."""

    def __init__(self, folder: Path, data: SimulatedData, rng: random.Random) -> None:
        self.spool, self.map_folder = spool.Spool(folder / "spool"), folder / "city"
        self.kills = 0
        self.waits_s: dict[str, float] = {}
        self._rng = rng
        self._queue: list[tuple[str, Path]] = []
        pairs = [cut_by_time(vi_map, SUBMAP_S) for vi_map in data.maps]
        for number in range(max(map(len, pairs))):
            for robot, submaps in enumerate(pairs):
                if number < len(submaps):
                    path = folder / "robots" / f"robot_{robot}" / f"submap_{number:02d}"
                    save_map(submaps[number], path)
                    self._queue.append((f"robot_{robot}", path))
        self._dropped_s: dict[str, float] = {}
        self._serving_s = 0.0  # sum over all servers
        self._total = len(self._queue)

    def play(self, kills: int) -> None:
        """Drop, serve, kill, until all submaps are in the map and the server has ended by itself."""
        deadline = time.monotonic() + _LONGEST_S
        server = self._start()
        moments = sorted(self._rng.uniform(0.0, self._total) for _ in range(kills))
        wait_s, last_s = self._rng.uniform(0.0, _LONGEST_DELAY_S), time.monotonic()
        while len(self.waits_s) < self._total or self.kills < kills:
            if time.monotonic() > deadline:
                raise TimeoutError(f"{len(self.waits_s)} of {self._total} after {_LONGEST_S} s")
            time.sleep(0.1)
            now_s = time.monotonic()
            self._serving_s += now_s - last_s
            is_reached = self.kills < kills and len(self.waits_s) >= moments[self.kills]
            wait_s -= (now_s - last_s) * is_reached
            last_s = now_s
            self._drop()
            self._look()
            if is_reached and wait_s <= 0.0:
                server.send_signal(signal.SIGKILL)
                server.wait()
                self.kills += 1
                server = self._start()
                wait_s, last_s = self._rng.uniform(0.0, _LONGEST_DELAY_S), time.monotonic()
        while self._serving_process() != server.pid:  # Ctrl-C would end it before it serves
            time.sleep(0.1)
        server.send_signal(signal.SIGINT)
        if server.wait(_LONGEST_S) != 0:
            raise RuntimeError(f"the server ended with status {server.returncode}")

    def _serving_process(self) -> int:
        try:
            return int(json.loads(self.spool.address.read_text())["process"])
        except (OSError, ValueError):
            return 0

    def _drop(self) -> None:
        """Push the next submap when few are waiting."""
        if self._queue and len(self._dropped_s) - len(self.waits_s) < 3:
            robot, path = self._queue.pop(0)
            spool.push(self.spool, robot, path)
            self._dropped_s[f"{robot}/{path.name}"] = self._serving_s

    def _look(self) -> None:
        for submap in journal.read_journal(self.spool.journal).merged:
            if submap.title not in self.waits_s:
                self.waits_s[submap.title] = self._serving_s - self._dropped_s[submap.title]

    def _start(self) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [
                sys.executable,
                "-m",
                "maplab_py",
                "serve",
                f"--spool={self.spool.root}",
                f"--maplab_server_merged_map_folder={self.map_folder}",
                "--maplab_server_submap_loading_thread_pool_size=2",
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "NUMBA_NUM_THREADS": "1"},
        )
