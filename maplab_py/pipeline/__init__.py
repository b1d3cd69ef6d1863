"""Pipelines: stages of commands over many maps, on this machine or on a cluster.

From Python::

    from maplab_py.pipeline import Pipeline, PipelineOptions, Stage, run_pipeline

    sessions = Stage("sessions", ("load <CURRENT_VIMAP_FOLDER>", "optvi",
                                  "save --map_folder=<RESULT_FOLDER>"), each="maps")
    pipeline = Pipeline("my pipeline", (Path("maps/a"), Path("maps/b")), (sessions,))
    report = run_pipeline(pipeline, Path("results"), PipelineOptions(scheduler="local:2"))
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from maplab_py.pipeline.driver import run_pipeline
    from maplab_py.pipeline.options import PipelineOptions
    from maplab_py.pipeline.plan import Pipeline, Stage
    from maplab_py.pipeline.progress import PipelineReport, Watcher

__all__ = ["Pipeline", "PipelineOptions", "PipelineReport", "Stage", "Watcher", "run_pipeline"]

_MODULES = {
    "run_pipeline": "driver",
    "PipelineOptions": "options",
    "Pipeline": "plan",
    "Stage": "plan",
    "PipelineReport": "progress",
    "Watcher": "progress",
}


def __getattr__(name: str) -> Any:
    """Import a module only when something of it is asked for: every start of the console is here."""
    if name in _MODULES:
        return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
