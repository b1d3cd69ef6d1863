"""Solvers compared: each in a process of its own, in the same environment, one after the other."""

import dataclasses
import json
import os
import subprocess
from typing import Any

import numpy as np

from tests.support.programs import module_of_tests

NUM_THREADS = 2
PEER = {"visual": "ceres", "inertial": "gtsam", "sessions": "ceres"}


@dataclasses.dataclass(frozen=True)
class Comparison:
    """This project and its peer on one problem."""

    kind: str
    size: str
    peer: str
    ours: dict[str, Any]
    theirs: dict[str, Any]

    def ratio(self, quantity: str) -> float:
        """Return ours / theirs of a measured quantity."""
        return float(self.ours[quantity] / self.theirs[quantity])

    @property
    def cpu_ratio(self) -> float:
        """Ratio of user and system time: what remains comparable on a shared machine."""
        return cpu_s(self.ours) / cpu_s(self.theirs)

    @property
    def cost_difference(self) -> float:
        """Relative difference of the final costs, each as its solver counts it."""
        return float((self.ours["cost"] - self.theirs["cost"]) / self.theirs["cost"])


def cpu_s(measured: dict[str, Any]) -> float:
    """Return user and system time [s]."""
    return float(measured["user_s"] + measured["system_s"])


def compare(kind: str, size: str, repeats: int = 3) -> Comparison:
    """Run this project and the peer of a kind of problem."""
    ours, theirs = (run(kind, solver, size, repeats) for solver in ("maplab", PEER[kind]))
    return Comparison(kind, size, PEER[kind], ours, theirs)


def run(kind: str, solver: str, size: str, repeats: int) -> dict[str, Any]:
    """Run one solver in a fresh process with two threads on two processors."""
    command = ["benchmarks.child", kind, solver, size, "--repeats", str(repeats)]
    return json.loads(module_output(command))


def module_output(command: list[str], **variables: str) -> str:
    """Return the last line that `python -m command` prints, with two threads and processors."""
    environment = dict(os.environ, **variables)
    for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "TBB_NUM_THREADS"):
        environment[name] = str(NUM_THREADS)
    finished = subprocess.run(
        [*module_of_tests(command[0]), *command[1:]], env=environment,
        check=False, capture_output=True, text=True, preexec_fn=_use_two_processors,
    )  # fmt: skip
    if finished.returncode:
        raise RuntimeError(f"{' '.join(command)} failed:\n{finished.stderr}")
    return finished.stdout.strip().splitlines()[-1]


def _use_two_processors() -> None:
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:NUM_THREADS])


def scaling_exponent(measured: list[dict[str, Any]]) -> float:
    """Return e of time per iteration ~ observations^e, fitted over sizes.

    The time is that of the processors; analysis of the structure is shared among iterations.
    """
    size = np.log([m["observations"] for m in measured])
    time = np.log([cpu_s(m) / m["iterations"] for m in measured])
    return float(np.polyfit(size, time, 1)[0])
