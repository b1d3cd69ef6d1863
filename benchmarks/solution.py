"""What a solver returns of a benchmark problem, and what it cost."""

import dataclasses
import resource
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from maplab_py.estimation.problem.trust_region import Schedule

F64 = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class StoppingRule:
    """When every solver stops, and how boldly it begins.

    An initial damping of 1e-5 is the default of GTSAM and of this project. Ceres' is 1e-4, with which
    it needs up to two iterations more on these problems.
    """

    function_tolerance: float = 1e-7  # relative decrease of the cost in one step
    max_iterations: int = 50
    initial_damping: float = 1e-5  # 1 / initial radius of the trust region
    schedule: Schedule = Schedule.STEP_QUALITY  # of this project; the others have their own
    forcing: float = 0.0  # of an iterative linear solver; 0 = a factorisation


SAME_STEPS = StoppingRule(0.0, 6, schedule=Schedule.CERES, forcing=0.01)
"""Six steps of an iterative solver, with the schedule of Ceres."""


@dataclasses.dataclass(frozen=True, eq=False)
class Solution:
    """States of V keyframes and L landmarks at the end of a solver's run."""

    T_G_I: F64  # (V, 7)
    p_G: F64  # (L, 3)
    cost: float  # half the sum of squares, as the solver itself counts it
    iterations: int
    v_G: F64 | None = None  # (V, 3)
    gyro_bias: F64 | None = None
    accel_bias: F64 | None = None


@dataclasses.dataclass
class Effort:
    """Time and memory that a piece of work took in this process."""

    wall_s: float = 0.0
    user_s: float = 0.0  # of all threads together
    system_s: float = 0.0
    peak_growth_mb: float = 0.0  # largest resident size meanwhile, less that before


@contextmanager
def effort() -> Iterator[Effort]:
    """Measure the body; the result is filled in when it ends."""
    result = Effort()
    before_mb = _status_mb("VmRSS")
    _forget_peak()
    usage, began = resource.getrusage(resource.RUSAGE_SELF), time.perf_counter()
    yield result
    result.wall_s = time.perf_counter() - began
    after = resource.getrusage(resource.RUSAGE_SELF)
    result.user_s = after.ru_utime - usage.ru_utime
    result.system_s = after.ru_stime - usage.ru_stime
    result.peak_growth_mb = _status_mb("VmHWM") - before_mb


def _forget_peak() -> None:
    """Let Linux count the largest resident size anew (man proc, clear_refs)."""
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def _status_mb(field: str) -> float:
    for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
        if line.startswith(field + ":"):
            return int(line.split()[1]) / 1024.0
    raise KeyError(field)
