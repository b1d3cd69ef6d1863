"""Time, memory and disk of commands: measured at every run, predicted for the steps of a script."""

import dataclasses
import json
import math
import statistics
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from maplab_py.console.session.call import Call
from maplab_py.console.session.maps import MapManager
from maplab_py.console.session.paths import state_folder, write_state
from maplab_py.console.session.session import Session
from maplab_py.memory import resident_bytes
from maplab_py.report import Report

_FILE = "costs.json"
_MOST_RUNS = 9  # of each command: the median follows a new machine or version soon
_NEAREST_RUNS = 3
"""Runs that a prediction rests on: what takes a fixed time on tiny maps says nothing of large ones."""
_LEAST_SECONDS = 0.05  # a run below tells nothing
_MOST_FILES = 20_000  # whose sizes are summed
_MB = 1e6


@dataclasses.dataclass(frozen=True)
class Cost:
    """Figures of one run of a command."""

    input_mb: float  # the selected map, else the files that are read
    seconds: float
    memory_mb: float  # by which the process grew
    map_mb: float  # the selected map afterwards
    disk_mb: float  # files and folders that were written


@dataclasses.dataclass(frozen=True)
class Step:
    """Prediction for one command of a script; nan where the command has not been run here yet."""

    step: int
    command: str
    seconds: float
    memory_mb: float
    disk_mb: float
    runs: int  # on which the prediction rests


class Plan(Report):
    """The steps of a script that has no fault, and what they take."""

    steps: tuple[Step, ...]
    total_s: float  # of the steps that can be predicted
    not_predicted: int

    def left_after(self, number: int) -> float:
        """Return the predicted time of the steps after the first `number` [s]."""
        return sum(step.seconds for step in self.steps[number:] if step.runs)


@contextmanager
def measuring(call: Call, session: Session) -> Iterator[None]:
    """Measure the command that runs inside, and keep the figures for predictions if it succeeds."""
    before_mb = _input_mb(call, _map_mb(session.maps))
    unsaved = {entry.key for entry in session.maps.unsaved}
    memory, peak, began = resident_bytes(), _peak_bytes(), time.perf_counter()
    yield
    seconds = time.perf_counter() - began
    costs = read_costs()
    is_known = call.command.name in costs
    if call.is_trial or (is_known and seconds < _LEAST_SECONDS):
        return
    is_higher = _peak_bytes() > peak  # else the peak is that of an earlier command
    grown_mb = max(0.0, (_peak_bytes() if is_higher else resident_bytes()) - memory) / _MB
    saved = {e.folder for e in session.maps if e.is_saved and e.key in unsaved and e.folder}
    written_mb = sum(_disk_mb(path) for path in {*_paths(call, is_read=False), *saved})
    cost = Cost(before_mb, seconds, grown_mb, _map_mb(session.maps), written_mb)
    costs[call.command.name] = [*costs.get(call.command.name, []), cost][-_MOST_RUNS:]
    content = {name: [dataclasses.astuple(run) for run in runs] for name, runs in costs.items()}
    write_state(_FILE, json.dumps(content))


def read_costs() -> dict[str, list[Cost]]:
    """Return the figures of former runs by command; none where the file is missing or damaged."""
    try:
        content: dict[str, list[list[float]]] = json.loads((state_folder() / _FILE).read_bytes())
        return {name: [Cost(*map(float, run)) for run in runs] for name, runs in content.items()}
    except (OSError, ValueError, TypeError, AttributeError):
        return {}


def predict(steps: list[tuple[str, Call | None]], maps: MapManager) -> Plan:
    """Return the plan of a script.

    Figures grow in proportion to what a command reads: the maps and recordings that are there, and what
    earlier steps are predicted to make of them.

    Args:
        steps: The commands as they are typed, with their calls; None for what is no command.
        maps: The maps in memory.
    """
    costs = read_costs()
    map_mb = _map_mb(maps)
    predicted = []
    for number, (text, call) in enumerate(steps, start=1):
        runs = [] if call is None else costs.get(call.command.name, [])
        input_mb = 0.0 if call is None else _input_mb(call, map_mb)
        step = Step(
            number,
            text,
            _scaled(runs, "seconds", input_mb),
            _scaled(runs, "memory_mb", input_mb),
            _scaled(runs, "disk_mb", input_mb),
            min(len(runs), _NEAREST_RUNS),
        )
        predicted.append(step)
        if runs:
            map_mb = _scaled(runs, "map_mb", input_mb)
    total_s = sum(step.seconds for step in predicted if step.runs)
    not_predicted = sum(not step.runs for step in predicted)
    return Plan(tuple(predicted), total_s, not_predicted)


def _scaled(runs: list[Cost], name: str, input_mb: float) -> float:
    """Return the median of a figure over the former runs of nearest input, scaled to the present one."""
    if not runs:
        return float("nan")
    scales = [
        input_mb / run.input_mb if run.input_mb > 0.0 and input_mb > 0.0 else 1.0 for run in runs
    ]
    nearest = sorted(range(len(runs)), key=lambda i: (abs(math.log(scales[i])), -i))[:_NEAREST_RUNS]
    values: list[float] = [getattr(runs[i], name) * scales[i] for i in nearest]
    return float(f"{statistics.median(values):.2g}")  # it is not more certain than that


def _map_mb(maps: MapManager) -> float:
    return maps.selected.vi_map.nbytes() / _MB if maps.selected_key else 0.0


def _input_mb(call: Call, map_mb: float) -> float:
    read_mb = sum(_disk_mb(path) for path in _paths(call, is_read=True))
    return map_mb if call.command.needs_map and map_mb else read_mb


def _paths(call: Call, *, is_read: bool) -> Iterator[Path]:
    values: Mapping[str, Any] = call.values
    for name, value in values.items():
        if isinstance(value, Path) and (name in call.command.reads) == is_read:
            yield value


def _disk_mb(path: Path) -> float:
    """Return the size of a file, or of the files in a folder."""
    total = 0
    with suppress(OSError):
        if path.is_file():
            return path.stat().st_size / _MB
        for number, file in enumerate(path.rglob("*")):
            if number >= _MOST_FILES:
                break
            total += file.stat().st_size if file.is_file() else 0
    return total / _MB


def _peak_bytes() -> float:
    """Return the largest memory that the process has held, or that it holds where that is not known."""
    try:
        import resource
    except ImportError:  # not a POSIX system
        return resident_bytes()
    unit = 1 if sys.platform == "darwin" else 1024
    return float(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit)
