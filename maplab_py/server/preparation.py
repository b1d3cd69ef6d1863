"""Preparation of submaps: each is checked and optimised by itself in a fresh process."""

from __future__ import annotations

import contextlib
import hashlib
import os
import shlex
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import numpy as np

from maplab_py.algorithms.pose_graph_manipulation.stationary_options import StationaryOptions
from maplab_py.atomic import write_file
from maplab_py.errors import MapError, MaplabError
from maplab_py.pipeline.execution import execute
from maplab_py.pipeline.fingerprint import program_version
from maplab_py.pipeline.orders import Order, Outcome
from maplab_py.pipeline.plan import RESULT_TEMPLATE
from maplab_py.server.options import SubmapOptions
from maplab_py.server.spool import Entry, Spool
from maplab_py.storage.native import is_map_folder
from maplab_py.vimap import VIMap
from maplab_py.vimap.ids import to_hex
from maplab_py.vimap.queries import has_link

_MAX_IMU_STEP_NS = 1_000_000_000
"""IMU samples that are farther apart are those of a clock that jumped."""
_NOTE = "prepared.sha256"


class Preparation:
    """Runs orders in processes, a few at a time."""

    def __init__(self, spool: Spool, options: SubmapOptions, stationary: StationaryOptions) -> None:
        """Start without orders."""
        self._spool, self._options, self._stationary = spool, options, stationary
        self._workers = options.submap_loading_thread_pool_size
        self._pool = ThreadPoolExecutor(self._workers, thread_name_prefix="prepare")
        self._is_stopping = False

    def start(self, entry: Entry) -> Future[Outcome]:
        """Prepare a submap; the result is in `prepared` of its folder, what was wrong in the outcome."""
        return self._pool.submit(execute, self._order(entry), lambda: self._is_stopping)

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

    def _key(self, entry: Entry) -> str:
        script = self._script(self._spool.folder(entry) / "submap")
        return hashlib.sha256(f"{program_version()}\n{script}".encode()).hexdigest()

    def stop(self) -> None:
        """Kill what runs, and wait for its end."""
        self._is_stopping = True
        self._pool.shutdown(wait=True, cancel_futures=True)

    def _order(self, entry: Entry) -> Order:
        folder = self._spool.folder(entry)
        return Order(
            title=entry.title,
            script=self._script(folder / "submap"),
            flags=(),
            inputs=(folder / "submap",),
            folder=folder,
            result=folder / "prepared",
            log=folder / "worker.log",
            reports=folder / "worker.jsonl",
            version=program_version(),
            memory_gb=0.0,
            threads=max(1, (os.cpu_count() or 1) // self._workers),
            tasks_per_host=self._workers,
            keep_going=False,
            discard=True,
        )

    def _script(self, submap: Path) -> str:
        options, stationary = self._options, self._stationary
        optimise = "optvi --ba_include_absolute_pose_constraints"
        if not options.remove_outliers_in_absolute_pose_constraints:
            optimise += " --ba_absolute_pose_gate_sigma=0"
        lines = [f"load --map_folder={shlex.quote(str(submap))}", "check_map_consistency", "elq"]
        if options.stationary_submaps_fix_with_lc_edge:
            lines.append(
                "tie_stationary_missions "
                f"--maplab_stationary_submaps_max_rotation_rad={stationary.max_rotation_rad!r} "
                f"--maplab_stationary_submaps_max_translation_m={stationary.max_translation_m!r}"
            )
            optimise += " --ba_include_loop_closure_edges"
        lines += [optimise, f"save --map_folder={RESULT_TEMPLATE}"]
        return "".join(line + "\n" for line in lines)


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
