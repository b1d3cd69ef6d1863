"""Pipelines: stages of commands over many maps, on this machine or on a cluster.

From Python::

    from maplab_py.pipeline import Pipeline, PipelineOptions, Stage, run_pipeline

    sessions = Stage("sessions", ("load <CURRENT_VIMAP_FOLDER>", "optvi",
                                  "save --map_folder=<RESULT_FOLDER>"), each="maps")
    pipeline = Pipeline("my pipeline", (Path("maps/a"), Path("maps/b")), (sessions,))
    report = run_pipeline(pipeline, Path("results"), PipelineOptions(scheduler="local:2"))
"""

from maplab_py.pipeline.driver import run_pipeline
from maplab_py.pipeline.options import PipelineOptions
from maplab_py.pipeline.plan import Pipeline, Stage
from maplab_py.pipeline.progress import PipelineReport, Watcher

__all__ = ["Pipeline", "PipelineOptions", "PipelineReport", "Stage", "Watcher", "run_pipeline"]
