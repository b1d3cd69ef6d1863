"""How fast this machine is just now, so that bars in seconds mean the same on every one."""

import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

_REFERENCE_SECONDS = 0.04
"""Time of the loop below on an ordinary machine that is not throttled."""


def slowness() -> float:
    """Return how many times slower than an ordinary machine this one is now; at least 1.

    A plain loop of the interpreter is the measure: nothing that the project does can change it.
    """
    best = min(_loop_seconds() for _ in range(3))
    return max(1.0, best / _REFERENCE_SECONDS)


def _loop_seconds() -> float:
    start = time.process_time()
    total = 0
    for number in range(1_000_000):
        total += number
    assert total == 499_999_500_000
    return time.process_time() - start


def libraries_start_s() -> float:
    """Return the processor time of a Python that imports libraries of the console and scipy [s].

    A peer for the time that the console needs to start: imports feel a machine's memory and disk,
    which the loop of `slowness` does not.
    """
    code = "import numpy, prompt_toolkit.shortcuts, scipy.optimize"
    return child_cpu_s(lambda: subprocess.run([sys.executable, "-c", code], check=True))


def child_cpu_s(run: Callable[[], object]) -> float:
    """Return the processor time of the child processes that a function starts and waits for [s]."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    run()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def descendants_cpu_s() -> float:
    """Return the processor time of all processes that this one has started [s]."""
    children: dict[int, list[tuple[int, int]]] = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            text = path.read_text()
        except OSError:
            continue  # it has ended
        fields = text[text.rindex(")") + 2 :].split()
        ticks = int(fields[11]) + int(fields[12])
        children.setdefault(int(fields[1]), []).append((int(text.split()[0]), ticks))
    total, left = 0, [os.getpid()]
    while left:
        for pid, ticks in children.get(left.pop(), []):
            total += ticks
            left.append(pid)
    return total / os.sysconf("SC_CLK_TCK")
