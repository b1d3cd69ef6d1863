"""How long the first optvi of a fresh machine waits: `python -m tests.benchmarks.compile_ahead`.

The prompt in a pseudo-terminal with empty caches: load the Tango map, read, `optvi`; without and
with kernels compiled ahead. Reading ends when the process that compiles has had 30 s of a processor,
as it has after 30 s on a machine that does nothing else. Waiting is the wall time from Enter to the
report, and the processor time of whoever the user waits for: the console, and the process of
ordinary priority, if there is one.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import tempfile
import time
from pathlib import Path

from tests.e2e.support import Console
from tests.support.data import shared_data

_HERTZ = os.sysconf("SC_CLK_TCK")


def processor_s(number: int) -> float:
    """Return the processor time of a process that lives, else 0 [s]."""
    try:
        fields = Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / _HERTZ


def compilers(parent: int) -> dict[int, int]:
    """Return the niceness of the processes that compile for a console, by their number."""
    tasks = Path(f"/proc/{parent}/task").glob("*/children")
    numbers = [int(number) for task in tasks for number in task.read_text().split()]
    niceness = {}
    for number in numbers:
        with contextlib.suppress(ProcessLookupError):
            niceness[number] = os.getpriority(os.PRIO_PROCESS, number)
    return niceness


def measure(map_folder: Path, *, ahead: bool, reading_s: float) -> tuple[float, float]:
    """Return the wall time and the processor time that a user waits for optvi [s]."""
    with tempfile.TemporaryDirectory() as folder:
        home = Path(folder)
        for name in ("kernels", "numba"):
            (home / name).mkdir(mode=0o700)
        caches = {"MAPLAB_CACHE_DIR": str(home / "kernels"), "NUMBA_CACHE_DIR": str(home / "numba")}
        console = Console(home, **caches)
        try:
            console.wait_for(lambda _: console.last_line.endswith("$"), 600.0)
            console.enter(f"set compile_ahead={str(ahead).lower()}")
            console.wait_for_text("compile_ahead")
            console.enter(f"load {map_folder} --map_key=m")
            console.wait_for(lambda _: console.last_line.startswith("maplab <m>"), 600.0)
            while ahead and not _has_read(console.child.pid, reading_s):
                console.wait_until_still(0.1)
                time.sleep(0.2)
            return _wait_for_optvi(console)
        finally:
            console.close()


def _has_read(parent: int, reading_s: float) -> bool:
    used = [processor_s(number) for number in compilers(parent)]
    _has_read.seen = _has_read.seen or bool(used)  # type: ignore[attr-defined]
    return bool(_has_read.seen and (not used or max(used) >= reading_s))  # type: ignore[attr-defined]


_has_read.seen = False  # type: ignore[attr-defined]


def _wait_for_optvi(console: Console) -> tuple[float, float]:
    number = console.child.pid
    before, start = processor_s(number), time.monotonic()
    hurried = 0.0
    console.enter("optvi --ba_num_iterations=2")
    end = start + 1200.0
    while "optimize_visual_inertial: " not in console.text:
        console._read(0.1)
        each = [processor_s(child) for child, nice in compilers(number).items() if nice == 0]
        hurried = max([hurried, *each])
        if time.monotonic() > end:
            raise TimeoutError(console.text)
    return time.monotonic() - start, processor_s(number) - before + hurried


def main() -> None:
    """Measure both and print the ratio."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", nargs="*", default=["without", "ahead"])
    parser.add_argument("--reading_s", type=float, default=30.0)
    arguments = parser.parse_args()
    tango = shared_data("maplab_maps/tango_handheld")
    times_s = []
    for name in arguments.what:
        wall_s, cpu_s = measure(tango, ahead=name == "ahead", reading_s=arguments.reading_s)
        print(f"{name}: {wall_s:.1f} s, processor {cpu_s:.1f} s", flush=True)
        times_s.append(cpu_s)
    if len(times_s) > 1:
        print(f"ratio of processor times {times_s[-1] / times_s[0]:.2f}")


if __name__ == "__main__":
    main()
