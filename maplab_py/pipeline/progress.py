"""Progress of a running pipeline, and its report."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

from maplab_py.report import Report


@dataclasses.dataclass
class StageState:
    """Tasks of a stage, counted by what has become of them."""

    stage: str
    waiting: int = 0
    running: int = 0
    done: int = 0
    kept: int = 0
    failed: int = 0
    seconds: float = 0.0
    peak_gb: float = 0.0


@dataclasses.dataclass(frozen=True)
class StageLine:
    """A stage in the report of a pipeline."""

    stage: str
    done: int
    kept: int  # finished by an earlier run
    failed: int
    not_run: int
    seconds: float  # of all its tasks together [s]
    peak_gb: float


@dataclasses.dataclass(frozen=True)
class FailedTask:
    """A task that failed."""

    task: str
    error: str
    log: Path


class PipelineReport(Report):
    """Result of a pipeline."""

    stages: tuple[StageLine, ...] = dataclasses.field(metadata={"title": ""})
    failed_tasks: tuple[FailedTask, ...]
    results_folder: Path
    seconds: float

    @property
    def failure(self) -> str:
        """Say how many tasks failed, and the first of them."""
        if self.failed_tasks:
            first = self.failed_tasks[0]
            tasks = sum(s.done + s.kept + s.failed for s in self.stages)
            count = f"{len(self.failed_tasks)} of {tasks} tasks failed"
            return f"{count}: {first.task}: {first.error} (see {first.log})"
        skipped = sum(stage.not_run for stage in self.stages)
        return f"{skipped} tasks were not run" if skipped else ""


@dataclasses.dataclass(frozen=True)
class Watcher:
    """Functions that hear of a running pipeline; both do nothing by default."""

    line: Callable[[str], None] = lambda _: None  # gets a line for the user
    # gets the stages whenever something changes
    states: Callable[[list[StageState]], None] = lambda _: None
