"""Draw docs/images/pipelines.svg: when each task of a small city ran, and on which of two workers.

python docs/scripts/draw_pipeline.py
"""

import dataclasses
import json
import re
import tempfile
import time
from pathlib import Path

from maplab_py.console.scripts.batch import read_batch
from maplab_py.pipeline import Pipeline, PipelineOptions, Watcher, run_pipeline
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.simulation.simulate import simulate
from maplab_py.storage.native import save_map

DOCS = Path(__file__).resolve().parents[1]
TARGET = DOCS / "images" / "pipelines.svg"
COLOURS = {"sessions": "#0b6fb8", "city": "#c8501e", "cells": "#2b8a4b", "summaries": "#8a4fa3"}
WIDTH_PX, ROW_PX, HEAD_PX, LEFT_PX = 900, 34, 34, 76
_DONE = re.compile(r"(\S+)/(\S+): done in ([0-9.]+) s")


@dataclasses.dataclass(frozen=True)
class Ran:
    """A task that has run, in seconds since the start of the pipeline."""

    stage: str
    name: str
    begin_s: float
    end_s: float
    worker: str


def main() -> None:
    """Run flags/city.yaml on four simulated sessions, and draw its tasks."""
    scenario = load_scenario("four_sessions")
    measurement = dataclasses.replace(scenario.measurement, frame_rate_hz=2.0, max_keypoints=120)
    data = simulate(dataclasses.replace(scenario, measurement=measurement))
    with tempfile.TemporaryDirectory() as folder:
        for number, vi_map in enumerate(data.maps, start=1):
            save_map(vi_map, Path(folder) / "maps" / f"session_{number}")
        tasks = run(Path(folder))
    TARGET.write_text(drawing(tasks), encoding="utf-8")


def run(folder: Path) -> list[Ran]:
    """Run the pipeline on two workers of this machine."""
    done: list[tuple[float, str]] = []
    began = time.monotonic()
    options = PipelineOptions(scheduler="local:2")
    batch = read_batch(DOCS.parent / "flags" / "city.yaml", folder / "maps")
    pipeline = Pipeline("city.yaml", tuple(map(Path, batch.folders)), batch.stages)
    watcher = Watcher(line=lambda text: done.append((time.monotonic() - began, text)))
    report = run_pipeline(pipeline, folder / "results", options, watcher=watcher)
    if report.failure:
        raise RuntimeError(report.failure)
    tasks = []
    for end_s, text in done:
        match = _DONE.fullmatch(text)
        if match is not None:
            stage, name, seconds = match.groups()
            record = folder / "results" / "tasks" / stage / f"{name}.json"
            worker = json.loads(record.read_text(encoding="utf-8"))["worker"]
            tasks.append(Ran(stage, name, end_s - float(seconds), end_s, worker))
    return tasks


def drawing(tasks: list[Ran]) -> str:
    """Return the drawing: a row for each worker, a box for each task."""
    first_s = min(task.begin_s for task in tasks)
    length_s = max(task.end_s for task in tasks) - first_s
    px_per_s = (WIDTH_PX - LEFT_PX - 10) / length_s
    workers = sorted({task.worker for task in tasks})
    height = HEAD_PX + ROW_PX * len(workers) + 26
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH_PX} {height}" '
        'font-family="sans-serif" font-size="13">',
        f'<rect width="{WIDTH_PX}" height="{height}" fill="#ffffff"/>',
    ]
    for number, (stage, colour) in enumerate(COLOURS.items()):
        left = LEFT_PX + 150 * number
        count = sum(task.stage == stage for task in tasks)
        lines.append(f'<rect x="{left}" y="9" width="12" height="12" fill="{colour}"/>')
        lines.append(f'<text x="{left + 18}" y="20">{stage} ({count})</text>')
    for row, worker in enumerate(workers):
        top = HEAD_PX + ROW_PX * row
        lines.append(f'<text x="6" y="{top + 19}">worker {row + 1}</text>')
        for task in tasks:
            if task.worker == worker:
                left = LEFT_PX + (task.begin_s - first_s) * px_per_s
                width = max((task.end_s - task.begin_s) * px_per_s - 1.0, 1.0)
                lines.append(
                    f'<rect x="{left:.1f}" y="{top}" width="{width:.1f}" height="{ROW_PX - 6}" '
                    f'fill="{COLOURS[task.stage]}"><title>{task.stage}/{task.name}</title></rect>'
                )
    step_s = next(step for step in (1, 2, 5, 10, 20, 50, 100) if length_s / step <= 10)
    for tick_s in range(0, int(length_s) + 1, step_s):
        left = LEFT_PX + tick_s * px_per_s
        lines.append(f'<text x="{left:.1f}" y="{height - 8}" fill="#666666">{tick_s} s</text>')
    return "\n".join([*lines, "</svg>"]) + "\n"


if __name__ == "__main__":
    main()
