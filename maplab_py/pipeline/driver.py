"""The driver: which task is ready, which is finished already, and what follows a failure."""

import dataclasses
import shutil
import time
from collections import deque
from collections.abc import Mapping
from pathlib import Path

from maplab_py.errors import Cancelled, UserError
from maplab_py.pipeline import engines, messages, records
from maplab_py.pipeline import progress as report
from maplab_py.pipeline.options import PipelineOptions
from maplab_py.pipeline.plan import MAPS, Pipeline, Stage, ordered
from maplab_py.storage.cache.map_cache import program_version

_AGAIN = (messages.Ending.FAILED, messages.Ending.LOST)


@dataclasses.dataclass(frozen=True)
class RunSettings:
    """Settings that all tasks of a run share."""

    options: PipelineOptions  # how the pipeline is run
    results: Path  # folder of all results; absolute
    folder: Path  # folder to which relative paths in commands are relative; absolute
    # lasting flags of commands, by name
    flags: Mapping[str, str] = dataclasses.field(default_factory=dict)
    # go on with other tasks, and with a task's next command, after a failure
    keep_going: bool = False
    discard: bool = False  # maps may be left unsaved


@dataclasses.dataclass
class _Progress:
    """A stage while the pipeline runs."""

    stage: Stage
    state: report.StageState
    tasks: dict[str, records.Task] = dataclasses.field(default_factory=dict)
    finished: list[records.Task] = dataclasses.field(default_factory=list)
    is_complete: bool = False  # no task can be added any more
    expanded: set[str] = dataclasses.field(default_factory=set)  # tasks of the source, by title

    @property
    def has_ended(self) -> bool:
        """All its tasks are finished."""
        return self.is_complete and len(self.finished) == len(self.tasks)


class Driver:
    """Runs the tasks of a pipeline on an engine.

    Tasks become known while the pipeline runs, since a task may write several maps. The driver never
    gives the engine more orders than it runs at once, so that a failure leaves no queue behind.
    """

    def __init__(
        self,
        pipeline: Pipeline,
        settings: RunSettings,
        engine: engines.Engine,
        watcher: report.Watcher,
    ) -> None:
        """Check the pipeline and what an earlier run has left.

        Raises:
            UserError: The pipeline is wrong, or earlier results would be lost or mixed.
        """
        self.pipeline = pipeline
        self.settings = settings
        self._engine = engine
        self._watcher = watcher
        stages = ordered(pipeline)
        self._stages = {s.name: _Progress(s, report.StageState(s.name)) for s in stages}
        self._records = records.Records(settings.results)
        self._version = program_version()
        self._ready: deque[records.Task] = deque()
        self._alone: deque[records.Task] = deque()  # took too much memory beside others
        self._running: dict[str, records.Task] = {}
        self._attempts: dict[str, int] = {}
        self._inputs: dict[str, tuple[tuple[str, str], ...]] = {}
        self._hashes: dict[Path, str] = {}
        self._failed: list[report.FailedTask] = []
        self._is_stopping = False
        self._check_earlier_results()

    def run(self) -> report.PipelineReport:
        """Run all tasks; the engine has been started.

        Raises:
            UserError: The commands or flags of a finished task have changed, or a folder cannot be
                read or written.
            Cancelled: A task was cancelled.
        """
        start = time.monotonic()
        self._expand()
        while self._fill() or self._running:
            if self._running:
                self._take(self._engine.next_outcome())
        lines = []
        for progress in self._stages.values():
            s = progress.state
            is_missing = not progress.is_complete and not progress.tasks
            not_run = s.waiting + (1 if is_missing else 0)
            lines.append(
                report.StageLine(s.stage, s.done, s.kept, s.failed, not_run, s.seconds, s.peak_gb)
            )
        seconds = time.monotonic() - start
        return report.PipelineReport(
            tuple(lines), tuple(self._failed), self.settings.results, seconds
        )

    def _check_earlier_results(self) -> None:
        options, results = self.settings.options, self.settings.results
        if options.restart and not self.pipeline.is_in_place:
            shutil.rmtree(self._records.folder, ignore_errors=True)
        elif not options.resume and not self.pipeline.is_in_place and self._records.exist():
            raise UserError(
                f"{results}: holds results of an earlier run; give --resume to keep what is "
                "finished, --restart to replace all, or another --results_folder"
            )

    # which tasks there are

    def _expand(self) -> None:
        """Make the tasks that have become possible, and take over those that are finished."""
        for progress in self._stages.values():  # in the order of need: one pass is enough
            if progress.is_complete:
                continue
            for task in self._new_tasks(progress):
                progress.tasks[task.name] = task
                if self._is_finished(task):
                    progress.state.kept += 1
                    progress.finished.append(task)
                else:
                    progress.state.waiting += 1
                    self._ready.append(task)
        self._watcher.states([progress.state for progress in self._stages.values()])

    def _new_tasks(self, progress: _Progress) -> list[records.Task]:
        stage = progress.stage
        if stage.all:
            sources = [self._stages[name] for name in stage.all if name != MAPS]
            if not all(source.has_ended for source in sources):
                return []
            progress.is_complete = True
            maps = [folder for name in stage.all for folder in self._maps_of(name)]
            return [self._task(stage, stage.name, maps)]
        if stage.each == MAPS:
            progress.is_complete = True
            pairs = zip(records.names_of(self.pipeline.maps), self.pipeline.maps, strict=True)
            return [self._task(stage, name, [folder]) for name, folder in pairs]
        source = self._stages[stage.each]
        tasks = []
        for parent in source.finished:
            if parent.title not in progress.expanded:
                progress.expanded.add(parent.title)
                tasks += self._tasks_on_result(stage, parent)
        progress.is_complete = source.has_ended
        return tasks

    def _tasks_on_result(self, stage: Stage, parent: records.Task) -> list[records.Task]:
        maps = _maps_below(parent)
        if maps == [parent.result]:
            return [self._task(stage, parent.name, maps)]
        inner = ["-".join(folder.relative_to(parent.result).parts) for folder in maps]
        names = (
            inner
            if len(self._stages[parent.stage.name].tasks) == 1
            else [f"{parent.name}-{name}" for name in inner]
        )
        return [self._task(stage, name, [folder]) for name, folder in zip(names, maps, strict=True)]

    def _maps_of(self, name: str) -> list[Path]:
        """Return the maps of a stage that has ended, in the order of its tasks."""
        if name == MAPS:
            return list(self.pipeline.maps)
        tasks = sorted(self._stages[name].finished, key=lambda task: task.name)
        return [folder for task in tasks for folder in _maps_below(task)]

    def _task(self, stage: Stage, name: str, maps: list[Path]) -> records.Task:
        edits_input = self.pipeline.is_in_place
        return records.task_on(stage, name, maps, self.settings.results, edits_input=edits_input)

    # which tasks are finished

    def _is_finished(self, task: records.Task) -> bool:
        """Tell whether an earlier run has finished a task with the same inputs, commands and flags."""
        inputs = tuple((str(folder), self._hash(folder)) for folder in task.inputs)
        self._inputs[task.title] = inputs
        record = self._records.read(task) if self.settings.options.resume else None
        if record is None:
            return False
        changed = records.change(record, self._record(task))
        if changed and self.settings.options.redo_changed:
            return False
        if changed:
            raise UserError(
                f"{task.title}: {changed}: --resume keeps no result of another request; undo the "
                "change, or give --redo_changed too"
            )
        if task.edits_input:
            return inputs[0][1] == record.result
        is_same = task.result.is_dir() and records.has_inputs(record, inputs)
        return is_same and self._hash(task.result) == record.result

    def _record(self, task: records.Task) -> records.Record:
        return records.record_of(task, dict(self.settings.flags), self._version)

    def _hash(self, folder: Path) -> str:
        if folder not in self._hashes:
            self._hashes[folder] = records.folder_hash(folder)
        return self._hashes[folder]

    # running

    def _fill(self) -> bool:
        """Give the engine what it can run now; return whether it has anything to run."""
        if self._is_stopping:
            return bool(self._running)
        while self._ready and len(self._running) < self._engine.slots():
            self._submit(self._ready.popleft(), is_alone=False)
        if self._alone and not self._running:
            self._submit(self._alone.popleft(), is_alone=True)
        return bool(self._running)

    def _submit(self, task: records.Task, *, is_alone: bool) -> None:
        options = self.settings.options
        hosts = 1 if is_alone else self._engine.slots_per_host()
        limit_gb = task.stage.memory_gb or options.task_memory_gb or self._engine.share_gb()
        limit_gb *= self._engine.slots_per_host() if is_alone else 1
        log = self._records.path(task, ".log")
        log.parent.mkdir(parents=True, exist_ok=True)
        if task.title not in self._attempts:
            log.unlink(missing_ok=True)
            self._records.forget(task)
        self._attempts[task.title] = self._attempts.get(task.title, 0) + 1
        order = messages.Order(
            title=task.title,
            script=task.script,
            flags=tuple(f"--{name}={text}" for name, text in sorted(self.settings.flags.items())),
            inputs=task.inputs,
            folder=self.settings.folder,
            result=None if task.edits_input else task.result,
            log=log,
            reports=self._records.path(task, ".jsonl"),
            version=self._version,
            memory_gb=limit_gb,
            threads=options.task_threads,
            tasks_per_host=hosts,
            keep_going=self.settings.keep_going,
            discard=self.settings.discard,
        )
        state = self._stages[task.stage.name].state
        state.waiting, state.running = state.waiting - 1, state.running + 1
        self._running[task.title] = task
        self._engine.submit(order)
        self._watcher.states([progress.state for progress in self._stages.values()])

    def _take(self, outcome: messages.Outcome) -> None:
        """Note the end of a task, and decide whether it is tried again."""
        task = self._running.pop(outcome.title)
        progress = self._stages[task.stage.name]
        state = progress.state
        state.running -= 1
        state.seconds += outcome.seconds
        state.peak_gb = max(state.peak_gb, outcome.peak_gb)
        attempts = self._attempts[task.title]
        if outcome.ending is messages.Ending.CANCELLED:
            raise Cancelled("cancelled")
        if outcome.ending is messages.Ending.DONE:
            self._finish(task, outcome, attempts)
            state.done += 1
            progress.finished.append(task)
            self._watcher.line(f"{task.title}: done in {outcome.seconds:.1f} s")
            self._expand()
            return
        is_first_excess = outcome.ending is messages.Ending.OVER_MEMORY and attempts == 1
        if is_first_excess or (
            outcome.ending in _AGAIN and attempts <= self.settings.options.retries
        ):
            (self._alone if is_first_excess else self._ready).append(task)
            state.waiting += 1
            how = "runs once more alone" if is_first_excess else "is tried again"
            self._watcher.line(f"{task.title}: {how}: {outcome.error}")
        else:
            state.failed += 1
            log = self._records.path(task, ".log")
            self._failed.append(report.FailedTask(task.title, outcome.error, log))
            self._watcher.line(f"{task.title}: failed: {outcome.error}")
            self._is_stopping = not self.settings.keep_going
        self._watcher.states([each.state for each in self._stages.values()])

    def _finish(self, task: records.Task, outcome: messages.Outcome, attempts: int) -> None:
        self._hashes.pop(task.result, None)
        record = dataclasses.replace(
            self._record(task),
            inputs=self._inputs[task.title],
            result=self._hash(task.result),
            seconds=round(outcome.seconds, 3),
            peak_gb=round(outcome.peak_gb, 3),
            attempts=attempts,
            worker=outcome.worker,
        )
        self._records.write(task, record)


def _maps_below(task: records.Task) -> list[Path]:
    from maplab_py.storage.native import find_maps

    maps = find_maps(task.result)
    if not maps:
        raise UserError(f"{task.title}: wrote no map to {task.result}, but another stage needs one")
    return maps


_SILENT = report.Watcher()
_DEFAULTS = PipelineOptions()


def run_pipeline(
    pipeline: Pipeline,
    results_folder: Path,
    options: PipelineOptions = _DEFAULTS,
    *,
    flags: Mapping[str, str] | None = None,
    keep_going: bool = False,
    discard: bool = False,
    watcher: report.Watcher = _SILENT,
) -> report.PipelineReport:
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
    engine = engines.Engine()
    if options.scheduler != "none":
        from maplab_py.pipeline.cluster import Cluster

        engine = Cluster(options)
    driver = Driver(placed, settings, engine, watcher)
    with engine:
        if engine.address:
            watcher.line(f"tasks run on {options.scheduler}; Dask's dashboard: {engine.address}")
        return driver.run()
