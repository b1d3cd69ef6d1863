"""Missions of a city from raw maps to their joint optimum, by the stages of flags/city.yaml.

`python -m benchmarks.city [MISSIONS ...] [--folder DIR] [--workers N]`; without numbers 10 and 25.

Simulates the missions that the folder does not hold yet, optimises each by itself (stage `sessions`), then
all together (stage `city`), and prints for each step time, largest memory of a process, missions that were
anchored, ATE, closures and merges with those that are wrong.
"""

import argparse
import json
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from benchmarks.city.joint import stage_of
from benchmarks.city.sessions import city_scenario, sizes, write_sessions
from maplab_py.pipeline import Pipeline, PipelineOptions, run_pipeline

_SCHEDULERS = {1: "none"}


def measure(missions: int, folder: Path, workers: int) -> None:
    """Simulate, optimise and print, for one number of missions."""
    data, results = folder / f"{missions}", folder / f"{missions}_results"
    maps = _timed("simulate", lambda: write_sessions(city_scenario(missions), data, workers))
    vertices, observations = map(sum, zip(*sizes(maps), strict=True))
    print(f"{missions} missions: {vertices} vertices, {observations} observations", flush=True)
    begin = time.monotonic()
    single = Pipeline("flags/city.yaml", tuple(maps), (stage_of("sessions"),))
    options = PipelineOptions(
        scheduler=_SCHEDULERS.get(workers, f"local:{workers}"), task_threads=1, resume=True
    )
    report = _timed("sessions", lambda: run_pipeline(single, results, options))
    if report.failure:
        raise SystemExit(report.failure)
    stage = report.stages[0]
    print(f"  {stage.seconds:.1f} s of tasks, peak of one {stage.peak_gb:.2f} GB", flush=True)
    result = results / "city"
    shutil.rmtree(result, ignore_errors=True)
    command = [sys.executable, "-m", "benchmarks.city.joint"]
    with subprocess.Popen(
        [*command, str(results / stage.stage), str(data), str(result)],
        stdout=subprocess.PIPE,
        text=True,
    ) as child:
        assert child.stdout is not None
        for line in child.stdout:
            print(f"  {_described(json.loads(line))}", flush=True)
    if child.returncode:
        raise SystemExit(child.returncode)
    print(f"{missions} missions: {time.monotonic() - begin:.1f} s from raw maps", flush=True)


def _timed(name: str, action: Any) -> Any:
    """Run an action, print the time of this process and of its children, and return the result."""
    before, begin = _processor_s(), time.monotonic()
    result = action()
    wall_s, spent_s = time.monotonic() - begin, _processor_s() - before
    print(f"{name}: {spent_s:.1f} s processor, {wall_s:.1f} s", flush=True)
    return result


def _processor_s() -> float:
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def _described(figures: dict[str, Any]) -> str:
    spent_s = figures.pop("user_s") + figures.pop("system_s")
    text = (
        f"{figures.pop('command')}: {spent_s:.1f} s processor, {figures.pop('wall_s'):.1f} s, "
        f"peak {figures.pop('peak_mb'):.0f} MB (grew by {figures.pop('peak_growth_mb'):.0f} MB)"
    )
    rest = ", ".join(
        f"{name} {value:.4g}" if isinstance(value, float) else f"{name} {value}"
        for name, value in figures.items()
    )
    return f"{text}; {rest}" if rest else text


def main() -> None:
    """Measure every number of missions."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("missions", type=int, nargs="*", default=[10, 25])
    parser.add_argument("--folder", type=Path, help="keeps sessions and results; else temporary")
    parser.add_argument("--workers", type=int, default=1)
    arguments = parser.parse_args()
    with ExitStack() as stack:
        folder = arguments.folder or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        for missions in arguments.missions:
            measure(missions, folder.absolute(), arguments.workers)


if __name__ == "__main__":
    main()
