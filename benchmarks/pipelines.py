"""Sixteen maps on one and on two local workers: `python -m benchmarks.pipelines FOLDER`.

FOLDER has the maps. Beside the run times the utilisation is printed: the part of the workers' time in
which tasks ran. On a machine that does other work the run times say little, the utilisation still does.
"""

import sys
import tempfile
import time
from pathlib import Path

from maplab_py.pipeline import Pipeline, PipelineOptions, Stage, run_pipeline
from maplab_py.storage.native import find_maps

COMMANDS = (
    "load --map_folder=<CURRENT_VIMAP_FOLDER>",
    "elq",
    "save --map_folder=<RESULT_FOLDER>",
)
MAPS = 16


def main(folder: Path) -> None:
    """Print run times and utilisation."""
    found = find_maps(folder)
    with tempfile.TemporaryDirectory() as temporary:
        links = []
        for number in range(MAPS):
            link = Path(temporary) / "maps" / f"map_{number:02d}"
            link.parent.mkdir(exist_ok=True)
            link.symlink_to(found[number % len(found)].absolute())
            links.append(link)
        pipeline = Pipeline("benchmark", tuple(links), (Stage("sessions", COMMANDS, each="maps"),))
        for workers in (2, 1):
            start = time.monotonic()
            options = PipelineOptions(scheduler=f"local:{workers}", task_threads=1)
            report = run_pipeline(pipeline, Path(temporary) / f"r{workers}", options)
            whole_s = time.monotonic() - start
            busy_s = sum(stage.seconds for stage in report.stages)
            print(
                f"{workers} workers: {whole_s:.1f} s with start and end, {report.seconds:.1f} s of tasks, "
                f"utilisation {busy_s / (workers * report.seconds):.3f} {report.failure}",
                flush=True,
            )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
