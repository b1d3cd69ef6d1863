"""Compile kernels before anybody waits for them: all at once, or while other work is done."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, wait
from functools import partial
from multiprocessing.process import BaseProcess
from typing import IO

from maplab_py.algorithms.dense.warmup import compile_dense
from maplab_py.algorithms.localization.guided_kernels import compile_kernels as compile_guided
from maplab_py.algorithms.relaxation.warmup import compile_relaxation
from maplab_py.cancellation import cleaned_up
from maplab_py.compilation import is_missing_on_disk
from maplab_py.estimation.codegen.kernels import pose_graph_kernels
from maplab_py.estimation.codegen.modules import cache_folder
from maplab_py.estimation.symbolic.sources import PoseError
from maplab_py.estimation.warmup import optimizer_jobs
from maplab_py.estimation.window.warmup import window_jobs
from maplab_py.interop.colmap.point_scan_kernel import compile_kernels as compile_colmap_points
from maplab_py.progress import Progress
from maplab_py.storage.warmup import compile_scan
from maplab_py.vision.absolute_pose import HYPOTHESES
from maplab_py.vision.pose_kernels import search_poses
from maplab_py.vision.search_kernels import search_cells
from maplab_py.vision.warmup import SEARCH, pose_job, vision_jobs

POSES, RELAXATION = pose_job(HYPOTHESES[0]), "relaxation"


def _sample(job: str) -> Callable[..., object]:
    """Return a kernel of a job that can be done ahead: once it is on the disk the job is done."""
    if job == RELAXATION:
        kernel: Callable[..., object] = pose_graph_kernels(PoseError.SPLIT).normal_equations
        return kernel
    return {POSES: search_poses, SEARCH: search_cells}[job]


def _jobs() -> dict[str, Callable[[], None]]:
    others = {
        RELAXATION: compile_relaxation,
        "message scan": compile_scan,
        "dense maps": compile_dense,
        "guided matching": compile_guided,
        "COLMAP points": compile_colmap_points,
    }
    return {**optimizer_jobs(), **window_jobs(), **vision_jobs(), **others}


def compile_kernels(
    progress: Progress, additional: Mapping[str, Callable[[], None]] | None = None
) -> tuple[list[str], float, str]:
    """Compile all kernels; return their names, the time it took [s], and the cache folder.

    Several processes compile at a time; what they make is shared through the cache folder.

    Args:
        progress: Is told about every job.
        additional: Functions of modules that compile the kernels of layers above this one, by name.
    """
    began = time.perf_counter()
    above = additional or {}
    jobs = [*_jobs(), *above]
    workers = min(len(jobs), os.cpu_count() or 1)
    context = multiprocessing.get_context("spawn")
    others = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(workers, mp_context=context, initializer=_ignore_ctrl_c)
    with cleaned_up(lambda: _end(pool, others)):
        pending = {pool.submit(above.get(job, partial(_compile, job))) for job in reversed(jobs)}
        while pending:
            progress.step(len(jobs) - len(pending), len(jobs), "compile kernels")
            done, pending = wait(pending, timeout=0.2)
            for future in done:
                future.result()
    progress.step(len(jobs), len(jobs), "compile kernels")
    return [job.lower() for job in jobs], time.perf_counter() - began, str(cache_folder())


def _end(pool: ProcessPoolExecutor, others: set[BaseProcess]) -> None:
    """End the processes of a pool, whatever they do."""
    pool.shutdown(wait=False, cancel_futures=True)
    for process in set(multiprocessing.active_children()) - others:
        process.kill()


def _ignore_ctrl_c() -> None:
    """Leave Ctrl-C, which the terminal sends to all processes, to the console."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _compile(job: str) -> None:
    """Compile one kernel in a separate process."""
    _jobs()[job]()


class CompilationAhead:
    """A process that compiles kernels, one job after the other, for work that is still to come.

    It is a process and not a thread because numba compiles one function at a time. Should it fail,
    whoever needs the kernels compiles them as if it had never been.
    """

    def __init__(self, jobs: Sequence[str]) -> None:
        """Start; jobs whose kernels are on the disk are left out, and all on a single core."""
        wanted = [job for job in jobs if is_missing_on_disk(_sample(job))]
        self._done = {job: threading.Event() for job in wanted}
        self._process: subprocess.Popen[str] | None = None
        if not wanted or (os.cpu_count() or 1) < 2:
            self._release()
            return
        code = f"from {__name__} import compile_and_tell; compile_and_tell({wanted!r})"
        self._process = subprocess.Popen(
            [sys.executable, "-c", code],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        self._reader = threading.Thread(target=self._read, args=(self._process.stdout,))
        self._reader.start()

    def wait(self, job: str, progress: Progress) -> None:
        """Wait until a job is done or the process has ended; raises Cancelled as `progress` does."""
        done = self._done.get(job)
        if done is None or done.is_set():
            return
        progress.line(f"compiling kernels '{job}' (once per machine) ...")
        while not done.wait(0.1):
            progress.check()

    def close(self) -> None:
        """End the process, whatever it does."""
        if self._process is not None:
            self._process.kill()
            self._reader.join()
            self._process.communicate()

    def _read(self, names: IO[str]) -> None:
        for line in names:
            if line.strip() in self._done:
                self._done[line.strip()].set()
        self._release()

    def _release(self) -> None:
        for event in self._done.values():
            event.set()


def compile_and_tell(jobs: Sequence[str]) -> None:
    """Compile the kernels of some jobs; print the name of each when it is done."""
    for job in jobs:
        _compile(job)
        sys.stdout.write(f"{job}\n")
        sys.stdout.flush()
