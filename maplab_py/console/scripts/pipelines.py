"""`maplab batch` with stages or a scheduler: its flags, and what the user sees meanwhile."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, Self

from maplab_py.console.commands.command import describe
from maplab_py.console.commands.flags import CONSOLE_FLAGS, Flag, parse_words
from maplab_py.console.scripts.batch import Batch
from maplab_py.console.session.session import Session
from maplab_py.console.session.status import Status
from maplab_py.console.terminal import foreground, output, render
from maplab_py.errors import Cancelled, FlagError
from maplab_py.pipeline import driver, plan, progress
from maplab_py.pipeline.options import PipelineOptions

if TYPE_CHECKING:
    from rich.live import Live

_MAPS_FOLDER = "maps_folder"
_DEFAULTS = PipelineOptions()


def _declare(context: object, *, options: PipelineOptions = _DEFAULTS) -> None:
    """Run commands on each of several map folders, or the stages of a pipeline."""


_BATCH = describe(_declare, "batch", ())


def split_flags(
    words: Sequence[str], known: Mapping[str, Flag]
) -> tuple[PipelineOptions | None, list[str]]:
    """Separate the flags of `maplab batch` from the lasting flags of commands.

    Returns:
        The options, None where no flag of the batch was given; and the other words.

    Raises:
        FlagError: A flag is unknown or has a wrong value.
    """
    given, plain = parse_words(words, {**known, **_BATCH.flags}, "")
    if plain:
        raise FlagError(f"'{plain[0]}' is not a flag (write --name=value, and the file first)")
    values = {g.name: _BATCH.flags[g.name].convert(g.text) for g in given if g.name in _BATCH.flags}
    options: PipelineOptions = _BATCH.bind(values)["options"]
    others = [f"--{g.name}={g.text}" for g in given if g.name not in _BATCH.flags]
    return (options if values else None), others


def run_as_pipeline(
    batch: Batch,
    path: Path,
    options: PipelineOptions,
    session: Session,
    terminal: output.ConsoleTerminal,
    *,
    keep_going: bool,
    discard: bool,
) -> Status:
    """Run a batch file as tasks in processes of their own, and print the report.

    Args:
        batch: What the file says.
        options: Where the tasks run.
        session: Has the lasting flags that all commands get.
        terminal: Where status and report go.
        keep_going: Go on with tasks that do not need a failed one.
        discard: Maps may be left unsaved.

    Returns:
        How it ended.

    Raises:
        MaplabError: Nothing could be run, or the scheduler was lost; finished tasks are kept.
    """
    maps = tuple(Path(folder).absolute() for folder in batch.folders)
    origin = str(path)
    is_staged = bool(batch.stages)
    pipeline = (
        plan.Pipeline(origin, maps, batch.stages)
        if is_staged
        else plan.in_place(origin, maps, batch.commands)
    )
    left_out = {*CONSOLE_FLAGS, *([_MAPS_FOLDER] if is_staged else [])}
    settings = session.settings.current()
    flags = {name: setting.text for name, setting in settings.items() if name not in left_out}
    results = options.results_folder or Path(f"{path.stem}_results")
    start = time.monotonic()
    try:
        with StageTable(terminal) as table, foreground.cancelling_interrupts():
            report = driver.run_pipeline(
                pipeline,
                results,
                options,
                flags=flags,
                keep_going=keep_going,
                discard=discard,
                watcher=progress.Watcher(table.line, table.show),
            )
    except (Cancelled, KeyboardInterrupt):
        text = "batch: cancelled; finished tasks are kept (--resume runs the others)"
        terminal.failed(text, "batch", int(Status.CANCELLED))
        return Status.CANCELLED
    terminal.show(report, "batch", time.monotonic() - start)
    if report.failure:
        terminal.error(f"batch: {report.failure}")
    return Status.FAILED if report.failure else Status.OK


_COLUMNS = ("waiting", "running", "done", "kept", "failed")


class StageCounts(Protocol):
    """Tasks of a stage, counted."""

    stage: str
    waiting: int
    running: int
    done: int
    kept: int
    failed: int


class StageTable:
    """Shows how many tasks of each stage wait, run and have ended."""

    def __init__(self, terminal: output.ConsoleTerminal) -> None:
        self._terminal = terminal
        self._live: Live | None = None

    def __enter__(self) -> Self:
        """Start to follow, if standard error is a terminal."""
        if render.wants_colour(sys.stderr):
            from rich.console import Console
            from rich.live import Live

            self._live = Live(console=Console(stderr=True), transient=True, refresh_per_second=4)
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Remove the table; the report follows."""
        if self._live is not None:
            self._live.stop()

    def line(self, text: str) -> None:
        """Print a line above the table."""
        if self._live is not None:
            self._live.console.print(text, markup=False, highlight=False)
        else:
            self._terminal.note(text)

    def show(self, stages: Sequence[StageCounts]) -> None:
        """Update the table."""
        if self._live is not None:
            self._live.update(_table(stages))


def _table(stages: Sequence[StageCounts]) -> Any:
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    table.add_column("stage")
    for name in _COLUMNS:
        table.add_column(name, justify="right")
    for stage in stages:
        table.add_row(stage.stage, *(str(getattr(stage, name) or "") for name in _COLUMNS))
    return table
