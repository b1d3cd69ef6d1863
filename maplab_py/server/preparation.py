"""Preparation of submaps: each is checked and optimised by itself in a worker process."""

from __future__ import annotations

import contextlib
import hashlib
import os
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np

from maplab_py.algorithms.pose_graph_manipulation.stationary_options import StationaryOptions
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.atomic import write_file
from maplab_py.errors import MapError, MaplabError
from maplab_py.pipeline.fingerprint import program_version
from maplab_py.pipeline.orders import Outcome
from maplab_py.server.options import SubmapOptions
from maplab_py.server.spool import Entry, Spool
from maplab_py.server.worker import SubmapOrder
from maplab_py.server.worker_pool import WorkerPool
from maplab_py.storage.native import is_map_folder
from maplab_py.vimap import VIMap
from maplab_py.vimap.ids import to_hex
from maplab_py.vimap.queries import has_link

_MAX_IMU_STEP_NS = 1_000_000_000
"""IMU samples that are farther apart are those of a clock that jumped."""
_NOTE = "prepared.sha256"
_GATE_SIGMA = VIOptimizationOptions().absolute_pose_gate_sigma


class Preparation:
    """Gives submaps to workers, a few at a time."""

    def __init__(self, spool: Spool, options: SubmapOptions, stationary: StationaryOptions) -> None:
        """Start without workers."""
        self._spool, self._options, self._stationary = spool, options, stationary
        workers = options.submap_loading_thread_pool_size
        self._workers = WorkerPool(max(1, (os.cpu_count() or 1) // workers))
        self._threads = ThreadPoolExecutor(workers, thread_name_prefix="prepare")
        self._is_stopping = False

    def start(self, entry: Entry) -> Future[Outcome]:
        """Prepare a submap; the result is in `prepared` of its folder, what was wrong in the outcome."""
        order = self._order(entry)
        return self._threads.submit(self._workers.run, order, lambda: self._is_stopping)

    def note(self, entry: Entry) -> None:
        """Note how the result of a submap was made, so that a later server can use it."""
        with contextlib.suppress(MaplabError, OSError):  # it is made again
            write_file(self._spool.folder(entry) / _NOTE, [self._key(entry).encode()])

    def is_done(self, entry: Entry) -> bool:
        """Tell whether there is a result that this server would make in the same way."""
        folder = self._spool.folder(entry)
        try:
            is_noted = (folder / _NOTE).read_text(encoding="utf-8") == self._key(entry)
        except (OSError, ValueError):
            return False
        return is_noted and is_map_folder(folder / "prepared")

    def stop(self) -> None:
        """Kill what runs, and wait for its end."""
        self._is_stopping = True
        self._threads.shutdown(wait=True, cancel_futures=True)
        self._workers.stop()

    def _key(self, entry: Entry) -> str:
        return hashlib.sha256(
            f"{program_version()}\n{self._order(entry).as_line()}".encode(
                "utf-8", "surrogateescape"
            )
        ).hexdigest()

    def _order(self, entry: Entry) -> SubmapOrder:
        folder = self._spool.folder(entry)
        is_gated = self._options.remove_outliers_in_absolute_pose_constraints
        return SubmapOrder(
            title=entry.title,
            submap=folder / "submap",
            result=folder / "prepared",
            log=folder / "worker.log",
            absolute_pose_gate_sigma=_GATE_SIGMA if is_gated else 0.0,
            ties_stationary=self._options.stationary_submaps_fix_with_lc_edge,
            max_rotation_rad=self._stationary.max_rotation_rad,
            max_translation_m=self._stationary.max_translation_m,
        )


def check_submap(submap: VIMap) -> None:
    """Check what a consistent map may lack to be a submap.

    Raises:
        MapError: It is empty, its clock jumps, or neighbours of a mission are not joined.
    """
    if not len(submap.vertices):
        raise MapError("has no vertices")
    times_ns = submap.imu_samples.timestamp_ns
    starts = submap.sample_start[:-1]
    step_ns = times_ns[1:] - times_ns[:-1]
    inside = np.ones(len(step_ns), dtype=np.bool_)
    inside[starts[1:][starts[1:] > 0] - 1] = False  # from one edge to the next
    wrong = np.flatnonzero(inside & ((step_ns <= 0) | (step_ns > _MAX_IMU_STEP_NS)))
    if len(wrong):
        seconds = 1e-9 * float(step_ns[wrong[0]])
        raise MapError(f"its clock jumps by {seconds:.3f} s after {times_ns[wrong[0]]} ns")
    mission = submap.vertices.mission
    gaps = np.flatnonzero(~has_link(submap)[:-1] & (mission[1:] == mission[:-1]))
    if len(gaps):
        name = to_hex(submap.vertices.id[gaps[0]])
        raise MapError(
            f"no edge joins vertex {name} to the next: its clock jumps, or data were lost"
        )
