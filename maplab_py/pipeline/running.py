"""Run a pipeline from its beginning to its report."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from maplab_py.pipeline.driver import Driver, RunSettings
from maplab_py.pipeline.engines import engine_of
from maplab_py.pipeline.options import PipelineOptions
from maplab_py.pipeline.plan import Pipeline
from maplab_py.pipeline.progress import PipelineReport, Watcher

_SILENT = Watcher()
_DEFAULTS = PipelineOptions()


def run_pipeline(
    pipeline: Pipeline,
    results_folder: Path,
    options: PipelineOptions = _DEFAULTS,
    *,
    flags: Mapping[str, str] | None = None,
    keep_going: bool = False,
    discard: bool = False,
    watcher: Watcher = _SILENT,
) -> PipelineReport:
    """Run a pipeline: every task in a fresh process of the console.

    A program that calls this with `local:N` needs the usual guard, `if __name__ == "__main__":`, as
    workers are new processes that import it.

    Args:
        pipeline: Stages and map folders.
        results_folder: Gets a folder per stage and task, and `tasks/` with a log, the reports and the
            record of each task. All workers must see it and the maps under the same path.
        options: Where tasks run, and what happens to those that fail; its results_folder is not
            looked at.
        flags: Lasting flags of the commands, name and text.
        keep_going: Go on with tasks that do not need a failed one.
        discard: Maps may be left unsaved.
        watcher: Hears of the progress.

    Returns:
        What was done; `failure` says in one line what failed.

    Raises:
        UserError: The pipeline or an option is wrong, earlier results would be lost or mixed, Dask is
            not installed, or its scheduler does not answer.
        MaplabError: The scheduler was lost meanwhile.
        Cancelled: The tasks were cancelled. All workers have stopped.
    """
    maps = tuple(folder.absolute() for folder in pipeline.maps)
    placed = Pipeline(pipeline.origin, maps, pipeline.stages)
    settings = RunSettings(
        options, results_folder.absolute(), Path.cwd(), dict(flags or {}), keep_going, discard
    )
    engine = engine_of(options)
    driver = Driver(placed, settings, engine, watcher)
    with engine:
        if engine.address:
            watcher.line(f"tasks run on {options.scheduler}; Dask's dashboard: {engine.address}")
        return driver.run()
